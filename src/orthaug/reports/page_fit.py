"""The sections of a fit's page, in the order in which they are read."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from orthaug._base.lines import BIASED_INTERVAL, digits_for, with_unit
from orthaug.analysis.causes import SURE_SHARE
from orthaug.analysis.findings import MotionFitResult
from orthaug.analysis.fit_findings import ParameterResult, PartScores
from orthaug.fitting.estimates import STD_KINDS
from orthaug.models.response import Response
from orthaug.reports.biases import OF_FORMS, biased_by, hang_on_form
from orthaug.reports.learned_part import LearnedPart
from orthaug.reports.page_blocks import (
    CATEGORIES,
    Code,
    Plot,
    Section,
    Table,
    Text,
    interval,
    number,
    percent,
)
from orthaug.reports.page_figures import interval_plot, score_plot
from orthaug.reports.page_findings import (
    excitation_blocks,
    residuals_blocks,
    restarts_blocks,
    stability_blocks,
)
from orthaug.reports.page_learned import learned_blocks
from orthaug.reports.page_runs import Run, error_band, run_plots
from orthaug.reports.result import CompareResult, DataResult, FitResult

BIAS_CAPTION = (
    " The bias is the estimate minus the true value, as far as one suspected term explains "
    "what the learner found."
)


@dataclass(frozen=True, eq=False)
class Origin:
    """The origin of a result: name and text of its spec, the command, date and versions."""

    name: str
    toml: str
    command: str
    date: str
    machine: str
    versions: Mapping[str, str]
    seed: int


@dataclass(frozen=True, eq=False)
class FitPage:
    """Additions to a fit's result on its page."""

    origin: Origin
    result: FitResult
    responses: Mapping[str, tuple[Response, Response]]
    """One-step prediction and free run of every part."""
    alone: Mapping[str, Response] = field(default_factory=dict)
    """Free run of the model without its learner, of every part; empty where nothing was learned."""
    learned: LearnedPart | None = None

    @property
    def outputs(self) -> tuple[str, ...]:
        """Names of the outputs."""
        return tuple(
            channel.name for _, free in self.responses.values() for channel in free.outputs
        )[: self._count]

    @property
    def units(self) -> dict[str, str]:
        """Units of channels and states, by name."""
        return units_of_result(self.result) | {
            c.name: c.unit for _, free in self.responses.values() for c in free.outputs
        }

    @property
    def _count(self) -> int:
        return len(next(iter(self.responses.values()))[1].outputs)


def units_of_result(result: FitResult | CompareResult) -> dict[str, str]:
    """Return the units of channels and states by name, as the spec declares them."""
    states = (result.spec.get("motion") or {}).get("states") or {}
    channels = (result.spec.get("data") or {}).get("channels") or {}
    return {name: given.get("unit") or "" for name, given in {**states, **channels}.items()}


def fit_sections(page: FitPage) -> list[Section]:
    """Return all sections; those without content in the result are left out."""
    result = page.result
    found = [
        Section("parameters", "Parameters", _parameters(result)),
        Section("free-run", "Free run", _runs(page)),
        Section("share", "Physics and learner", _shares(page)),
        Section("learned", "What was learned", _learned_blocks(page)),
        Section("scores", "Scores", score_blocks({"": result.scores}, page.outputs, page.units)),
        Section("residuals", "Residual tests", residuals_blocks(result, page.units), folded=True),
        Section("stability", "Stability", stability_blocks(result), folded=True),
        Section("excitation", "Excitation and suspects", excitation_blocks(result), folded=True),
        Section("restarts", "Training and restarts", restarts_blocks(result), folded=True),
        Section(
            "reproduce", "How to reproduce it", origin_blocks(page.origin, result), folded=True
        ),
    ]
    return [section for section in found if section.blocks]


