"""Results in words: what the commands print."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from orthaug._base.errors import Warning
from orthaug._base.lines import (
    INTERVAL_HEAD,
    Copied,
    continued,
    cut,
    estimate_cells,
    estimate_rows,
    fold,
    join_blocks,
    percent,
    plain_number,
    plural,
    table,
)
from orthaug.analysis.budget import SURE_SHARE
from orthaug.analysis.findings import SharedResult, SuspectResult
from orthaug.analysis.fit_findings import Findings, ParameterResult
from orthaug.data.spec_lines import changed_lines
from orthaug.reports.biases import OF_FORMS, REMOVED_BY, biased_by, hang_on_form
from orthaug.reports.page_verdict import PageVerdict, compare_verdict, fit_verdict
from orthaug.reports.result import (
    CheckResult,
    CompareResult,
    DesignResult,
    FitResult,
    RowResult,
    SplitResult,
)

if TYPE_CHECKING:
    from orthaug.analysis.validation import Verdict
    from orthaug.data.channels import Channel
    from orthaug.fitting.estimates import Estimate
    from orthaug.models.response import Response, Scores

SHOWN = 8  # signals of a design that are listed
NOISE_ONLY = "95 %, noise only"  # head of intervals that do not count missing physics
_LONGEST_SETTING = 30  # characters of a cell
_LONGEST_SIGNAL = 44  # characters of the name of a design: beside its numbers on 80 columns
ADVISED = 2  # changes that a text advises at most; result.json has all


def fit_text(fit: Estimate, result: Findings) -> str:
    """Return parameters, scores on every part, residual tests and warnings.

    The verdict that its page begins with ends them; of a spec's fit after the changes that were
    tried.
    """
    if not fit.status.ok:
        return ""
    between = NOISE_ONLY if result.noise_only else INTERVAL_HEAD
    lines = [_withdraw_claim(line, result) for line in fit.lines(between)]
    blocks = [[w.text.capitalize() for w in result.warnings if w.code == "one_step_only"], lines]
    if result.intervals is not None and result.intervals.source != "none":  # else a warning says it
        blocks.append([f"{result.intervals.text[0].upper()}{result.intervals.text[1:]}"])
    if result.focus is not None and result.focus.candidates:
        blocks.append([f"{result.focus.text[0].upper()}{result.focus.text[1:]}"])
    if result.physical_parameters:
        blocks.append(_physical_lines(result))
    blocks.append(_score_lines(fit, result))
    if result.shared is not None and (not result.shared.everything or result.shared.doubt):
        blocks.append([result.shared.text])
    blocks.append(_bias_lines(result))
    findings = [result.residuals, result.missing_lags, result.validation]
    findings += [result.stability] if result.motion is not None else []
    parts = [finding.text for finding in findings if finding]
    blocks += [
        parts,
        warning_lines(w for w in dict.fromkeys(result.warnings) if w.text not in parts),
    ]
    if isinstance(result, FitResult):
        blocks += _advice_blocks(result)
    blocks.append([verdict_line(fit_verdict(result))])
    return join_blocks(blocks)


def verdict_line(verdict: PageVerdict) -> str:
    """Return the verdict with which a page begins: is the model reliable, and for what use."""
    return f"Verdict: {verdict.trust} {verdict.use}"


def _withdraw_claim(line: str, result: Findings) -> str:
    """Return a line of a fit without the claim that a doubt about shared directions withdraws."""
    if result.shared is not None and result.shared.doubt and line.startswith("shared "):
        line = (
            f"{line.partition('; determined by the fit: ')[0]}; determined by the fit: in "
            "doubt, see below"
        )
    return line


def _advice_blocks(result: FitResult) -> list[Sequence[str]]:
    """Return the changes that lowered the free run's error, and a count of all trials.

    The lines of the first follow it.
    """
    lines = [f"Or: {advice.text}" for advice in result.advice[1:ADVISED]]
    lines += [result.advice_trials.text] if result.advice_trials is not None else []
    if not result.advice:
        return [lines]
    first = result.advice[0]
    changed = changed_lines(result.spec, first.change)
    remedy = ["Write into the spec, and fit again:"] if changed else []
    return [[f"Next: {first.text}"], remedy, Copied(changed), lines]


def check_text(result: CheckResult) -> str:
    """Return excitation, identifiability, and possible biases of the parameters."""
    data, physics = result.excitation, result.identifiability
    condition = f"{data.condition:.4g}" if data.condition is not None else "infinite"
    motion, entries, where = result.motion, "regressor       ", "at random points"
    if motion is not None:
        driven = len(result.regressor) > len(motion.states)
        entries, where = "states, inputs  ", "with rich inputs" if driven else "from other starts"
    lines = [
        f"parameters       {', '.join(result.parameters) or 'none'}",
        f"{entries} {', '.join(result.regressor)}",
        f"usable rows      {result.rows}",
        f"excitation       rank {data.rank} of {data.columns} on the data, condition {condition}",
        f"identifiability  rank {physics.rank} of {physics.columns} {where}: "
        + (
            "the parameters can be distinguished"
            if physics.identifiable
            else "no data can distinguish the parameters"
        ),
    ]
    for group in physics.inseparable:
        lines.append(f"  inseparable by any data: {', '.join(group)}")
    if physics.identifiable:
        for group in data.collinear:
            lines.append(f"  not excited separately by these data: {', '.join(group)}")
    if motion and motion.text:
        lines += ["", motion.text]
    if result.shared is not None:
        lines += ["", *_shared_lines(result.shared)]
    if result.bias:
        lines += [
            "",
            "Bias of each parameter if a term is missing from the physics. Size: its share of "
            f"the output's deviation, 1 % where no coefficient is given. {REMOVED_BY}",
            *_suspect_lines(result.bias),
        ]
    return "\n".join(fold([*lines, *warning_lines(result.warnings)]))


def _shared_lines(shared: SharedResult) -> list[str]:
    """Return the physics that the learner could imitate, and a table of other learner inputs."""
    lines = [shared.text]
    if shared.alternatives:
        head = ["with learner.inputs", "shared directions", "determined beside it"]
        rows = [
            [
                ", ".join(other.inputs),
                str(other.shared),
                ", ".join([*other.determined, *(other.physical or [])]) or "–",
            ]
            for other in shared.alternatives
        ]
        lines += [f"  {line}" for line in table(continued([head, *rows], indent=2))]
    return lines


def compare_text(result: CompareResult, verdicts: Mapping[str, Verdict]) -> str:
    """Return two tables, parameters with standard errors and scores on every part.

    The verdicts on each row follow, and at the end which one to take. Of saved results the
    parameters have intervals and differences, and the settings that differ are a third table.
    """
    saved = result.differences is not None
    what = "result" if saved else "structure"
    lines = _difference_lines(result) if saved else table(_parameter_cells(result))
    lines += ["", *_score_table(result.comparison, what)]
    if result.chosen:
        lines += ["", "* chosen on the validation part"]
    if result.equal:
        best, *others = result.equal
        lines += [
            *([] if result.chosen else [""]),
            f"equal to {best} within noise: {', '.join(others)}",
        ]
    lines += ["", *_setting_lines(result)] if saved else []
    parts = [
        f"{row.name}: {row.residuals.text}"
        for row in result.comparison
        if row.residuals is not None
    ]
    lines += ["", *parts] if parts else []
    parts = [f"{kind}: {verdict.summary}" for kind, verdict in verdicts.items()]
    beyond = dict.fromkeys(f"{e}." for verdict in verdicts.values() for e in verdict.extrapolation)
    if saved:
        parts = [
            f"{row.name}: {row.validation.text}" for row in result.comparison if row.validation
        ]
    lines += ["", *parts, *beyond] if parts else []
    lines.append("")
    lines += [f"left out: {kind}: {why}" for kind, why in result.left_out.items()]
    lines += warning_lines(result.warnings)
    for row in result.comparison:
        lines += [
            f"warning: {row.name}: {w.text}" for w in row.warnings if w not in result.warnings
        ]
    lines += ["", verdict_line(compare_verdict(result))]
    return "\n".join(fold(lines))


def _difference_lines(result: CompareResult) -> list[str]:
    """Return a row for each parameter of each saved result, with its difference from the first."""
    rows, first = result.comparison, result.comparison[0].name
    found = {(one.name, one.result): one for one in result.differences or ()}
    cells = [
        ["parameter", "result", "value", "std", INTERVAL_HEAD, f"less {first}", "of std", "unit"]
    ]
    for name in dict.fromkeys(p.name for row in rows for p in row.parameters):
        own = {row.name: p for row in rows for p in row.parameters if p.name == name}
        shown = estimate_rows((p.value, p.std, p.profile95 or p.ci95) for p in own.values())
        for number, (row, p, estimate) in enumerate(zip(own, own.values(), shown, strict=True)):
            other = found.get((name, row))
            apart = (
                ["–", "–"] if other is None else [_signed(other.value), _signed(other.of_std, 2)]
            )
            star = " *" if row == result.chosen else ""
            cells.append(["" if number else name, row + star, *estimate, *apart, p.unit])
    return table(cells, drop=["std", "unit"])


def _signed(value: float | None, digits: int = 3) -> str:
    return "–" if value is None else plain_number(value, digits, sign="+")


def _setting_lines(result: CompareResult) -> list[str]:
    """Return the settings in which saved results differ; a dash where the default holds."""
    if not result.settings:
        return ["The settings are the same."]
    return table(setting_rows(result))


def setting_rows(result: CompareResult) -> list[list[str]]:
    """Return the settings that differ, a row each with its values in each result, a head first."""
    names = [row.name for row in result.comparison]
    rows = [
        [one.key, *(_setting_cell(one.values[name]) for name in names)]
        for one in result.settings or ()
    ]
    return [["setting", *names], *rows]


def _setting_cell(value: object) -> str:
    """Return a value of a spec as a cell: as TOML has it, cut; a dash for none."""
    return "–" if value is None else cut(json.dumps(value, ensure_ascii=False), _LONGEST_SETTING)


def split_text(result: SplitResult) -> str:
    """Return θ under the measure, with intervals."""
    detail = result.measure_detail
    support = "–" if detail.support is None else f"{100 * detail.support:.0f} %"
    lines = [
        f"measure     {result.measure}, {detail.points} points, {support} of it within the "
        "range of the data",
        *parameter_table("parameter", result.parameters),
    ]
    return "\n".join(fold([*lines, *warning_lines(result.warnings)]))


def parameter_table(name: str, rows: Sequence[ParameterResult]) -> list[str]:
    """Return parameters with standard errors and intervals; the head begins with `name`."""
    cells = estimate_rows((row.value, row.std, row.ci95) for row in rows)
    head = [name, "value", "std", INTERVAL_HEAD, "unit"]
    body = [[row.name, *own, row.unit] for row, own in zip(rows, cells, strict=True)]
    return table([head, *body])


def design_text(result: DesignResult) -> str:
    """Return the design, and the signals that were tried beside it."""
    rows = [["signal", "error", "bias", "std", "condition"]]
    for signal in result.candidates[:SHOWN]:
        error = None if signal.cost is None else float(np.sqrt(signal.cost))
        rows.append(
            [
                cut(signal.name, _LONGEST_SIGNAL),
                *map(_or_infinite, (error, signal.bias, signal.std, signal.condition)),
            ]
        )
    lines = [
        f"input       {result.kind}",
        f"predicted   relative error of θ {_or_infinite(result.relative_error)}, "
        f"condition {_or_infinite(result.condition, 3)}",
        "",
        *table(
            [
                ["parameter", "bias", "std"],
                *(
                    [name, _or_infinite(bias), _or_infinite(result.std[name])]
                    for name, bias in result.bias.items()
                ),
            ]
        ),
        "",
        "what was tried, relative errors of θ:",
        *table(rows, drop=["condition"]),
    ]
    return "\n".join(fold(lines))


def _or_infinite(value: float | None, digits: int = 4) -> str:
    return "inf" if value is None else f"{value:.{digits}g}"


def warning_lines(warnings: Iterable[Warning]) -> list[str]:
    """Return a line for each warning."""
    return [f"warning: {warning.text}" for warning in warnings]


def _suspect_lines(suspects: Sequence[SuspectResult]) -> list[str]:
    """Return the effect of each suspect, with biases in per cent."""
    rows = [["suspect", "size", *suspects[0].percent, "cosine", "removed by"]]
    for suspect in suspects:
        guess = suspect.coefficient
        cosine = "–" if suspect.cosine is None else f"{suspect.cosine:.3f}"
        size = (
            "1 %"
            if guess is None
            else "–"
            if suspect.size is None
            else percent(abs(guess) * suspect.size)
        )
        biases = (
            "–" if share is None else percent(_round_share(share) / 100, sign="+")
            for share in suspect.percent.values()
        )
        rows.append([suspect.name, size, *biases, cosine, suspect.removed_by or "–"])
    return table(rows, drop=["cosine", "size"])


def _bias_lines(result: Findings) -> list[str]:
    """Return the bias of every parameter by the learned part, and the interval that covers it."""
    rows = [*result.parameters, *(result.physical_parameters or ())]
    lines, causes = [], biased_by(rows)
    what = ("learner found" if result.learns else "free run leaves") + (
        " in one equation" if len(causes) > 1 else ""
    )
    doubted = result.shared is not None and bool(result.shared.doubt)
    held = ", as far as the learner holds what the physics lacks" if doubted else ""
    for (cause, share), own in causes.items():
        if result.learns and share < SURE_SHARE:
            lines.append(
                f"What the {what} looks most like {cause}: {percent(share)} of it. The bias in "
                f"this case{held}:"
            )
        else:
            lines.append(
                f"{100 * share:.0f} % of what the {what} is {cause}. The resulting bias{held}:"
            )
        lines += _bias_table([row for row in own if row.value is not None])
    by_form = hang_on_form(rows)
    return [*lines, OF_FORMS, *_bias_table(by_form)] if by_form else lines


def _bias_table(rows: Sequence[ParameterResult]) -> list[str]:
    """Return the biases, in standard errors and per cent, with the intervals that cover them."""
    reach = estimate_rows((row.value, None, row.ci95_with_bias) for row in rows)
    cells = [["parameter", "bias", "of std", "of value", "95 % interval with it"]]
    for row, (_, _, limits) in zip(rows, reach, strict=True):
        value, bias = row.value or 0.0, row.bias.value if row.bias else None
        bias = _round_share((bias or 0.0) / (value or 1.0)) * (value or 1.0)
        errors = plain_number(abs(bias) / row.std) if row.std else "–"
        share = row.share_of_bias
        part = "–" if share is None else percent(_round_share(share), sign="+")
        known = row.bias is None or row.bias.determined
        cells.append(
            [
                row.name,
                f"{bias + 0.0:+.3g}",
                errors,
                part,
                limits if row.ci95_with_bias or known else "not determined by these data",
            ]
        )
    return table(cells)


def _round_share(share: float) -> float:
    """Return a number, zero where it is only the rounding error of zero."""
    return 0.0 if abs(share) < 1e-9 else share


def _physical_lines(result: Findings) -> list[str]:
    rows = result.physical_parameters or []
    cells = estimate_rows((row.value, row.std, row.profile95 or row.ci95) for row in rows)
    between = NOISE_ONLY if result.noise_only else INTERVAL_HEAD
    lines = table(
        [
            ["physical", "value", "std", between, "initial", "unit"],
            *(
                [row.name, *own, f"{row.initial:.5g}", row.unit]
                for row, own in zip(rows, cells, strict=True)
            ),
        ],
        drop=["initial"],
    )
    if result.physical_consistency:
        lines.append(result.physical_consistency.text)
    return lines


def _score_lines(fit: Estimate, result: Findings) -> list[str]:
    """Return the scores as a table, one line per part, kind and output."""
    rows = [["part", "horizon", "output", "RMSE", "NRMSE", "FIT %"]]
    for part, scores in result.scores.items():
        for kind, score in scores.kinds.items():
            for i, channel in enumerate(fit.model.outputs):
                cells = (
                    None if values is None else values[i]
                    for values in (score.rmse, score.nrmse, score.fit)
                )
                rmse, nrmse, percent = ("–" if c is None else f"{c:.6g}" for c in cells)
                rows.append(
                    [part, kind, channel.name, f"{rmse} {channel.unit}".strip(), nrmse, percent]
                )
    return [*table(rows, drop=["NRMSE"]), *_residual_lines(result)] if len(rows) > 1 else []


def _residual_lines(result: Findings) -> list[str]:
    """Return the correlations of the one-step residual, where all rows were looked at."""
    lines = []
    for part, scores in result.scores.items():
        for test in scores.residual or ():
            acf = np.array(test.acf, dtype=float)
            lag = 1 + int(np.argmax(np.abs(acf[1:])))
            largest = [(f"its own past by {acf[lag]:.2g} at lag {lag}", test.acf_band)]
            found = ((name, cross) for name, cross in test.cross.items() if cross is not None)
            for name, cross in found:
                value = cross.values[len(acf) - 1 + cross.lag]
                largest.append((f"{name} by {value:.2g} at lag {cross.lag}", cross.band))
            parts = ", ".join(f"{words} (band {band:.1g})" for words, band in largest)
            lines.append(
                f"{part}: over all {test.n} rows the one-step residual of {test.name} follows "
                f"{parts}."
            )
    return lines


def response_text(response: Response) -> str:
    """Return the scores of a response where its outputs were measured and every row has a value.

    Otherwise empty.
    """
    if any(t.measured is None or t.diverged for t in response.trajectories):
        return ""
    return scores_text(response.scores(), response.outputs, response.horizon)


def scores_text(scored: Scores, outputs: Sequence[Channel], horizon: int | None) -> str:
    """Return the scores of each output; `horizon` in steps, None for a free run."""
    kind = "free run" if horizon is None else f"{plural(horizon, 'step')} ahead"
    rows = [[f"{kind}, {plural(scored.samples, 'row')}", "RMSE", "NRMSE", "FIT %"]]
    for channel, *numbers in zip(outputs, scored.rmse, scored.nrmse, scored.fit, strict=True):
        rmse, nrmse, percent = ("–" if np.isnan(number) else f"{number:.6g}" for number in numbers)
        rows.append([channel.name, f"{rmse} {channel.unit}".strip(), nrmse, percent])
    return "\n".join(table(rows))


def _parameter_cells(result: CompareResult) -> list[list[str]]:
    names = list(
        dict.fromkeys(parameter.name for row in result.comparison for parameter in row.parameters)
    )
    rows = [["structure", *names, "‖QᵀF̃‖/‖F‖", "‖F̃‖/‖Φθ̂‖", "weights", "time [s]"]]
    for row in result.comparison:
        defect, share = row.orthogonality_defect, row.learner_to_physics
        own = {parameter.name: _estimate(parameter) for parameter in row.parameters}
        rows.append(
            [
                row.name + (" *" if row.name == result.chosen else ""),
                *(own.get(name, "–") for name in names),
                "–" if defect is None else f"{defect:.1e}",
                "–" if share is None else f"{share:.2g}",
                str(row.weights),
                "–" if row.seconds is None else f"{row.seconds:.2f}",
            ]
        )
    return rows


def _score_table(rows: Sequence[RowResult], what: str) -> list[str]:
    cells = [[what, "part", "one-step NRMSE", "free-run NRMSE", "free-run FIT %"]]
    for row in rows:
        for part, scores in row.scores.items():
            shown = (scores.prediction.nrmse, scores.simulation.nrmse, scores.simulation.fit)
            cells.append([row.name, part, *(_numbers(values) for values in shown)])
    return table(cells, drop=["free-run FIT %"])


def _estimate(parameter: ParameterResult) -> str:
    if parameter.value is None:
        return "–"
    value, std, _, _ = estimate_cells(parameter.value, parameter.std)
    spread = f" ± {std}" if parameter.std is not None else ""
    bias = parameter.bias.value if parameter.bias and parameter.std is not None else None
    large = bias is not None and parameter.std is not None and abs(bias) > parameter.std
    return f"{value}{spread}{f' (bias {bias:+.2g})' if large else ''}"


def _numbers(values: Sequence[float | None] | None) -> str:
    return "–" if values is None else ", ".join("–" if v is None else f"{v:.4g}" for v in values)
