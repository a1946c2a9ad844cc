"""The findings of a fit on its page: residual tests, stability, excitation, suspects, restarts."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from orthaug._base.lines import with_unit
from orthaug.analysis.residual_tests import ResidualTestResult
from orthaug.physics.parameters import time_unit
from orthaug.reports.biases import REMOVED_BY
from orthaug.reports.page_blocks import Grid, Table, Text, chance, number, percent
from orthaug.reports.page_figures import bias_plot, residual_plots, restart_plot
from orthaug.reports.result import FitResult


def residuals_blocks(result: FitResult, units: Mapping[str, str]) -> list[Any]:
    """Return the residual tests, output by output; units by channel."""
    blocks: list[Any] = []
    found = result.residuals
    if found is None:
        reason = next((w.text for w in result.warnings if w.code == "residual_not_analysed"), "")
        blocks += [Text(reason)] if reason else []
    else:
        blocks.append(Text(found.text))
        tests = [
            ("one-step residual", found.one_step),
            ("error of the free run", found.free_run or []),
        ]
        rows = [_test_cells(what, test, units) for what, group in tests for test in group]
        head = [
            "residual",
            "RMS",
            "mean",
            "white",
            "Ljung-Box p",
            "largest autocorrelation",
            "follows",
            "curved over",
        ]
        blocks.append(
            Table(
                "Tests of the residuals on the training data, at the levels that the result "
                "gives; RMS and mean are in the output's unit.",
                head,
                rows,
            )
        )
        blocks += [
            Grid(plots)
            for what, group in tests
            for test in group
            if (plots := residual_plots(test, what, units))
        ]
    blocks += [Text(result.missing_lags.text)] if result.missing_lags else []
    return blocks


def _test_cells(what: str, test: ResidualTestResult, units: Mapping[str, str]) -> list[str]:
    white = {True: "yes", False: "no", None: "–"}[test.white]
    return [
        f"{what} of {with_unit(test.name, units.get(test.name))}",
        number(test.rms, 3),
        number(test.mean, 2, test.rms),
        white,
        chance(test.ljung_box.p) if test.ljung_box else "–",
        number(test.strongest_acf, 2, 1.0),
        ", ".join(test.correlated_inputs) or "no input",
        ", ".join(test.curved_regressors) or "nothing",
    ]


def stability_blocks(result: FitResult) -> list[Any]:
    """Return the findings on the free run's stability."""
    found = result.stability
    if found is None:
        return []
    blocks: list[Any] = [Text(line) for line in found.text.splitlines() if line.strip()]
    rows: list[list[str]] = []
    if found.feedback:
        f = found.feedback
        rows += [
            ["local spectral radius, largest", number(f.largest, 4)],
            ["its median", number(f.median, 4)],
            ["steps on which it is above 1", percent(f.share_above_one)],
        ]
    if found.contraction:
        rows.append(["rate of the best norm", number(found.contraction.rate, 4)])
    if found.modes:
        m, rate = found.modes, f"1/{time_unit(one.unit for one in result.parameters)}"
        slow, fast = number(m.slowest, 3), number(m.fastest, 3)
        modes = (
            [f"modes [{rate}]", f"all at {slow}"]
            if slow == fast
            else [f"slowest and fastest mode [{rate}]", f"{slow} and {fast}"]
        )
        rows += [
            [f"rightmost eigenvalue, real part [{rate}]", number(m.rightmost, 4, m.fastest)],
            modes,
            *(
                [["integrators, which are not among these", str(m.integrators)]]
                if m.integrators
                else []
            ),
            ["points with a growing mode", percent(m.growing)],
        ]
    if found.diverges_at is not None or found.searched is not None:
        at = "none found" if found.diverges_at is None else number(found.diverges_at, 4)
        rows.append(
            [
                "factor on the inputs at which the run diverges (searched to "
                f"{number(found.searched, 4)})",
                at,
            ]
        )
    return (
        [*blocks, Table("Evidence on the free run's stability.", ["measure", "value"], rows)]
        if rows
        else blocks
    )


def excitation_blocks(result: FitResult) -> list[Any]:
    """Return how well the data identify the parameters, and the bias by each suspected term."""
    seen = result.excitation
    alone = "Without a learner the" if result.learns else "The"
    text = f"{alone} data determine {seen.rank} of {seen.columns} parameters; "
    text += f"the condition number is {number(seen.condition, 3)}."
    if result.orthogonality_defect is not None:
        small = result.orthogonality_defect < 1e-10
        shown = "0 up to rounding" if small else number(result.orthogonality_defect, 2)
        text += f" The overlap of physics and learner, ‖QᵀF̃‖/‖F‖, is {shown}."
    blocks: list[Any] = [Text(text)]
    if result.measure_detail:
        detail = result.measure_detail
        blocks.append(
            Text(
                f"θ was split under the {detail.kind} measure, {detail.points} points"
                + (
                    "."
                    if detail.support is None
                    else f", {percent(detail.support)} within the range of the data."
                )
            )
        )
    if result.bias:
        head = ["suspect", "expression", "explains of the learner", "cosine with the physics"]
        rows = [
            [s.name, s.expression, percent(s.explained), number(s.cosine, 3, 1.0)]
            for s in result.bias
        ]
        caption = "Terms that may be missing from the physics."
        if any(s.removed_by for s in result.bias):
            caption += f" {REMOVED_BY}"
            head = [*head, "removed by"]
            rows = [[*row, s.removed_by or "–"] for row, s in zip(rows, result.bias, strict=True)]
        else:
            caption += (
                " `orthaug check` shows whether a measure removes their bias from the parameters."
            )
        blocks.append(Table(caption, head, rows))
        if result.bias[0].percent:
            blocks.append(bias_plot(result.bias))
    return blocks


def _sentence(text: str) -> str:
    return f"{text[0].upper()}{text[1:].rstrip('.')}." if text else ""


_CHOOSES = {
    "score": "score, generalised cross-validation: the loss, raised with the number of weights "
    "that a run uses",
    "validation": "error on data that were not fitted",
}


def restarts_blocks(result: FitResult) -> list[Any]:
    """Return how training ended, from every start."""
    status = result.status
    text = (
        f"Training ended with “{status.code.replace('_', ' ')}” after {status.iterations} "
        f"iterations and {number(status.seconds, 3)} s. {_sentence(status.message)}"
    )
    fall = (
        f" The loss is {number(status.loss, 4)}; that of physics alone was "
        f"{number(status.start_loss, 4)}."
    )
    runs, caption = result.restarts, "Every run from its own initial weights."
    by = [name for name in _CHOOSES if any(getattr(r, name) is not None for r in runs)]
    if by and sum(r.chosen for r in runs) == 1 < len(runs):
        caption += f" The chosen one has the lowest {_CHOOSES[by[0]]}."
    head = ["seed", "regularization", "loss", *by, "iterations", "ended", "chosen"]
    rows = [
        [
            str(r.seed),
            str(r.regularization),
            number(r.loss),
            *(number(getattr(r, name)) for name in by),
        ]
        + [str(r.iterations), r.code.replace("_", " "), "yes" if r.chosen else "no"]
        for r in runs
    ]
    blocks: list[Any] = [Text(text + fall)]
    plot = restart_plot(result.restarts)
    blocks += [plot] if plot else []
    return blocks + ([Table(caption, head, rows)] if rows else [])
