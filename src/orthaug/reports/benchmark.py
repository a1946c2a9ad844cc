"""Content of benchmark.json: public data sets in their protocols, ours beside published figures."""

from __future__ import annotations

from collections.abc import Iterator
from typing import ClassVar, Literal

from orthaug._base.content import ByName, Content, Number, Whole
from orthaug._base.lines import digits_for, fold, plain_number, plural, table
from orthaug.reports.result import DataResult, ParameterResult, ResultHeader

FitKind = Literal["physics alone", "default", "declared"]
VerdictCode = Literal["ahead", "behind", "no published figure"]
_WIDTH = 80  # columns of the text
_SHOWN = 3  # published models in the text; benchmark.json has all


class ErrorResult(Content):
    """RMSE of a free run on the scored rows of a test; null where the run diverged."""

    test: str
    output: str
    unit: str
    rmse: Number


class BenchmarkModelResult(Content):
    """A model of a set: physics alone, with nothing chosen beyond physics, or as declared."""

    absent: ClassVar = frozenset({"error"})

    model: str
    """Name of the physics in the declaration of the set."""
    fit: FitKind
    status: str
    errors: list[ErrorResult]
    unknowns: Whole
    """Parameters of the physics and weights of the learner."""
    seconds: Number
    """Of training, scoring and intervals, compilation included."""
    parameters: list[ParameterResult]
    warnings: list[str]
    """Codes of the warnings."""
    error: str | None = None
    """Why there is no model."""

    @property
    def in_words(self) -> str:
        """Errors and seconds, for a line of progress."""
        errors = (f"{e.test} {e.output} {_figure(e.rmse)} {e.unit}".rstrip() for e in self.errors)
        return f"{', '.join(errors) or self.status}; {_figure(self.seconds)} s"


class PublishedResult(Content):
    """RMSE that somebody published, by test."""

    model: str
    source: str
    errors: ByName


class BesideResult(Content):
    """Another package on the same rows in the same run, or why it has no figure."""

    package: str
    version: str | None = None
    what: str = ""
    errors: list[ErrorResult] = []
    unknowns: Whole | None = None
    seconds: Number = None
    text: str = ""
    """Empty where it has figures."""


class VerdictResult(Content):
    """The model that is entered against the best published one, on a test."""

    test: str
    unit: str
    ours: Number
    published: Number
    by: str | None
    verdict: VerdictCode | None


class SetResult(Content):
    """A data set with all that was measured on it."""

    name: str
    title: str
    source: str
    protocol: str
    text: str
    """Why it was not measured; empty where it was."""
    data: DataResult | None
    models: list[BenchmarkModelResult]
    published: list[PublishedResult]
    beside: list[BesideResult]
    verdicts: list[VerdictResult]
    verdict: VerdictCode | None
    """Ahead only where the entered model is ahead on every test with a published figure."""

    @property
    def entered(self) -> str | None:
        """Name of the model that the verdict is about: the first that is declared."""
        return self.models[0].model if self.models else None


class BenchmarkResult(ResultHeader):
    """The result of `orthaug benchmark`."""

    date: str
    machine: str
    versions: dict[str, str]
    sets: list[SetResult]


def benchmark_text(result: BenchmarkResult) -> str:
    """Return tables of at most 80 columns: a line a model, and what is ahead or behind."""
    lines = [line for one in result.sets for line in (*_set_lines(one), "")]
    lines += _summary(result)
    return "\n".join(fold(lines, _WIDTH))


def list_text(sets: list[SetResult]) -> str:
    """Return sets with their protocols and published figures, as `--list` prints them."""
    lines: list[str] = []
    for one in sets:
        lines += [f"{one.name}: {one.title}", f"  source: {one.source}", f"  {one.protocol}"]
        lines += [_published_line(entry, one) for entry in one.published] or [
            "  published: no figure by this protocol that was verified"
        ]
        lines.append("")
    return "\n".join(fold(lines[:-1], _WIDTH))


def _published_line(entry: PublishedResult, one: SetResult) -> str:
    unit = next((verdict.unit for verdict in one.verdicts), "")
    figures = ", ".join(
        f"{test} {_figure(rmse)}{f' {unit}' if unit else ''}" for test, rmse in entry.errors.items()
    )
    return f"  published: {figures} by {entry.model} ({entry.source})"


