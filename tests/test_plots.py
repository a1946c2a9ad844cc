"""Figures: titles, labels with units, legends, and pictures that are not blank."""

from __future__ import annotations

import warnings

import matplotlib.image
import numpy as np
import pytest
from matplotlib.figure import Figure

from orthaug import Channel, Response, Trajectory
from orthaug.analysis.findings import SuspectResult
from orthaug.analysis.fit_findings import ParameterResult
from orthaug.reports import finding_plots, plots
from orthaug.reports.result import RowResult

CHANNELS = (Channel("position", "m"), Channel("angle"))


def response(
    ny: int = 1, rows: int = 900, measured: bool = True, diverged: bool = False
) -> Response:
    rng = np.random.default_rng(0)
    baseline, learner, noise = rng.normal(size=(3, rows, ny))
    baseline[:2] = learner[:2] = np.nan
    if diverged:
        baseline[50:] = np.nan
    outputs = np.nan_to_num(baseline + learner) + noise if measured else None
    return Response((Trajectory(baseline, learner, learner, outputs, 2),), 1, CHANNELS[:ny], 0.1)


FIGURES = {
    "output": (plots.output_figure, 2),
    "residual": (plots.residual_figure, 1),
    "components": (plots.components_figure, 2),
}


@pytest.mark.parametrize("ny", [1, 2])
@pytest.mark.parametrize("name", FIGURES)
def test_every_figure(tmp_path, name, ny):
    make, panels = FIGURES[name]
    figure = make(response(ny), "one-step prediction, training data")
    assert type(figure) is Figure
    drawn = "samples 2 to 899 of 900" if name == "residual" else "samples 2 to 251 of 900"
    assert figure.get_suptitle() == f"one-step prediction, training data: {drawn}"
    assert len(figure.axes) == panels * ny
    labels = " | ".join(axis.get_ylabel() for axis in figure.axes)
    if name == "components":
        assert labels == " | ".join(
            ["baseline [m]", "learner [m]", "baseline", "learner"][: 2 * ny]
        )
    else:
        assert "position [m]" in labels and ("angle" in labels) == (ny == 2)
    assert figure.axes[-1].get_xlabel() == "time [s]"
    assert all(axis.lines and np.isfinite(axis.get_ylim()).all() for axis in figure.axes)
    path = tmp_path / f"{name}.png"
    plots.save(figure, path)
    picture = matplotlib.image.imread(path)
    assert min(picture.shape[:2]) > 300 and picture[..., :3].std() > 0.02
    assert picture.shape[0] > picture.shape[1] / 3


def legend(axis) -> list[str]:
    return [text.get_text() for text in axis.get_legend().get_texts()]


def test_legends():
    assert legend(plots.output_figure(response(), "").axes[0]) == ["measured", "model"]
    assert legend(plots.output_figure(response(measured=False), "").axes[0]) == ["model"]
    upper, lower = plots.components_figure(response(), "").axes
    assert legend(upper) == ["baseline part of position, φ θ"]
    assert legend(lower) == ["learner part of position, f − φ θ_aux"]


@pytest.mark.parametrize("text", ["$", "a $x$ b", r"$\frac{", "$$", r"\$^_{", "µ 力"])
def test_text_that_looks_like_a_formula_is_drawn_as_it_is(tmp_path, text):
    """In units, titles, names of parameters, suspects and rows."""
    odd = Response(response().trajectories, 1, (Channel("position", text),), 0.1)
    parameter = ParameterResult(
        name="a", unit=text, initial=0.0, value=1.0, std=0.1, ci95=[0.8, 1.2]
    )
    unknown = dict.fromkeys(
        ("structure", "residuals", "learner_to_physics", "validation", "seconds")
    )
    row = RowResult.model_construct(name=text, parameters=[parameter], scores={}, **unknown)
    suspect = SuspectResult.model_construct(
        name=text,
        relative_bias={text: 0.1, "b": -0.2},
        coefficient=1.0,
        size=1.0,
        relative_physical_bias=None,
        expected_physical_bias=None,
    )
    for i, figure in enumerate(
        [
            *(make(odd, text) for make, _ in FIGURES.values()),
            plots.comparison_figure([row]),
            finding_plots.bias_figure([suspect]),
        ]
    ):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            assert drawn(figure, tmp_path / f"{i}.png")


def test_output_shows_a_window_from_the_first_value_on():
    axis, lower = plots.output_figure(response(), "").axes
    time, shown = axis.lines[1].get_xdata(), response()
    rows = slice(2, 2 + len(time))
    assert 100 <= len(time) <= 500
    np.testing.assert_allclose(time, 0.1 * np.arange(rows.start, rows.stop))
    np.testing.assert_array_equal(
        axis.lines[0].get_ydata(), shown.trajectories[0].measured[rows, 0]
    )
    np.testing.assert_array_equal(axis.lines[1].get_ydata(), shown.model[rows, 0])
    difference = shown.trajectories[0].measured[rows, 0] - shown.model[rows, 0]
    np.testing.assert_array_equal(lower.lines[0].get_ydata(), difference)
    assert lower.get_ylabel() == "difference [m]"


def test_residual_shows_the_whole_record():
    (axis,) = plots.residual_figure(response(), "").axes
    assert len(axis.lines[0].get_xdata()) == 900
    assert axis.get_ylabel() == "residual of position [m]"


def test_a_long_residual_is_drawn_by_its_outline():
    """In every column of pixels the least and the largest value stand, gaps aside."""
    long = response(rows=20_000)
    (axis,) = plots.residual_figure(long, "").axes
    trajectory = long.trajectories[0]
    residual = (trajectory.measured - trajectory.model)[:, 0]
    time, values = (np.asarray(v) for v in axis.lines[0].get_data())
    assert len(values) < len(residual) / 5 and np.all(np.diff(time) >= 0)
    assert (np.nanmin(values), np.nanmax(values)) == (np.nanmin(residual), np.nanmax(residual))
    begin, end = np.searchsorted(0.1 * np.arange(20_000), time[[1000, 1002]] - 0.05)
    assert values[1000:1002].tolist() == [residual[begin:end].min(), residual[begin:end].max()]


def drawn(figure: Figure, path) -> bool:
    """Whether a figure becomes a picture that is not blank."""
    plots.save(figure, path)
    return bool(matplotlib.image.imread(path)[..., :3].std() > 0.01)


@pytest.mark.parametrize("name", FIGURES)
def test_a_run_that_diverged_is_drawn_as_far_as_it_goes(tmp_path, name):
    figure = FIGURES[name][0](response(diverged=True), "diverged")
    curve = figure.axes[1 if name == "output" else 0].lines[0]
    last = np.asarray(curve.get_xdata())[np.isfinite(curve.get_ydata())][-1]
    assert last == pytest.approx(0.1 * 49)  # the last sample before it diverges
    assert drawn(figure, tmp_path / "figure.png")


@pytest.mark.parametrize("name", FIGURES)
def test_a_short_record(tmp_path, name):
    figure = FIGURES[name][0](response(rows=3), "one sample")
    values = [
        line.get_ydata()
        for axis in figure.axes
        for line in axis.lines
        if len(line.get_ydata()) != 2
    ]
    assert all(np.isfinite(shown).sum() == 1 for shown in values) and values
    assert drawn(figure, tmp_path / "figure.png")
