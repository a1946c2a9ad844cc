"""Content of recover.json: how often a rehearsal recovers the truth, and what would do better."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Literal

import numpy as np

from orthaug._base.checks import Vector
from orthaug._base.content import ByName, Content, Flag, Number, Numbers, Whole
from orthaug._base.errors import Warning
from orthaug._base.lines import cut, fold, plural, table
from orthaug.reports.result import DataResult, ResultHeader

DECLARED = "declared"
_CLEARLY = 0.7  # of the error as declared: a choice that errs less is named
_WIDTH = 80  # columns of the text
_SHOWN = 12  # choices and terms in the text; recover.json has all
_EXPLAINED = (
    "held: 95 % intervals for noise that hold the true value, of those that were shown; with "
    "bias: the same of the widest interval that is shown.",
    "silent: estimates whose intervals miss the true value though nothing warns.",
    "bias: mean error of the estimates; of std, bias/std: the same in standard errors. Of a term "
    "it is that of the parameter that errs most.",
    "width: median width of the interval for noise; 2 N: its width with twice the rows.",
)
_EXPLAINED_CHOICES = (
    "error of θ: median over the draws of the root mean square of the parameters' relative "
    "errors; over spec: the same divided by that of the spec. held: as above."
)
_HALF_WIDTH = 1.0  # half widths: a bias beyond that no further row cures


class PlantedResult(Content):
    """A term that was planted, and how the draws with it went."""

    name: str
    source: Literal["declared", "usual", "memory"]
    expression: str
    memory: str | None
    place: str | None
    coefficient: Number
    draws: Whole
    shown: Whole
    """Intervals that were shown, over the draws and parameters."""
    held: Whole
    """Intervals that hold the truth."""
    held_with_bias: Whole
    """The same, of the widest interval that is shown of a parameter."""
    silent: Whole
    largest_bias: Number
    """Largest mean bias of a parameter, in median standard errors."""


class LeftOutResult(Content):
    """A term that was not planted, and why."""

    name: str
    reason: str


class RecoveredResult(Content):
    """A parameter over all draws."""

    name: str
    unit: str
    true: Number
    draws: Whole
    """Draws whose fit did not fail."""
    shown: Whole
    """Draws in which an interval was shown; in the others it was withheld."""
    held: Whole
    held_with_bias: Whole
    silent: Whole
    bias: Number
    bias_in_errors: Number
    spread: Number
    """Standard deviation of the estimate over the draws."""
    width: Number
    """Median width of the 95 % interval for noise."""
    width_with_bias: Number
    width_twice: Number
    """`width` times the ratio of median widths with twice the rows, on draws that have both."""
    rows_for_half: Whole
    """Rows by which the interval for noise would be half as wide, by 1/√N."""
    more_rows_help: Flag | None
    """False where the bias is larger than half the width: rows do not lower it."""


class ChosenResult(Content):
    """A parameter under another choice."""

    name: str
    draws: Whole
    shown: Whole
    held: Whole
    bias: Number
    width: Number


class ChoiceResult(Content):
    """Another choice, on the draws where it was fitted."""

    kind: Literal["declared", "structure", "measure", "inputs", "rows", "input"]
    name: str
    draws: Whole
    error: Number
    """Median over draws of the root mean square of the parameters' relative errors."""
    over_declared: Number
    """The error over that of the fit as declared, on the same draws."""
    parameters: list[ChosenResult]


class NoiseOfDraws(Content):
    """The noise that was simulated: where it enters, and its standard deviation by output."""

    enters: Literal["equation", "output"]
    std: ByName


class IntervalsOfDraw(Content):
    """Intervals of a parameter in one draw."""

    value: Number
    ci95: Numbers | None
    with_bias: Numbers | None
    warned: Flag
    held: Flag | None
    held_with_bias: Flag | None


class DrawResult(Content):
    """A draw: its term and its parameters; without parameters where training failed."""

    draw: Whole
    term: str
    warnings: list[str]
    verdict: str | None
    parameters: dict[str, IntervalsOfDraw]