def _set_lines(one: SetResult) -> Iterator[str]:
    yield f"{one.title} ({one.name})"
    yield one.protocol
    if one.text:
        yield one.text
        return
    tests = list(dict.fromkeys((e.test, e.output, e.unit) for m in one.models for e in m.errors))
    several = len({output for _, output, _ in tests}) > 1
    units = {unit for *_, unit in tests}
    one_unit = f", {min(units)}" if len(units) == 1 and min(units) else ""
    heads = [
        f"{output if several else test}{f', {unit}' if unit and not one_unit else ''}"
        for test, output, unit in tests
    ]
    rows = [[f"RMSE of the free run{one_unit}", *heads, "unknowns", "s"]]
    for model in one.models:
        named = model.fit if model.fit != "declared" else f"declared{_mark(model, one)}"
        rows.append(
            [f"{model.model}: {named}", *_figures(model.errors, tests), str(model.unknowns),
             _figure(model.seconds)]
        )  # fmt: skip
    for other in (other for other in one.beside if not other.text):
        count = "" if other.unknowns is None else str(other.unknowns)
        figures = _figures(other.errors, tests)
        rows.append([f"{other.package}: {other.what}", *figures, count, _figure(other.seconds)])
    for entry in one.published[:_SHOWN]:
        figures = [
            _figure(entry.errors[test]) if test in entry.errors else "" for test, *_ in tests
        ]
        rows.append([f"published: {entry.model}", *figures, "", ""])
    yield from table(rows, _WIDTH)
    for model in one.models:
        if model.error:
            yield f"{model.model}, {model.fit}: {model.error}"
    yield from _parameter_lines(one)
    for other in (other for other in one.beside if other.text):
        yield f"{other.package}: {other.text}"
    yield f"verdict: {_verdict_text(one)}"


def _mark(model: BenchmarkModelResult, one: SetResult) -> str:
    return " *" if model.model == one.entered else ""


def _figures(errors: list[ErrorResult], tests: list[tuple[str, str, str]]) -> list[str]:
    found = {(e.test, e.output, e.unit): e.rmse for e in errors}
    return [_figure(found[test]) if test in found else "" for test in tests]


def _figure(value: float | None) -> str:
    return "none" if value is None else plain_number(value, 3)


def _parameter_lines(one: SetResult) -> Iterator[str]:
    """Yield the parameters of each physics that have an interval, as declared, else alone."""
    for name in dict.fromkeys(model.model for model in one.models):
        fits = {model.fit: model for model in one.models if model.model == name}
        for kind in (kind for kind in ("declared", "physics alone") if kind in fits):
            shown = [row for row in fits[kind].parameters if row.ci95 is not None]
            if shown:
                words = "; ".join(map(_parameter, shown))
                yield f"{name}, {kind}, parameters with 95 % intervals: {words}"
                break


def _parameter(row: ParameterResult) -> str:
    low, high = row.ci95_with_bias or row.ci95 or (None, None)
    digits = digits_for(row.value, row.std, 3)
    ends = ", ".join("none" if end is None else plain_number(end, digits) for end in (low, high))
    value = "none" if row.value is None else plain_number(row.value, digits)
    unit = f" {row.unit}" if row.unit not in ("", "1") else ""
    counts = " (noise only)" if row.ci95_counts and not row.ci95_with_bias else ""
    return f"{row.name} {value} [{ends}]{unit}{counts}"


def _verdict_text(one: SetResult) -> str:
    if one.verdict in (None, "no published figure"):
        return "no published figure by this protocol was verified"
    ahead = [v.test for v in one.verdicts if v.verdict == "ahead"]
    behind = [f"{v.test} (by {v.by})" for v in one.verdicts if v.verdict == "behind"]
    parts = [f"ahead on {', '.join(ahead)}"] if ahead else []
    parts += [f"behind on {', '.join(behind)}"] if behind else []
    return f"{'; '.join(parts)}"


def _summary(result: BenchmarkResult) -> Iterator[str]:
    counts = {
        code: [one.name for one in result.sets if one.verdict == code]
        for code in ("ahead", "behind", "no published figure")
    }
    for code, names in counts.items():
        if names:
            yield f"{code}: {', '.join(names)}"
    missing = [one.name for one in result.sets if one.text]
    if missing:
        yield f"not measured: {plural(len(missing), 'set')}, {', '.join(missing)}"
    yield "* the model that is entered against published figures: the first that is declared"
    yield f"{result.date}, {result.machine}"