def _parameters(result: FitResult) -> list[Any]:
    rows = [*result.parameters, *(result.physical_parameters or [])]
    if not rows:
        return [Text("The physics has no parameters: the whole model was learned.")]
    text = {
        "robust": "Standard errors are robust against a coloured residual.",
        "plain": "Standard errors are those of a white residual.",
        None: "There are no standard errors.",
    }
    between = "95 %, noise only" if result.noise_only else "95 % interval"
    columns = ["parameter", "value", "unit", "standard error", between, "initial"]
    biased = any(row.bias for row in rows)
    columns += ["bias", BIASED_INTERVAL] if biased else []
    shared = any(row.shared is not None for row in rows)
    columns += ["learner could imitate it"] if shared else []
    caption = f"What was estimated. {text[result.standard_errors]}"
    if result.standard_errors_by is not None:
        caption = f"What was estimated. Standard errors: {STD_KINDS[result.standard_errors_by]}."
    if result.intervals is not None and result.intervals.source != "none":
        caption += f" {result.intervals.text[0].upper()}{result.intervals.text[1:]}"
    if result.noise_only:
        caption += " Intervals count noise only: the warnings say what else may have moved them."
    if result.standard_errors is not None:
        caption += (
            " Intervals hold for the inputs that were applied; under other inputs the bias differs."
        )
    if any(row.derived_unit for row in rows):
        caption += (
            " A unit in brackets is not in the spec: it follows from the units of the channels."
        )
    if biased_by(rows):
        caption += f"{BIAS_CAPTION[:-1]};"
        caption += (
            " the interval with the bias is the hull over all causes that noise cannot distinguish."
        )
    blocks: list[Any] = [
        Table(caption, columns, [_parameter_cells(row, biased, shared) for row in rows])
    ]
    plot = interval_plot(rows)
    blocks += [plot] if plot else []
    blocks += _over_experiments(result)
    blocks += _noise_model(result)
    causes = [
        f"{percent(share)} {'looks like' if result.learns and share < SURE_SHARE else 'is'} {cause}"
        for cause, share in biased_by(rows)
    ]
    if causes:
        text, more = (
            f"{' in one equation' if len(causes) > 1 else ''} {', in another '.join(causes)}",
            "",
        )
        if result.learns:
            more = (
                ", once what the physics can imitate is taken out of both; drawn over one "
                "input it may explain less"
            )
        what = "what the learner found" if result.learns else "the squared residual of the free run"
        blocks.append(Text(f"The bias budget: of {what}{text}{more}."))
    if hang_on_form(rows):
        blocks.append(Text(f"{OF_FORMS[:-1]}, are in the table."))
    if result.physical_consistency:
        blocks.append(Text(result.physical_consistency.text))
    if result.shared is not None:
        blocks.append(Text(result.shared.text, "note"))
    return blocks + _equations(result)


def _noise_model(result: FitResult) -> list[Any]:
    """Return the coefficients of the noise model, and how white its innovations are."""
    if not result.noise:
        return []
    caption = (
        "The noise model D(q) v = C(q) e of the errors v: 1 + ar1 q⁻¹ + … is D, 1 + ma1 q⁻¹ + … is "
        "C. Its coefficients were estimated with the parameters, whose intervals count that. "
    )
    if any(one.ar is None for one in result.noise):
        caption = (
            "The gain K of the one-step predictor x̂⁺ = F(x̂, u) + K (y − ŷ), by which its states "
            "follow each output. It was estimated with the parameters, whose intervals count that. "
        )
    caption += " ".join(f"{one.text}." for one in result.noise)
    rows = [
        [
            one.output,
            each.name,
            number(each.value),
            number(each.std, 2),
            interval(each.ci95),
        ]
        for one in result.noise
        for each in one.coefficients
    ]
    if not rows:
        return [Text(caption)]
    columns = ["output", "coefficient", "value", "standard error", "95 % interval"]
    return [Table(caption, columns, rows)]


def _over_experiments(result: FitResult) -> list[Any]:
    """Return the intervals for experiments like those fitted, where there are several."""
    over = result.over_experiments
    if over is None:
        return []
    caption = (
        f"For experiments like these {over.experiments}, from their own differences: each is left "
        "out in turn. Where the ratio is large, the physics lacks something that other inputs "
        "bring out otherwise."
    )
    columns = ["parameter", "standard error", "95 % interval", "times that of the inputs applied"]
    rows = [
        [row.name, number(row.std, 2), interval(row.ci95), number(row.ratio, 2)]
        for row in (*over.parameters, *(over.physical_parameters or ()))
    ]
    return [Table(caption, columns, rows)]


def bias_cell(row: ParameterResult) -> str:
    """Return the bias by the learned part."""
    return number(row.bias.value, 2, row.value) if row.bias else "–"


def _parameter_cells(row: ParameterResult, biased: bool, shared: bool) -> list[str]:
    scale = row.value
    cells = [
        row.name,
        number(row.value, digits_for(row.value, row.std, 6)),
        row.shown_unit,
        number(row.std, 2, scale),
        interval(row.ci95),
        number(row.initial),
    ]
    if biased:
        known = row.bias is None or row.bias.determined
        cells += [
            bias_cell(row),
            interval(row.ci95_with_bias) if known else "not determined by these data",
        ]
    return cells + ([{True: "yes", False: "no", None: "–"}[row.shared]] if shared else [])


