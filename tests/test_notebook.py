"""What a notebook shows: objects as HTML, figures on axes, the page of a fit, progress."""

from __future__ import annotations

import inspect
import pydoc
import re
import subprocess
import sys
import types
from html.parser import HTMLParser
from pathlib import Path

import matplotlib
import numpy as np
import pytest
from matplotlib import pyplot
from matplotlib.figure import Figure

import orthaug as oa
from orthaug import MLP
from orthaug._base.errors import Warning
from orthaug._base.frames import EstimateFrame
from orthaug._base.lines import estimate_cells
from orthaug._base.views import MAKERS
from orthaug.analysis.findings import BiasResult
from orthaug.analysis.fit_findings import ParameterResult
from orthaug.commands import bars
from orthaug.reports.html import card_of_result, html_of

VOID = {"br", "meta", "hr", "link", "img", "input"}
KINDS = ("free_run", "one_step", "residuals", "learned", "parameters", "bode")


class Checked(HTMLParser):
    """Text and tables of HTML whose elements are all closed, in their order."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.cells: list[str] = []
        self.seen: set[str] = set()
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.seen.add(tag)
        if tag not in VOID:
            self.open.append(tag)
        if tag in ("td", "th"):
            self.cells.append("")

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] in ("td", "th"):
            self.cells[-1] += data


@pytest.fixture(scope="module")
def record() -> oa.Record:
    rng = np.random.default_rng(0)
    u, e, y = rng.standard_normal(300), rng.standard_normal(300), np.zeros(300)
    for k in range(1, 300):
        y[k] = 0.5 * y[k - 1] + u[k - 1] + 0.3 * np.tanh(2 * y[k - 1]) + 0.02 * e[k]
    channels = {"inputs": [oa.Channel("u", "N")], "outputs": [oa.Channel("x", "m")]}
    return oa.Record.from_arrays(u, y, sampling_time=0.1, **channels)


@pytest.fixture(scope="module")
def baseline() -> oa.Baseline:
    return oa.Baseline.from_terms(
        [oa.Term("a", "x[k-1]"), oa.Term("b", "u[k-1]", unit="m/N", min=0)]
    )


@pytest.fixture(scope="module")
def fit(record):
    terms = [oa.Term("a", "x[k-1]"), oa.Term("b", "u[k-1]", unit="m/N")]
    return oa.estimate(
        record, oa.Baseline.from_terms(terms), learner=MLP((3,), inputs=("x[k-1]",)), progress=False
    )


@pytest.fixture
def motion() -> oa.Motion:
    return oa.Motion.from_equations(
        states=[oa.State("v", "(u - c*v)/m", start=0.0, unit="m/s")],
        outputs=[oa.Output("x", "v")],
        inputs=["u"],
        parameters=[
            oa.PhysicalParameter("m", 2.0, "kg", min=0),
            oa.PhysicalParameter("c", 1.0, "N s/m"),
        ],
    )


def test_records_are_shown_and_escaped(record):
    assert {"u", "N", "input", "x", "m", "output"} <= set(Checked(record._repr_html_()).cells)
    assert "300 in 1 experiment" in record._repr_html_()
    odd = oa.Record.from_arrays(
        y=[0.0, np.nan, 1.0], outputs=[oa.Channel("y", "<b>&")], missing="keep"
    )
    shown = Checked(odd._repr_html_())
    assert {"<b>&", "1"} <= set(shown.cells) and "b" not in shown.seen


def test_physics_are_shown(baseline, motion):
    assert {"x[k-1]", "m/N", "≥ 0"} <= set(Checked(baseline._repr_html_()).cells)
    assert {"d/dt v", "(u - c*v)/m", "kg", "2"} <= set(Checked(motion._repr_html_()).cells)
    function = oa.Baseline.from_function(lambda x: x[None, :], ["a"])
    assert "a function of the regressor" in function._repr_html_()


def test_fits_and_models_are_shown(fit):
    value = f"{fit.theta[0]:.6g}"
    assert {"a", "b", "m/N", value} <= set(Checked(fit.model._repr_html_()).cells)
    row = fit.parameters.loc["a"]
    ends = (row["ci95_low"], row["ci95_high"])
    own, std, low, high = estimate_cells(row["value"], row["std"], ends)
    cells = {"a", "b", "m/N", own, std, f"[{low}, {high}]"}
    assert cells <= set(Checked(fit._repr_html_()).cells)


def test_tables_of_parameters_show_significant_digits():
    table = EstimateFrame(
        {"value": [9.312e-5, 100.0], "std": [1.04e-6, 0.25], "unit": ["m/N", "N/m"]},
        index=["b", "k"],
    )
    for shown in (repr(table), table._repr_html_(), repr(table[["value", "std"]])):
        assert {"9.312e-05", "1.0e-06", "100.00", "0.25"} <= set(re.split(r"[\s<>]+", shown))
    assert table.loc["b", "value"] == 9.312e-5  # what it holds is the number in full


def test_completion_lists_the_public_interface_alone(fit):
    names = dir(fit)
    assert {"predict", "simulate", "parameters", "plot", "split", "summary"} <= set(names)
    assert not [name for name in names if name.startswith("_")] and "withheld" not in names
    assert all(hasattr(fit, name) for name in names)
    assert set(dir(fit.plot)) == set(KINDS)
    assert all(getattr(fit.plot, kind).__doc__ for kind in dir(fit.plot))


@pytest.mark.parametrize("verb", ["estimate", "select", "fit_spec", "explain", "recover"])
def test_signatures_show_no_address(verb):
    assert " at 0x" not in str(inspect.signature(getattr(oa, verb)))
    assert " at 0x" not in pydoc.plain(pydoc.render_doc(getattr(oa, verb)))


def test_fits_predict_and_simulate_as_their_model(fit, record):
    for one, other in (
        (fit.predict(record, 3), fit.model.predict(record, 3)),
        (fit.simulate(record, "zero"), fit.model.simulate(record, "zero")),
    ):
        np.testing.assert_array_equal(one.trajectories[0].model, other.trajectories[0].model)


def test_the_overview_has_run_residual_parameters_and_learned_part(fit, record):
    figure = fit.plot(record)
    shown = [axis.get_title() or axis.get_ylabel() for axis in figure.axes]
    assert shown == [
        "free run",
        "residual, free run",
        "parameters, 95 % intervals",
        "learned part of x [m]",
    ]
    figure.canvas.draw()
    same = [axis.get_title() or axis.get_ylabel() for axis in oa.plot(fit).axes]
    assert same == shown
    (axis,) = oa.plot(fit, "learned").axes
    assert axis.get_ylabel() == "learned part of x [m]"
    with pytest.raises(oa.InputError, match="`kind` must be one of overview, bode, free_run"):
        oa.plot(fit, "output")


def test_the_fit_of_a_spec_shows_what_its_result_says(fit):
    row = ParameterResult(
        **{
            "name": "m",
            "unit": "",
            "derived_unit": "kg",
            "initial": 1.0,
            "value": 2.5,
            "std": 0.25,
            "ci95": [2.0, 3.0],
        },
        bias=BiasResult(value=0.125, cause="friction", share=0.95),
        ci95_with_bias=[1.9, 2.9],
    )
    result = fit.diagnose(blocks=0).changed(
        parameters=[row],
        physical_parameters=None,
        warnings=[Warning(code="biased", text="friction moves m")],
    )
    shown = html_of(card_of_result(fit, result))
    assert {"m", "2.500", "(kg)", "[2.000, 3.000]", "0.125", "[1.900, 2.900]"} <= set(
        Checked(shown).cells
    )
    assert "friction moves m" in shown


@pytest.mark.parametrize("kind", KINDS)
def test_every_figure_is_drawn_on_the_axes_that_are_given(fit, kind):
    before = dict(matplotlib.rcParams)
    axis = Figure().subplots()
    assert getattr(fit.plot, kind)(ax=axis) is axis
    assert axis.lines and axis.get_xlabel()
    axis.figure.canvas.draw()
    assert dict(matplotlib.rcParams) == before
    assert kind in repr(fit.plot)


def test_figures_show_what_their_names_say(fit):
    residual = fit.plot.residuals(kind="free_run", ax=Figure().subplots()).lines[0].get_ydata()
    trajectory = fit.model.simulate(fit.problem.record).trajectories[0]
    np.testing.assert_allclose(residual, trajectory.measured[:, 0] - trajectory.model[:, 0])
    gain, phase = (fit.plot.bode(phase=p, ax=Figure().subplots()) for p in (False, True))
    assert (gain.get_yscale(), gain.get_ylabel(), phase.get_ylabel()) == (
        "log",
        "gain [m/N]",
        "phase [°]",
    )
    free = fit.plot.free_run(ax=Figure().subplots())
    assert [line.get_label() for line in free.lines] == [
        "measured",
        "model",
        "model without its learner",
    ]


@pytest.mark.parametrize(
    ("draw", "message"),
    [
        (lambda plot: plot.free_run(output="z"), "`output` must be one of x"),
        (lambda plot: plot.free_run(experiment=1), "`experiment` must be a number from 0 to 0"),
        (lambda plot: plot.free_run([1, 2]), "a Record, or None"),
        (lambda plot: plot.residuals(kind="two"), "`kind` must be one of"),
        (lambda plot: plot.learned("y"), "`feature` must be one of"),
        (lambda plot: plot.bode(ax=3), "axes of matplotlib"),
    ],
)
def test_what_cannot_be_drawn_is_said(fit, draw, message):
    with pytest.raises(oa.InputError, match=message):
        draw(fit.plot)


def test_new_axes_are_pyplots_where_it_is_in_use():
    """Without pyplot a figure stands alone; where it is loaded it knows the figure, so that a notebook shows it."""
    code = (
        "import sys, orthaug\n"
        "from orthaug.reports.drawing import axes_for\n"
        "axes_for(None); alone = 'matplotlib.pyplot' in sys.modules\n"
        "import matplotlib; matplotlib.use('agg'); from matplotlib import pyplot\n"
        "axis = axes_for(None); print(alone, pyplot.get_fignums(), pyplot.gca() is axis)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True
    )
    assert done.stdout.split("\n")[0] == "False [1] True"


def test_a_motion_has_a_page_too(motion):
    u = np.sin(np.arange(120.0) ** 1.2)
    speed = np.zeros(121)
    for k in range(120):
        speed[k + 1] = np.exp(-0.05) * speed[k] + (1 - np.exp(-0.05)) * u[k]
    measured = speed[:120] + 0.01 * np.random.default_rng(0).normal(size=120)
    record = oa.Record.from_arrays(u, measured, sampling_time=0.1, outputs=["x"])
    fit = oa.estimate(record, motion, learner=None)
    assert "c*v" in fit.report().html
    assert "c*v" in fit.split(oa.Uniform()).report().html  # this measure's name alone is in the fit


def test_the_page_of_a_fit(fit, tmp_path):
    page = fit.report(tmp_path / "page.html", tests={"again": fit.problem.record})
    assert page.path.read_text(encoding="utf-8") == page.html
    for told in ("Model of x from u", "tests.again", "Residual tests", "there is no spec"):
        assert told in page.html
    frame = page._repr_html_()
    assert Checked(frame).seen == {"iframe"} and "&lt;!doctype html" in frame.lower()
    assert "http-equiv" not in frame or "sandbox" in frame


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"path": "page.pdf"}, "a name that ends in .html"),
        ({"path": 3}, "a file's name, or None"),
        ({"path": "absent/page.html"}, "there is no folder absent"),
        ({"tests": [1]}, "must be records by their names"),
    ],
)
def test_pages_that_cannot_be_made(fit, options, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("orthaug.commands.library.with_verdict", lambda fitted: fitted)
    monkeypatch.setattr("orthaug.commands.library.report_of", lambda job, fit: fit)
    monkeypatch.setattr("orthaug.commands.library.fit_report", lambda fitted, origin: "")
    with pytest.raises(oa.InputError, match=message):
        fit.report(**options)
    assert list(tmp_path.iterdir()) == []


def test_parameters_are_a_table(fit):
    assert list(fit.parameters.index) == ["a", "b"]
    assert set(fit.parameters.columns) >= {
        "unit",
        "initial",
        "value",
        "std",
        "ci95_low",
        "ci95_high",
    }


class _Notebook:
    """Stands in for IPython: keeps what is displayed."""

    def __init__(self) -> None:
        self.shown: list[str] = []

    def display(self, content, *, raw, display_id):
        assert raw and display_id
        self.update(content, raw=raw)
        return self

    def update(self, content, *, raw):
        assert raw
        Checked(content["text/html"])
        self.shown.append(content["text/html"])


def test_progress_in_a_notebook(monkeypatch):
    notebook = _Notebook()
    monkeypatch.setattr(bars, "_display", lambda: notebook.display)
    with MAKERS["progress"]() as tell:
        tell(0, 20, 0.5)
        tell(1, 30, 0.25)
    assert ["<progress" in line for line in notebook.shown] == [True, True, True, False]
    assert (
        "run 2, iteration 30, loss 0.25" in notebook.shown[2]
        and "2 runs, 50 iterations" in notebook.shown[3]
    )


def test_progress_is_shown_to_people_only(monkeypatch, capsys):
    """Neither in a pipe nor in a console of IPython that writes to one."""
    ipython, display = types.ModuleType("IPython"), types.ModuleType("IPython.display")
    ipython.get_ipython = lambda: type("TerminalInteractiveShell", (), {})()
    monkeypatch.setitem(sys.modules, "IPython", ipython)
    monkeypatch.setitem(sys.modules, "IPython.display", display)
    monkeypatch.setenv("FORCE_COLOR", "1")
    with MAKERS["progress"]() as tell:
        tell(0, 1, 0.5)
    assert capsys.readouterr() == ("", "")
    ipython.get_ipython = lambda: type("ZMQInteractiveShell", (), {})()
    display.display = _Notebook().display
    assert bars._display() == display.display


def test_the_page_of_the_documents(tmp_path, monkeypatch):
    """Its blocks run one after another, as in a notebook."""
    rng = np.random.default_rng(1)
    u, y = rng.standard_normal(300), np.zeros(300)
    for k in range(2, 300):
        y[k] = 1.5 * y[k - 1] - 0.7 * y[k - 2] + 0.1 * u[k - 1] - 0.1 * y[k - 1] ** 3
    monkeypatch.chdir(tmp_path)
    np.savetxt(
        "run1.csv", np.column_stack([u, y]), delimiter=",", header="force,position", comments=""
    )
    text = (Path(__file__).resolve().parents[1] / "docs" / "notebook.md").read_text(
        encoding="utf-8"
    )
    blocks = re.findall(r"^```python\n(.*?)^```", text, flags=re.DOTALL | re.MULTILINE)
    names: dict[str, object] = {}
    matplotlib.use("agg")
    for block in blocks[:4]:
        exec(block, names)
    assert Path("report.html").is_file() and names["upper"].lines
    pyplot.close("all")
    found = re.findall(r"^\| `(\w+)\(", text, flags=re.MULTILINE)
    assert set(found) == set(KINDS)