class RecoverResult(ResultHeader):
    """The result of `orthaug recover`."""

    absent: ClassVar = frozenset({"physics_only"})

    spec: dict[str, Any]
    data: DataResult
    draws: Whole
    seed: Whole
    share: Number
    rows: Whole
    compared: Whole
    noise: NoiseOfDraws
    parameters: list[RecoveredResult]
    terms: list[PlantedResult]
    left_out: list[LeftOutResult]
    choices: list[ChoiceResult]
    outcomes: list[DrawResult]
    physics_only: Flag | None = None
    """True if the spec has no learner, as large as which terms would be."""
    designs: Flag
    """True if the spec has a [design], whose input is among the choices."""
    seconds: Number
    stored: Whole
    """Draws that were read from the folder."""
    text: list[str]
    warnings: list[Warning]

    @classmethod
    def of(
        cls,
        facts: Mapping[str, Any],
        true: Mapping[str, float],
        units: Mapping[str, str],
        planted: Sequence[Mapping[str, object]],
        outcomes: Sequence[Mapping[str, object]],
    ) -> RecoverResult:
        """Return the content from what every draw gave.

        Args:
            facts: the fields of the result that do not depend on the draws.
            true: the true parameters by name.
            units: of parameters, by name.
            planted: name, source, expression, memory, place and coefficient of each term.
            outcomes: number of the term, and rows with `kind`, `name` and `parameters`.
        """
        drawn = [_draw(i, one, planted, true) for i, one in enumerate(outcomes)]
        choices = _choices(outcomes, true)
        twice = {
            kind: next((c for c in choices if c["kind"] == kind), None)
            for kind in (DECLARED, "rows")
        }
        parameters = [
            _recovered(name, units.get(name, ""), value, drawn, outcomes, facts["rows"], twice)
            for name, value in true.items()
        ]
        terms = [_term(i, one, drawn, outcomes, true) for i, one in enumerate(planted)]
        found = {**facts, "parameters": parameters, "terms": terms, "choices": choices}
        text = _sentences(found)
        return cls.model_validate({**found, "outcomes": drawn, "text": text})


def _inside(limits: Sequence[float | None] | None, value: float) -> bool:
    """Return whether an interval holds a value; an end that is None has no bound."""
    if limits is None:
        return False
    low, high = limits
    return (low is None or low <= value) and (high is None or value <= high)


def _draw(
    number: int,
    outcome: Mapping[str, Any],
    planted: Sequence[Mapping[str, Any]],
    true: Mapping[str, float],
) -> dict[str, object]:
    """Return what a draw shows of each parameter, and whether that holds the truth."""
    first, found = outcome["rows"][0], {}
    for name, row in first["parameters"].items():
        own = {key: row[key] for key in ("value", "ci95", "with_bias", "warned")}
        wide = [limits for limits in (row["ci95"], row["with_bias"], row["profile"]) if limits]
        own["held"] = _inside(row["ci95"], true[name]) if row["ci95"] else None
        own["held_with_bias"] = (
            any(_inside(limits, true[name]) for limits in wide) if wide else None
        )
        found[name] = own
    name = planted[outcome["term"]]["name"]
    own = {"warnings": first["warnings"], "verdict": first["verdict"], "parameters": found}
    return {"draw": number, "term": name} | own


def _is_silent(row: Mapping[str, object]) -> bool:
    return row["held_with_bias"] is False and not row["warned"]


def _recovered(
    name: str,
    unit: str,
    true: float,
    drawn: Sequence[Mapping[str, Any]],
    outcomes: Sequence[Mapping[str, Any]],
    rows: int,
    twice: Mapping[str, Mapping[str, Any] | None],
) -> dict[str, object]:
    """Return the row of a parameter.

    Args:
        twice: the choices "declared" and "rows", on the draws where both were fitted.
    """
    own = [one["parameters"][name] for one in drawn if name in one["parameters"]]
    values = np.array([row["value"] for row in own if row["value"] is not None], dtype=float)
    std = [one["rows"][0]["parameters"].get(name, {}).get("std") for one in outcomes]
    error, bias = (
        _median([s for s in std if s]),
        float(np.mean(values) - true) if len(values) else None,
    )
    width = _median([_width(row["ci95"]) for row in own])
    once, more = (
        next((p["width"] for p in (choice or {}).get("parameters", ()) if p["name"] == name), None)
        for choice in (twice[DECLARED], twice["rows"])
    )
    wide = width * more / once if width and more and once else None
    helps = None if bias is None or not width else abs(bias) <= _HALF_WIDTH * width / 2
    return {
        "name": name,
        "unit": unit,
        "true": true,
        "draws": len(own),
        "shown": sum(row["held"] is not None for row in own),
        "held": sum(row["held"] is True for row in own),
        "held_with_bias": sum(row["held_with_bias"] is True for row in own),
        "silent": sum(map(_is_silent, own)),
        "bias": bias,
        "bias_in_errors": None if bias is None or not error else bias / error,
        "spread": float(values.std(ddof=1)) if len(values) > 1 else None,
        "width": width,
        "width_with_bias": _median([_width(row["with_bias"] or row["ci95"]) for row in own]),
        "width_twice": wide,
        "rows_for_half": 4 * rows,
        "more_rows_help": helps,
    }


def _width(limits: Sequence[float | None] | None) -> float | None:
    if limits is None or None in limits:
        return None
    low, high = limits
    return float(high - low)  # type: ignore[operator]  (no None)