def _equations(result: FitResult) -> list[Any]:
    """Return the equations of a motion, and the terms that were learned."""
    blocks = [] if result.motion is None else _motion_blocks(result.motion, result.spec)
    if result.terms:
        rows = [
            [
                t.term,
                t.added_to,
                number(t.coefficient),
                t.unit or "–",
                number(t.std, 2, t.coefficient),
                interval(t.ci95),
                number(t.largest, 3),
            ]
            for t in result.terms
        ]
        head = [
            "term",
            "added to",
            "coefficient",
            "unit",
            "standard error",
            "95 % interval",
            "largest contribution",
        ]
        blocks.append(Table("The learned terms, the largest first.", head, rows))
    if result.equation:
        blocks.append(Code(result.equation.text, "The fitted equations"))
    return blocks


def _motion_blocks(motion: MotionFitResult, spec: Mapping[str, Any]) -> list[Any]:
    """Return the equations of a motion or the file that has them, and the controller of a loop."""
    declared, controller = spec.get("motion") or {}, spec.get("controller")
    integration = (
        f"{motion.integrator} with {motion.substeps} substep{'s' * (motion.substeps > 1)} in a "
        f"sample and a {motion.hold} hold; a prediction starts from a state estimated over "
        f"{motion.window} rows."
    )
    blocks: list[Any] = []
    if "states" in declared:
        rows = [
            [
                state,
                given.get("unit") or "–",
                given.get("next") or given.get("derivative") or "–",
                "yes" if given.get("learned") else "no",
            ]
            for state, given in declared["states"].items()
        ]
        value = "next value" if motion.discrete else "derivative"
        head = ["state", "unit", value, "learner beside it"]
        blocks.append(Table(f"The equations of motion, {integration}", head, rows))
    elif declared.get("source"):
        source = declared["source"]
        beside = ", ".join(source.get("learned") or ())
        learned = f"; the learner is beside {beside}" if beside else ""
        blocks.append(
            Text(
                f"The equations of motion are those of `{source.get('file')}`, with the states "
                f"{', '.join(motion.states)}{learned}. They are integrated by {integration}",
                "note",
            )
        )
    if controller:
        blocks.append(Text(_controller_text(controller), "note"))
    return blocks


def _controller_text(controller: Mapping[str, Any]) -> str:
    """Return a sentence on the controller that a motion is simulated with."""
    if controller.get("outputs"):
        equations = {**(controller.get("define") or {}), **controller["outputs"]}
        law = ", ".join(f"`{name} = {given}`" for name, given in equations.items())
        next_values = {name: one["next"] for name, one in (controller.get("states") or {}).items()}
        law += "".join(f", next `{name} = {given}`" for name, given in next_values.items())
        return f"The loop is simulated with its controller: {law}."
    keys = ("Kp", "Ki", "Kd", "filter", "numerator", "denominator")
    law = ", ".join(f"{key} = {controller[key]}" for key in keys if controller.get(key))
    error = f"{controller.get('reference') or '0'} − {controller.get('measured') or 'the output'}"
    return (
        f"The loop is simulated with its controller, which sets {controller.get('output')} from "
        f"{error}: {law}."
    )


def _runs(page: FitPage) -> list[Any]:
    runs = [Run(part, free, page.alone.get(part)) for part, (_, free) in page.responses.items()]
    train = next(iter(page.responses.values()))[1]
    notes = [
        Text(w.text, "warning")
        for w in page.result.warnings
        if w.code in ("witness", "free_run_diverged")
    ]
    band, alone = error_band(train), bool(page.alone)
    text = (
        "In free run a model uses the inputs and its own past outputs only; the residual is "
        "measured less model."
    )
    if alone:
        text += (
            " The model without its learner has the same parameters and the learner switched "
            "off; it is not the"
        )
        text += " physics alone of the verdict, which is fitted by itself."
    text += (
        " Between the limits of the band lie 95 % of the errors on the training data."
        if band
        else ""
    )
    how = Text(
        "Drag to zoom, double-click for the first view. Where that is a part of the record, the "
        "button below shows all. On the keyboard the arrows move, + and − zoom, 0 shows all.",
        "hint",
    )
    return [*notes, Text(text), how, *run_plots(runs, band)]


