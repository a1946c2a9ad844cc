"""The sections of a comparison's page."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from orthaug._base.lines import digits_for
from orthaug.analysis.fit_findings import ParameterResult
from orthaug.models.response import Response
from orthaug.reports.page_blocks import Grid, Section, Table, Text, interval, number
from orthaug.reports.page_figures import parameter_comparison
from orthaug.reports.page_fit import (
    BIAS_CAPTION,
    Origin,
    bias_cell,
    origin_blocks,
    score_blocks,
    units_of_result,
)
from orthaug.reports.page_runs import compared_plots
from orthaug.reports.result import CompareResult, DifferenceResult
from orthaug.reports.text import setting_rows

_WORDS = {
    "helps": "the learner helps",
    "no_help": "the learner does not help",
    "hurts": "the learner hurts",
}


@dataclass(frozen=True, eq=False)
class ComparePage:
    """Additions to a comparison's result on its page."""

    origin: Origin
    result: CompareResult
    responses: Mapping[str, Mapping[str, Response]]
    """Free run of every part, by the name of the row."""

    @property
    def outputs(self) -> tuple[str, ...]:
        """Names of the outputs; free runs may be missing, where the data of a result are."""
        return tuple(self.result.spec["data"]["outputs"])


def compare_sections(page: ComparePage) -> list[Section]:
    """Return all sections; those without content in the result are left out."""
    result = page.result
    scores = {row.name: row.scores for row in result.comparison}
    found = [
        Section("models", "Models", _models(result)),
        Section("scores", "Scores", score_blocks(scores, page.outputs, units_of_result(result))),
        Section("parameters", "Parameters", _parameters(result)),
        Section("free-run", "Free run", list(compared_plots(page.responses))),
        Section("settings", "Settings that differ", _settings(result)),
        Section(
            "residuals",
            "Residual tests",
            [
                Text(f"{row.name}: {row.residuals.text}")
                for row in result.comparison
                if row.residuals is not None
            ],
            folded=True,
        ),
        Section(
            "warnings",
            "Warnings",
            [
                Text(f"{row.name}: {w.text}", "warning")
                for row in result.comparison
                for w in row.warnings
                if w not in result.warnings
            ],
        ),
        Section(
            "reproduce", "How to reproduce it", origin_blocks(page.origin, result), folded=True
        ),
    ]
    return [section for section in found if section.blocks]


def _models(result: CompareResult) -> list[Any]:
    rows = []
    for row in result.comparison:
        defect = row.orthogonality_defect
        shown = (
            "–" if defect is None else "0 up to rounding" if defect < 1e-10 else number(defect, 2)
        )
        verdict = (
            "–"
            if row.validation is None
            else _WORDS.get(row.validation.verdict, row.validation.verdict)
        )
        chosen = " (chosen)" if row.name == result.chosen else ""
        rows.append(
            [
                row.name + chosen,
                row.status.replace("_", " "),
                str(row.weights),
                number(row.learner_to_physics, 2),
                shown,
                number(row.seconds, 3),
                verdict,
            ]
        )
    head = [
        "model",
        "ended",
        "weights",
        "learner over physics",
        "overlap ‖QᵀF̃‖/‖F‖",
        "time [s]",
        "verdict",
    ]
    caption = (
        "Physics alone and every structure on the same data and seeds."
        if result.differences is None
        else "Saved results of the same data."
    )
    if result.chosen:
        caption += (
            " The chosen one has the lowest error on the validation part, unless its learner "
            "does not help."
        )
    blocks: list[Any] = [Table(caption, head, rows)]
    blocks += [
        Text(f"{row.name}: {row.validation.text}") for row in result.comparison if row.validation
    ]
    return blocks + [
        Text(f"Left out: {kind}: {why}", "note") for kind, why in result.left_out.items()
    ]


def _parameters(result: CompareResult) -> list[Any]:
    if not result.comparison or not result.comparison[0].parameters:
        return []
    rows = [(row.name, parameter) for row in result.comparison for parameter in row.parameters]
    biased = any(parameter.bias for _, parameter in rows)
    apart = {(one.result, one.name): one for one in result.differences or ()}
    if result.differences is not None:  # the same parameter of every result, side by side
        names = list(dict.fromkeys(parameter.name for _, parameter in rows))
        rows.sort(key=lambda row: names.index(row[1].name))
    rows = [
        [
            name,
            p.name,
            number(p.value, digits_for(p.value, p.std, 6)),
            p.shown_unit,
            number(p.std, 2, p.value),
            interval(p.ci95),
            *([bias_cell(p)] if biased else []),
            *(_difference_cells(apart.get((name, p.name)), p) if apart else []),
        ]
        for name, p in rows
    ]
    head = [
        "model",
        "parameter",
        "value",
        "unit",
        "standard error",
        "95 % interval",
        *(["bias"] if biased else []),
        *([f"less {result.comparison[0].name}", "in standard errors"] if apart else []),
    ]
    caption = f"What each model estimates.{BIAS_CAPTION if biased else ''}"
    if apart:
        caption += (
            " Differences are from the first model, also over the larger standard error of both: a "
            "size and no test, because both estimates have the same noise in them."
        )
    return [Grid(parameter_comparison(result.comparison)), Table(caption, head, rows)]


def _difference_cells(one: DifferenceResult | None, parameter: ParameterResult) -> list[str]:
    """Return the difference of a parameter from the first model, and its size."""
    if one is None:
        return ["–", "–"]
    return [number(one.value, 3, parameter.value), number(one.of_std, 2)]


def _settings(result: CompareResult) -> list[Any]:
    """Return the keys in which the specs of saved results differ."""
    if not result.settings:
        return []
    head, *rows = setting_rows(result)
    caption = "Keys of the specs whose values differ; a dash where the default holds."
    return [Table(caption, head, rows)]