def _median(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None and np.isfinite(value)]
    return float(np.median(known)) if known else None


def _term(
    number: int,
    planted: Mapping[str, object],
    drawn: Sequence[Mapping[str, Any]],
    outcomes: Sequence[Mapping[str, Any]],
    true: Mapping[str, float],
) -> dict[str, object]:
    """Return the row of a planted term."""
    pairs = [pair for pair in zip(drawn, outcomes, strict=True) if pair[1]["term"] == number]
    rows = [row for one, _ in pairs for row in one["parameters"].values()]
    biases = []
    for name, value in true.items():
        own = [outcome["rows"][0]["parameters"].get(name) for _, outcome in pairs]
        error = _median([row["std"] for row in own if row and row["std"]])
        shift = [row["value"] - value for row in own if row and row["value"] is not None]
        if error and shift:
            biases.append(float(np.mean(shift)) / error)
    return {
        **planted,
        "draws": len(pairs),
        "shown": sum(row["held"] is not None for row in rows),
        "held": sum(row["held"] is True for row in rows),
        "held_with_bias": sum(row["held_with_bias"] is True for row in rows),
        "silent": sum(map(_is_silent, rows)),
        "largest_bias": max(biases, key=abs, default=None),
    }


def _relative_error(parameters: Mapping[str, Any], true: Mapping[str, float]) -> float | None:
    """Return the root mean square of the relative errors of θ in one fit."""
    errors = [
        (row["value"] - true[name]) / true[name]
        for name, row in parameters.items()
        if true.get(name) and row["value"] is not None
    ]
    return float(np.sqrt(np.mean(np.square(errors)))) if errors else None


def _choices(
    outcomes: Sequence[Mapping[str, Any]], true: Mapping[str, float]
) -> list[dict[str, object]]:
    """Return the row of every choice, the declared one first, the others by their error."""
    compared = [one for one in outcomes if len(one["rows"]) > 1]
    names = dict.fromkeys((row["kind"], row["name"]) for one in compared for row in one["rows"])
    found = []
    for kind, name in names:
        pairs = []
        for one in compared:
            own = next((r for r in one["rows"] if (r["kind"], r["name"]) == (kind, name)), None)
            if own is not None and own["parameters"] and one["rows"][0]["parameters"]:
                pairs.append((own["parameters"], one["rows"][0]["parameters"]))
        if not pairs:
            continue
        error, base = (_median([_relative_error(pair[i], true) for pair in pairs]) for i in (0, 1))
        ratio = None if error is None or not base else error / base
        parameters = [_chosen(p, value, [pair[0] for pair in pairs]) for p, value in true.items()]
        own = {"draws": len(pairs), "error": error, "over_declared": ratio}
        found.append({"kind": kind, "name": name, "parameters": parameters} | own)
    return sorted(
        found, key=lambda c: (c["kind"] != DECLARED, np.inf if c["error"] is None else c["error"])
    )


def _chosen(name: str, true: float, fits: Sequence[Mapping[str, Any]]) -> dict[str, object]:
    own = [fit[name] for fit in fits if name in fit]
    shifts = [row["value"] - true for row in own if row["value"] is not None]
    return {
        "name": name,
        "draws": len(own),
        "shown": sum(row["ci95"] is not None for row in own),
        "held": sum(_inside(row["ci95"], true) for row in own),
        "bias": float(np.mean(shifts)) if shifts else None,
        "width": _median([_width(row["ci95"]) for row in own]),
    }


def _sentences(found: Mapping[str, Any]) -> list[str]:
    """Return what follows from the tables, in sentences."""
    rows = found["parameters"]
    silent, fits = sum(row["silent"] for row in rows), sum(row["draws"] for row in rows)
    held, shown = (sum(row[key] for row in rows) for key in ("held_with_bias", "shown"))
    sentences = [
        f"{held} of {shown} intervals hold the truth where the bias is counted; {silent} of {fits} "
        "miss it and nothing warns."
    ]
    if shown < fits:
        sentences.append(f"{fits - shown} of {fits} estimates have no interval.")
    stuck = [row["name"] for row in rows if row["more_rows_help"] is False]
    if stuck:
        bias = "its bias is" if len(stuck) == 1 else "their biases are"
        sentences.append(
            f"More rows do not help {', '.join(stuck)}: {bias} larger than half the interval."
        )
    sentences += _better(found["choices"])
    if not found["designs"]:
        sentences.append(
            "To compare another input, add [design] to the spec: its input joins the table."
        )
    return sentences