def _shares(page: FitPage) -> list[Any]:
    """Return the shares of physics and learner in the model's output, or in each equation."""
    result = page.result
    if result.motion is not None:
        rows = [
            (part.equation, part.physics, part.learner, part.share, part.unit)
            for part in result.motion.parts
        ]
        what = "each learned equation along the training run"
    else:
        if page.learned is None:
            return []
        rows = [
            row
            for part, (one_step, _) in page.responses.items()
            for row in _part_shares(part, one_step)
        ]
        what = "the one-step prediction's deviation from its mean"
    if not rows:
        return []
    cells = [
        [name, number(physics, 3), number(learner, 3), unit or "–", percent(share)]
        for name, physics, learner, share, unit in rows
    ]
    head = ["part", "physics", "learner", "unit", "share of the learner"]
    caption = (
        f"RMS of what physics and learner add to {what}. The share is the learner's RMS over "
        "that of their sum; "
    )
    caption += "it need not match the two RMS, because the parts may cancel or add up."
    bars = {
        "type": "bar",
        "orientation": "h",
        "y": [row[0] for row in rows],
        "x": [None if row[3] is None else 100 * row[3] for row in rows],
        "marker": {"color": "@learner"},
    }
    largest = max((x for x in bars["x"] if x is not None), default=0.0)
    end = min(1.05 * largest, 100.0) or 100.0
    end = end if largest <= 100 else 1.05 * largest
    title = f"share of the learner [%]; the axis ends at {percent(end / 100)}"
    axis = {"title": {"text": title}, "range": [0, end]}
    layout = {"xaxis": axis, "yaxis": CATEGORIES, "showlegend": False}
    text = "The learner's RMS over that of physics and learner together."
    if result.structure == "orthogonal":
        text += (
            " The learner has only what the physics cannot explain: its overlap with the "
            "physics is split off."
        )
    label = "Share of the learner; the table has the numbers."
    return [Table(caption, head, cells), Plot(label, text, [bars], layout, 90 + 34 * len(rows))]


def _part_shares(
    part: str, response: Response
) -> list[tuple[str, float, float, float | None, str]]:
    found = []
    for i, channel in enumerate(response.outputs):
        both = [
            np.concatenate([getattr(t, name)[t.start :, i] for t in response.trajectories])
            for name in ("baseline", "learner")
        ]
        with np.errstate(all="ignore"):
            physics, learner, total = (
                float(np.nanstd(values)) for values in (*both, both[0] + both[1])
            )
        name = part if len(response.outputs) == 1 else f"{part}, {channel.name}"
        found.append((name, physics, learner, learner / total if total else None, channel.unit))
    return found


def _learned_blocks(page: FitPage) -> list[Any]:
    if page.learned is None or not page.learned.features:
        return []
    return list(learned_blocks(page.learned, page.result.measure or ""))


def score_blocks(
    scores: Mapping[str, Mapping[str, PartScores]], outputs: Sequence[str], units: Mapping[str, str]
) -> list[Any]:
    """Return the scores as a plot and a table; of one model, or of several by their names."""
    rows = []
    named = any(scores)
    for row, parts in scores.items():
        for part, both in parts.items():
            for kind, score in both.kinds.items():
                for j, output in enumerate(outputs):
                    cells = [
                        None if v is None or j >= len(v) else v[j]
                        for v in (score.rmse, score.nrmse, score.fit)
                    ]
                    horizon = "one step" if kind == "prediction" else "free run"
                    rows.append(
                        [
                            *([row] if named else []),
                            part,
                            horizon,
                            with_unit(output, units.get(output)),
                            number(cells[0], 4),
                            number(cells[1], 4),
                            number(cells[2], 4),
                        ]
                    )
    head = [*(["model"] if named else []), "part", "horizon", "output", "RMSE", "NRMSE", "FIT %"]
    plot = score_plot(scores, outputs)
    table = Table(
        "Scores; RMSE is in the output's unit, FIT is 100 (1 − NRMSE), a dash where there is none.",
        head,
        rows,
    )
    return [*([plot] if plot else []), table]


def origin_blocks(origin: Origin, result: FitResult | CompareResult) -> list[Any]:
    """Return command, versions, files with their checksums, and the spec as it was written."""
    rows = [
        ["command", origin.command],
        ["seed", str(origin.seed)],
        ["date", origin.date],
        ["machine", origin.machine],
    ]
    rows += [[name, version] for name, version in origin.versions.items()]
    return [
        Table(
            "How this result was made; the same versions, files and seed give the same numbers.",
            ["what", ""],
            rows,
        ),
        _files(result.data),
        Code(origin.toml, "The spec as it was written", long=True),
    ]


def _files(data: DataResult) -> Table:
    rows = [
        [part, f.file, str(f.rows), f.sha256] for part, files in data.parts.items() for f in files
    ]
    return Table("The data files and their checksums.", ["part", "file", "rows", "sha256"], rows)
