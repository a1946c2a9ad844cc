"""Figures of findings: which biases are shown and how, and the residual over the regressor that the tests name."""

from __future__ import annotations

import json

import matplotlib.image
import numpy as np
import pytest
from matplotlib.figure import Figure
from scipy.signal import lfilter

from orthaug.analysis.findings import SuspectResult
from orthaug.analysis.residual_tests import ResidualTestResult
from orthaug.analysis.residuals import against_regressor, analyse
from orthaug.reports import plots
from orthaug.reports.biases import bias_map
from orthaug.reports.finding_plots import bias_figure, residual_analysis_figure
from orthaug.reports.page_figures import bias_plot, residual_plots

UNITS = {"speed": "rad/s", "voltage": "V", "current": "A"}


def drawn(figure: Figure, path) -> bool:
    """Whether a figure becomes a picture that is not blank."""
    plots.save(figure, path)
    return bool(matplotlib.image.imread(path)[..., :3].std() > 0.01)


def suspect(name: str, shares: dict[str, float | None]) -> SuspectResult:
    """A suspect with biases in per cent."""
    unknown = dict.fromkeys(("relative_physical_bias", "expected_physical_bias"))
    relative = {key: None if share is None else share / 100 for key, share in shares.items()}
    return SuspectResult.model_construct(
        name=name, relative_bias=relative, coefficient=1.0, size=1.0, **unknown
    )


@pytest.mark.parametrize(
    ("rows", "columns", "kept"), [(5, 3, (5, 3)), (40, 8, (25, 8)), (1, 300, (1, 12))]
)
def test_of_many_biases_the_largest_have_numbers(tmp_path, rows, columns, kept):
    rng = np.random.default_rng(0)
    shares = rng.permutation(np.arange(1.0, rows * columns + 1)).reshape(rows, columns)
    many = [
        suspect(f"term {i}", {f"c{j}": v for j, v in enumerate(row)})
        for i, row in enumerate(shares)
    ]
    shown = bias_map(many)
    assert shown.shares.shape == kept and shares.max() in shown.shares
    left = shares.max(axis=1)[[f"term {i}" not in shown.suspects for i in range(rows)]]
    assert len(left) == rows - kept[0] and left.max(initial=0.0) <= shown.shares.max(axis=1).min()
    assert ("result.json has all" in shown.left_out) == (kept != (rows, columns))
    assert (f"{kept[0]} of {rows} suspects" in shown.left_out) == (kept[0] < rows)
    assert list(shown.suspects) == [one.name for one in many if one.name in shown.suspects], (
        "in their order"
    )
    figure, page = bias_figure(many), bias_plot(many)
    assert len(figure.axes[0].texts) == shown.shares.size and "logarithmic" in figure.get_suptitle()
    assert page.traces[0]["text"] == shown.cells and "logarithmic" in page.caption
    assert page.caption.endswith(shown.left_out or "logarithmic.")
    assert page.layout["xaxis"]["tickvals"] == list(shown.parameters)
    assert drawn(figure, tmp_path / "figure.png")


def test_a_cell_has_no_sign_of_zero_and_says_that_there_is_no_bias():
    shares = {"a": 0.0, "b": 1e-9, "c": 0.002, "d": -12.3, "e": None, "f": 1230.0}
    assert bias_map([suspect("drag", shares)]).cells == [["0", "0", "< 0.01", "−12", "–", "+1200"]]
    assert bias_map([suspect("drag", {"a": None})]).reach > 0


def test_a_bias_without_a_guess_has_the_sign_and_the_size_of_what_the_learner_found():
    found = suspect("tanh(v)", {"c": -14.0, "m": 0.0}).model_copy(
        update={"coefficient": None, "size": 0.05, "coefficient_found": -4.0, "explained": 0.99}
    )
    assert found.percent == pytest.approx({"c": 2.8, "m": 0.0})  # 56 % are 20 times as much
    assert found.model_copy(update={"coefficient_found": None}).percent["c"] == pytest.approx(-2.8)
    for text in (bias_plot([found]).caption, bias_figure([found]).get_suptitle()):
        assert "whose RMS is 1 % of the output's standard deviation" in text
        assert "The learner found tanh(v) 20 times as large, and so is its bias." in text
    guessed = bias_plot([suspect("drag", {"c": 1.0})]).caption
    assert "RMS" not in guessed and "The learner found" not in guessed