def _better(choices: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return a sentence on the choice that errs least, of those that change no data."""
    found = []
    for kinds, what in (
        (("structure", "measure", "inputs"), "On these data the least error of θ has"),
        (("input",), "Of other data, less error of θ has"),
    ):
        own = [c for c in choices if c["kind"] in kinds and c["over_declared"] is not None]
        best = min(own, key=lambda c: c["over_declared"], default=None)
        if best is not None and best["over_declared"] < _CLEARLY:
            name, ratio = _choice_words(best["kind"], best["name"]), best["over_declared"]
            found.append(f"{what} {name}: {ratio:.2g} times that of the spec.")
        elif own and kinds[0] == "structure":
            found.append(
                "No structure, measure or learner input does clearly better than the spec."
            )
    return found


def _choice_words(kind: str, name: str) -> str:
    before = {"structure": "structure ", "measure": "measure ", "inputs": "learner on "}
    return f"{before.get(kind, '')}{name}"


def _number(value: float | None, digits: int = 3) -> str:
    return "–" if value is None else f"{value:.{digits}g}"


def recover_text(result: RecoverResult) -> str:
    """Return the tables and what follows from them."""
    noise = ", ".join(f"{name} {_number(value)}" for name, value in result.noise.std.items())
    place = "the equation" if result.noise.enters == "equation" else "the outputs"
    size = "as large as the learner"
    if result.physics_only:
        size = "as large as the noise, or 2 % of the physics"
    if result.share is not None:
        size = f"{result.share:g} of the physics"
    lines = [
        f"rehearsal   {plural(result.draws, 'draw')} of {plural(result.rows, 'row')}, seed "
        f"{result.seed}" + (f", {result.stored} read from the folder" if result.stored else ""),
        f"truth       the fitted physics with one of {plural(len(result.terms), 'term')}, {size}",
        f"noise       in {place}, standard deviation {noise}",
        "",
        *_parameter_table(result),
        "",
        *_term_table(result),
        "",
        *_EXPLAINED,
    ]
    if result.choices:
        lines += ["", *_choice_table(result), "", _EXPLAINED_CHOICES]
    lines += ["", *result.text]
    lines += [f"left out: {one.name}: {one.reason}." for one in result.left_out]
    lines += [f"warning: {warning.text}" for warning in result.warnings]
    return "\n".join(fold(lines, _WIDTH))


def _parameter_table(result: RecoverResult) -> list[str]:
    head = ["parameter", "true", "held", "with bias", "silent", "bias", "of std", "width", "2 N"]
    rows = [head]
    for row in result.parameters:
        own = [f"{row.held}/{row.shown}", f"{row.held_with_bias}/{row.shown}", str(row.silent)]
        size = [_number(row.bias, 2), _number(row.bias_in_errors, 2)]
        widths = [_number(row.width, 2), _number(row.width_twice, 2)]
        rows.append([row.name, _number(row.true), *own, *size, *widths])
    return table(rows, _WIDTH)


def _term_table(result: RecoverResult) -> list[str]:
    rows = [["planted term", "draws", "held", "with bias", "silent", "bias/std"]]
    for row in result.terms:
        if row.draws:
            own = [str(row.draws), f"{row.held}/{row.shown}", f"{row.held_with_bias}/{row.shown}"]
            rows.append([cut(row.name, 34), *own, str(row.silent), _number(row.largest_bias, 2)])
    hidden = len(rows) - 1 - _SHOWN
    lines = table(rows[: _SHOWN + 1], _WIDTH)
    return [*lines, f"… and {plural(hidden, 'term')} more"] if hidden > 0 else lines


def _choice_table(result: RecoverResult) -> list[str]:
    rows = [["choice", "draws", "error of θ", "over spec", "held"]]
    for choice in result.choices[: _SHOWN + 4]:
        held, shown = (sum(getattr(p, key) for p in choice.parameters) for key in ("held", "shown"))
        error = "–" if choice.error is None else f"{100 * choice.error:.3g} %"
        own = [str(choice.draws), error, _number(choice.over_declared), f"{held}/{shown}"]
        rows.append([cut(_choice_words(choice.kind, choice.name), 40), *own])
    return table(rows, _WIDTH)


def relative_errors(result: RecoverResult, name: str) -> tuple[Vector, Vector, Vector]:
    """Return value, interval and interval with the bias of a parameter in every draw.

    They are errors over the true value, (n,), (n, 2), (n, 2), NaN where there is none.
    """
    true = next(row.true for row in result.parameters if row.name == name) or 0.0
    unit = abs(true) or 1.0
    nothing = [np.nan, np.nan]
    rows = [one.parameters.get(name) for one in result.outcomes]
    value = np.array([np.nan if row is None or row.value is None else row.value for row in rows])
    limits = [
        np.array(
            [
                nothing if row is None or not getattr(row, key) else getattr(row, key)
                for row in rows
            ],
            dtype=float,
        )
        for key in ("ci95", "with_bias")
    ]
    return (value - true) / unit, (limits[0] - true) / unit, (limits[1] - true) / unit