def analysed(e: np.ndarray, x: dict[str, np.ndarray]) -> ResidualTestResult:
    columns = np.stack(list(x.values()), axis=1)
    (found,) = analyse([e[:, None]], [columns], [columns], ["speed"], list(x), list(x))
    return ResidualTestResult.model_validate(found)


def slow_and_curved() -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """A slow error that a slow regressor explains by chance, and a small curve over a quick one."""
    rng = np.random.default_rng(4)
    slow, e = (lfilter([1.0], [1.0, -0.98], one) for one in rng.normal(size=(2, 4000)))
    quick = rng.normal(size=4000)
    return e + 0.3 * quick**2 + 0.4 * slow, {"current[k-1]": e + slow, "voltage[k-1]": quick}


def test_what_the_tests_name_is_drawn_and_not_what_explains_more():
    rng = np.random.default_rng(5)
    e, x = slow_and_curved()
    x["current[k-1]"] = lfilter([1.0], [1.0, -0.98], rng.normal(size=4000))
    found = analysed(e, x)
    assert found.curved_regressors == ["voltage[k-1]"]
    assert found.regressors["current[k-1]"].share > found.regressors["voltage[k-1]"].share
    assert list(found.strongest) == ["voltage[k-1]"]
    (plot,) = (p for p in residual_plots(found, "one-step residual", UNITS) if "Mean of" in p.label)
    assert "p < 10⁻⁶" in plot.caption
    means, arms = np.array(plot.traces[0]["y"]), np.array(plot.traces[0]["error_y"]["array"])
    assert np.sum(np.abs(means) > arms) > 3, "what is rejected is seen to be"
    flat = found.model_copy(update={"curved_regressors": []})
    assert list(flat.strongest) == ["current[k-1]"]


def test_errors_over_a_regressor_hold_what_they_say_for_a_coloured_residual():
    rng, beyond = np.random.default_rng(6), []
    for _ in range(200):
        e, x = (lfilter([1.0], [1.0, -0.95], one)[300:] for one in rng.normal(size=(2, 1300)))
        found = against_regressor(e, x)
        beyond.append(np.mean(np.abs(found.means) > 1.96 * found.errors))
    assert 0.03 < np.mean(beyond) < 0.08  # taken as white it would be more than a half


def test_a_residual_figure_has_its_units_and_keeps_within_its_edges(tmp_path):
    e, x = slow_and_curved()
    found = analysed(1e-3 * e, x)
    figure = residual_analysis_figure([found, found], "one-step residual", UNITS)
    own, crossed, over = figure.axes[:3]
    assert (
        own.get_ylabel() == "autocorrelation" and own.get_title(loc="left") == "residual of speed"
    )
    assert (
        crossed.get_ylabel() == "correlation with the inputs"
        and over.get_ylabel() == "mean residual [rad/s]"
    )
    (name,) = found.strongest
    assert over.get_xlabel() == f"{name} [{UNITS[name.partition('[')[0]]}]"
    assert drawn(figure, tmp_path / "figure.png")
    edge = figure.bbox
    boxes = [axis.get_tightbbox() for axis in figure.axes]
    assert all(box.x0 >= edge.x0 and box.x1 <= edge.x1 for box in boxes)
    assert all(
        left.x1 <= right.x0
        for row in (boxes[:3], boxes[3:])
        for left, right in zip(row, row[1:], strict=False)
    )


def test_the_largest_autocorrelation_keeps_its_sign():
    e = lfilter([1.0], [1.0, 0.6], np.random.default_rng(7).normal(size=2000))
    found = analysed(e, {"voltage[k-1]": e})
    assert found.strongest_acf == pytest.approx(-found.largest_acf) and found.strongest_acf < -0.5
    assert (
        f"The largest magnitude is −{found.largest_acf:.2g}."
        in residual_plots(found, "residual", UNITS)[0].caption
    )
    json.loads(found.model_dump_json())
