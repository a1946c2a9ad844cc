"""report.html: its sections, numbers and words; that it needs nothing from outside; its size and its time."""

from __future__ import annotations

import base64
import json
import re
import subprocess
import sys
import tomllib
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
from test_cli import MLP, SPEC, make_project
from test_motion_cli import SPEC as MOTION
from test_motion_cli import put

import orthaug as oa
from orthaug import Channel, Response, Trajectory
from orthaug._base.errors import Warning
from orthaug.analysis.findings import BiasResult
from orthaug.analysis.fit_findings import ParameterResult
from orthaug.commands.compare import page_of
from orthaug.commands.folder import check_folder
from orthaug.commands.job import origin_of
from orthaug.models.response import Scores
from orthaug.reports.learned_part import Curve, curve_limits
from orthaug.reports.page import compare_page, fit_page
from orthaug.reports.page_blocks import interval, number, percent
from orthaug.reports.page_compare import ComparePage, compare_sections
from orthaug.reports.page_figures import interval_plot
from orthaug.reports.page_fit import FitPage, fit_sections
from orthaug.reports.page_runs import (
    Run,
    compared_plots,
    error_band,
    pack_curve,
    run_plots,
    worst_window,
)
from orthaug.reports.page_verdict import compare_verdict, fit_verdict
from orthaug.reports.text import scores_text

SUSPECT = '[[suspects]]\nname = "square"\non = "u[k-1]**2"\n'
FIT = ["Verdict", "Parameters", "Free run", "Physics and learner", "What was learned", "Scores", "Residual tests",
       "Stability", "Excitation and suspects", "Training and restarts", "How to reproduce it"]  # fmt: skip
COMPARED = [
    "Verdict",
    "Models",
    "Scores",
    "Parameters",
    "Free run",
    "Residual tests",
    "How to reproduce it",
]
LARGEST = 6_000_000  # letters of a page


class Read(HTMLParser):
    """Elements of a page with their attributes, and the text of each."""

    def __init__(self, page: str):
        super().__init__()
        self.found: list[tuple[str, dict, list[str]]] = []
        self.open: list[int] = []
        self.feed(page)

    def handle_starttag(self, tag, attrs):
        self.found.append((tag, dict(attrs), []))
        if tag not in ("meta", "link", "br", "img"):
            self.open.append(len(self.found) - 1)

    def handle_endtag(self, tag):
        place = self.open.pop()
        assert self.found[place][0] == tag, f"{tag} closes {self.found[place][0]}"

    def handle_data(self, data):
        for place in self.open:
            self.found[place][2].append(data)

    def text(self, tag: str, **wanted: str) -> list[str]:
        return ["".join(text).strip() for name, attrs, text in self.found
                if name == tag and all(attrs.get(k) == v for k, v in wanted.items())]  # fmt: skip

    def attributes(self, name: str) -> list[str]:
        return [attrs[name] for _, attrs, _ in self.found if name in attrs]


@pytest.fixture(scope="module")
def lagged(tmp_path_factory):
    folder = tmp_path_factory.mktemp("lagged")
    return oa.fit_spec(
        str(make_project(folder, SPEC.replace('kind = "none"\n', MLP + "restarts = 3\n" + SUSPECT)))
    )


@pytest.fixture(scope="module")
def motion(tmp_path_factory):
    return oa.fit_spec(str(put(tmp_path_factory.mktemp("moving"), MOTION)))


@pytest.fixture(scope="module")
def compared(lagged):
    return oa.compare(lagged.job)


@pytest.fixture(scope="module")
def pages(lagged, motion, compared):
    return {
        "lagged": lagged.report().html,
        "motion": motion.report().html,
        "compared": compare_page(page_of(compared)),
    }


def figures(page: str) -> list[dict]:
    def refuse(name: str):
        raise AssertionError(f"{name} in the page")

    (text,) = Read(page).text("script", id="figures")
    return json.loads(text, parse_constant=refuse)


def values(series: dict) -> np.ndarray:
    return np.frombuffer(base64.b64decode(series["f4"]), "<f4").astype(float) + series["shift"]


KINDS = ("lagged", "motion", "compared")


def test_one_row_that_is_scored_is_no_rows():
    one = Scores(np.array([0.1]), np.array([np.nan]), np.array([np.nan]), 1)
    head = scores_text(one, [Channel("y")], None).splitlines()[0]
    assert head.startswith("free run, 1 row ")


@pytest.mark.parametrize("kind", KINDS)
def test_the_sections_stand_in_their_order_and_the_contents_lead_to_them(pages, kind):
    page = Read(pages[kind])
    wanted = COMPARED if kind == "compared" else FIT
    shown = [title for title in page.text("h2") if title != "Warnings"]
    assert shown == wanted
    targets = [link.removeprefix("#") for link in page.attributes("href")]
    assert len(targets) > len(wanted) and set(targets) <= set(page.attributes("id"))
    assert len(page.attributes("id")) == len(set(page.attributes("id")))


@pytest.mark.parametrize("kind", KINDS)
def test_a_page_is_one_file_that_asks_nothing_of_a_network(pages, kind):
    page = Read(pages[kind])
    assert not page.attributes("src") and all(
        link.startswith("#") for link in page.attributes("href")
    )
    assert "default-src 'none'" in " ".join(page.attributes("content"))
    assert "http" not in re.sub(
        r'<script type="text/plain" id="plotly">.*?</script>', "", pages[kind]
    ).replace("http-equiv", "")
    assert len(pages[kind].encode()) < LARGEST


@pytest.mark.parametrize("kind", KINDS)
def test_every_plot_is_reported_in_words_and_every_caption_is_a_sentence(pages, kind):
    page = Read(pages[kind])
    plots = [attrs for _, attrs, _ in page.found if "data-figure" in attrs]
    assert [int(plot["data-figure"]) for plot in plots] == list(
        range(len(figures(pages[kind])))
    ) and len(plots) >= 5
    assert all(len(plot["aria-label"]) > 20 and plot["tabindex"] == "0" for plot in plots)
    captions = page.text("figcaption") + page.text("caption")
    assert [
        caption for caption in captions if len(caption.split()) < 4 or not caption.endswith(".")
    ] == []
    assert len(page.text("figcaption")) == len(plots)


@pytest.mark.parametrize("kind", KINDS)
def test_curves_hold_the_whole_record_in_finite_numbers(pages, lagged, motion, compared, kind):
    found = [figure for figure in figures(pages[kind]) if figure["series"]]
    job = {"lagged": lagged, "motion": motion, "compared": compared}[kind].job
    assert len(found) == len(job.parts)
    for figure, part in zip(found, job.parts, strict=True):
        (experiment,) = part.record.experiments
        measured = values(figure["series"]["measured 0"])
        assert measured == pytest.approx(experiment.outputs[:, 0], rel=1e-5, abs=1e-7)
        for trace in figure["data"]:
            for key in [trace["series"]] if "series" in trace else trace["minus"]:
                assert (
                    np.isfinite(values(figure["series"][key])[2:]).all()
                    and len(values(figure["series"][key])) > 50
                )


def test_physics_alone_is_the_model_without_its_learner(lagged, motion, pages):
    part = lagged.job.parts[-1].record
    # Of a motion from the same start
    own = lagged.fit.model.physics_only.simulate(part).trajectories[0].model
    for kind, fitted, alone in (("lagged", lagged, own), ("motion", motion, None)):
        (run,) = fitted.responses[fitted.job.parts[-1].name][1].trajectories
        alone = run.baseline[:, 0] if alone is None else alone[:, 0]
        assert not np.allclose(alone[5:], run.model[5:, 0])
        drawn = [f for f in figures(pages[kind]) if f["series"]][-1]["series"]["physics 0"]
        assert values(drawn)[2:] == pytest.approx(alone[2:], rel=1e-5, abs=1e-6)


def test_a_page_says_how_its_result_was_made(lagged, pages, monkeypatch):
    page, origin = Read(pages["lagged"]), origin_of(lagged.job, "fit")
    assert lagged.job.path.read_text().strip() in page.text("pre")[-1]
    cells = page.text("td")
    for file in lagged.result.data.train:
        assert file.sha256 in cells
    assert {"orthaug fit plant.toml", oa.__version__, origin.machine, "0"} <= set(cells)
    assert page.text("title") == ["Model of y from u: plant"] == page.text("h1")
    asked = replace(lagged.job, arguments=("fit", "a b.toml", "--out", "there", "--force"))
    assert origin_of(asked, "fit").command == "orthaug fit 'a b.toml' --out there --force"
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "86400")
    assert origin_of(lagged.job, "fit").date == "1970-01-02 00:00 UTC"
    for text in ("253402300800", "9" * 30, "-1", "²", "today"):
        monkeypatch.setenv("SOURCE_DATE_EPOCH", text)
        with pytest.raises(
            oa.InputError, match="SOURCE_DATE_EPOCH: found .* expected whole seconds since 1970"
        ):
            check_folder(lagged.job.path.parent / "not yet there")


def test_a_spec_that_was_changed_meanwhile_is_reported_as_it_was_read(lagged):
    path = lagged.job.path
    written = path.read_text()
    for changed in (written.replace("restarts = 3", "restarts = 4"), "not TOML"):
        path.write_text(changed)
        found = tomllib.loads(origin_of(lagged.job, "fit").toml)
        assert (
            found["training"]["restarts"] == 3 and found["baseline"]["terms"][0]["parameter"] == "a"
        )
    path.write_text(written)
    assert origin_of(lagged.job, "fit").toml == written


def test_what_a_motion_learned_is_a_curve_with_its_band_and_the_reach_of_the_data(motion, pages):
    over = [
        f
        for f in figures(pages["motion"])
        if f["layout"].get("xaxis", {}).get("title") == {"text": "v [m/s]"}
    ]
    (curve,) = [f for f in over if not f["layout"]["yaxis"]["title"]["text"].startswith("residual")]
    traces = {trace["name"]: trace for trace in curve["data"]}
    assert curve["layout"]["yaxis"]["title"] == {"text": "dv/dt [m/s²]"}
    assert {"training data", "learner", "beyond the data", "95 % interval", "lower limit"} == set(
        traces
    )
    inside, beyond = traces["learner"]["x"], traces["beyond the data"]["x"]
    assert beyond[0] < inside[0] < inside[-1] < beyond[-1]
    (stripe,) = curve["layout"]["shapes"]
    assert [stripe["x0"], stripe["x1"]] == pytest.approx([inside[0], inside[-1]], rel=1e-4)


@pytest.mark.parametrize(
    ("section", "words"),
    [
        (
            {"controller": {"output": "u", "reference": "r", "measured": "y", "Kp": 20.0, "Kd": 4}},
            "simulated with its controller, which sets u from r − y: Kp = 20.0, Kd = 4.",
        ),
        (
            {"controller": {"output": "u", "measured": "y", "numerator": [2], "denominator": [1]}},
            "which sets u from 0 − y: numerator = [2], denominator = [1].",
        ),
        (
            {"controller": {"outputs": {"u": "K*e"}, "states": {"e": {"next": "r - y"}}}},
            "simulated with its controller: u = K*e, next e = r - y.",
        ),
        (
            {"motion": {"source": {"file": "cart.xml", "learned": ["hinge.velocity"]}}},
            "are those of cart.xml, with the states x, v; the learner is beside hinge.velocity.",
        ),
    ],
)
def test_a_loop_has_its_controller_and_a_source_its_file(motion, section, words):
    result = motion.result.model_copy(update={"spec": {**motion.result.spec, **section}})
    page = fit_page(FitPage(origin_of(motion.job, "fit"), result, motion.responses))
    assert words in " ".join("".join(Read(page).text("section", id="parameters")).split())


def test_a_surface_stands_where_data_are_near_and_sees_the_learner(lagged, pages):
    (surface,) = [f for f in figures(pages["lagged"]) if f["data"][0].get("colorbar")]
    heat = surface["data"][0]
    there = np.array(heat["z"], dtype=float)
    assert np.isfinite(there).any() and np.isnan(there).any() and heat["zmin"] == -heat["zmax"]


def test_what_is_drawn_over_an_input_is_reported_as_it_is(lagged, motion, pages):
    captions = Read(pages["motion"]).text("figcaption")
    (one,) = [caption for caption in captions if caption.startswith("Over v")]
    assert "the one input of the learner" in one and "variance" not in one
    assert "Its means over u[k-1] have" in " ".join(Read(pages["lagged"]).text("figcaption"))
    for kind in ("lagged", "motion"):
        stripes = [
            s
            for f in figures(pages[kind])
            for s in f["layout"].get("shapes", [])
            if s.get("fillcolor") == "@reach"
        ]
        assert (
            stripes
            and all(stripe["name"] for stripe in stripes)
            and any(s["showlegend"] for s in stripes)
        )
    (runs,) = [f for f in figures(pages["lagged"]) if f["data"][0].get("name") == "loss"]
    assert runs["layout"]["xaxis"]["ticktext"] == ["0", "1", "2"] and runs["layout"]["xaxis"][
        "title"
    ] == {"text": "seed"}


def test_units_that_the_spec_does_not_give_are_those_that_the_channels_ask_for(lagged):
    units = {row.name: (row.unit, row.derived_unit) for row in lagged.result.parameters}
    assert units == {"a": ("1", None), "b": ("", "1"), "c": ("", None)}  # the input has no unit
    rows = [
        row.model_copy(update={"unit": "", "derived_unit": "mm/N"})
        for row in lagged.result.parameters
    ]
    found = Read(
        replace(lagged, result=lagged.result.model_copy(update={"parameters": rows})).report().html
    )
    assert "(mm/N)" in found.text("td") and any(
        "it follows from the units of the channels" in c for c in found.text("caption")
    )


def test_the_parameters_have_their_intervals_and_the_suspect_its_bias(pages):
    page, drawn = Read(pages["lagged"]), figures(pages["lagged"])
    assert {"a [1]", "b", "c"} == {
        re.sub("<br>.*|<.?b>", "", tick["ticktext"][0])
        for k, tick in drawn[0]["layout"].items()
        if k[:5] == "yaxis"
    }
    assert [trace["name"] for trace in drawn[0]["data"]].count("95 % interval") == 3
    assert "square" in page.text("th") and any(f["data"][0].get("y") == ["square"] for f in drawn)


@pytest.mark.parametrize(("value", "scale", "shown"), [
    (-9e-18, 1.0, "0"), (-9e-18, None, "−9·10⁻¹⁸"), (0.0, None, "0"), (None, None, "–"), (1234.5678, None, "1234.6"),
    (1.02e6, None, "1020000"), (1.5e9, None, "1.5·10⁹"), (-0.25, 1.0, "−0.25"), (4.7e-5, 1.0, "4.7·10⁻⁵"),
])  # fmt: skip
def test_numbers_in_cells(value, scale, shown):
    assert number(value, scale=scale) == shown


def test_intervals_and_shares_in_cells():
    assert interval([-1e-17, 2.0]) == "0 … 2" and interval(None) == "–"
    assert interval([1.459492, 1.459527]) == "1.459492 … 1.459527"  # not one number twice
    assert percent(-1e-17, signed=True) == "0 %" and percent(0.0123, signed=True) == "+1.2 %"
    assert (
        percent(22.6) == "2260 %"
        and percent(-4.2, signed=True) == "−420 %"
        and percent(1e7) == "1·10⁹ %"
    )


def test_the_interval_with_the_bias_has_one_name():
    bias = BiasResult(value=2.5, cause="friction", share=1.0, determined=True)
    row = ParameterResult(name="c", unit="", initial=3.0, value=4.5, std=0.1, ci95=[4.3, 4.7])
    row = row.model_copy(update={"bias": bias, "ci95_with_bias": [0.9, 2.3]})
    drawn = interval_plot([row])
    assert drawn is not None and "95 % interval with the bias" in drawn.caption
    (legend,) = (t["name"] for t in drawn.traces if t.get("x") == [0.9, 2.3])
    assert legend == "95 % interval with the bias"


def test_the_axis_of_the_share_of_the_learner_says_where_it_ends(pages):
    (drawn,) = (f for f in figures(pages["lagged"]) if f["data"][0].get("type") == "bar"
                and "share of the learner" in f["layout"]["xaxis"]["title"]["text"])  # fmt: skip
    end = drawn["layout"]["xaxis"]["range"][1]
    title = f"share of the learner [%]; the axis ends at {percent(end / 100)}"
    assert drawn["layout"]["xaxis"]["title"]["text"] == title and 0 < end <= 100


def wave(rows: int, *, wild: int | None = None, experiments: int = 1) -> Response:
    """A response of one output over some experiments, the last of which may run away."""
    found = []
    for i in range(experiments):
        random = np.random.default_rng(i)
        model = np.sin(np.arange(rows) / 50)[:, None]
        measured = model + 0.01 * random.normal(size=model.shape)
        away = wild is not None and i == experiments - 1
        if away:
            model = np.where(
                np.arange(rows)[:, None] < wild,
                model * np.exp(np.arange(rows) / 9)[:, None],
                np.nan,
            )
        nothing = np.zeros_like(model)
        found.append(
            Trajectory(model, nothing, nothing, measured, 0, diverged=(wild, "y") if away else None)
        )
    return Response(tuple(found), None, (Channel("y", "m"),), 0.01)


def test_a_divergence_is_seen_and_does_not_flatten_the_rest():
    (plot,) = run_plots([Run("tests.fast", wave(300, wild=200, experiments=2))], {})
    (found,) = plot.layout["annotations"]
    (left,) = [trace for trace in plot.traces if trace.get("mode") == "markers"]
    assert (
        f"At {left['x'][0]:.4g} s y of the model leaves the panel" in plot.caption
        and plot.caption.endswith(" m.")
    )
    run = values(plot.series["model 0"])[round(left["x"][0] / 0.01) - 1 :]
    low, high = plot.layout["yaxis"]["range"]
    assert (
        low < run[0] < high
        and not low < run[1] < high
        and left["y"] == [high if run[1] > high else low]
    )
    assert found["text"] == "free run diverges in y" and found["x"] == pytest.approx(
        0.01 * (301 + 200)
    )
    assert "diverges in y at row 200" in plot.caption and "2 experiments" in plot.caption
    low, high = plot.layout["yaxis"]["range"]
    assert -4 < low < -1 and 1 < high < 4
    assert (
        np.isnan(values(plot.series["model 0"])[300])
        and np.isnan(values(plot.series["model 0"])[-50:]).all()
    )


def test_a_curve_that_stays_has_no_mark_and_the_model_without_its_learner_has_its_name():
    (plot,) = run_plots([Run("tests.slow", wave(300), wave(300))], {})
    assert "leaves the panel" not in plot.caption and all(
        "mode" not in trace for trace in plot.traces
    )
    assert [trace["name"] for trace in plot.traces] == [
        "measured",
        "model without its learner",
        "model",
        "measured − model",
    ]
    assert plot.layout["yaxis2"]["title"] == {"text": "residual<br>[m]"}
    (away,) = run_plots([Run("tests.slow", wave(300), wave(300, wild=200))], {})
    assert "s y of the model without its learner leaves the panel" in away.caption


def test_long_records_are_thinned_by_their_envelope_and_said_to_be():
    long = wave(400_000)
    peak = np.asarray(long.trajectories[0].measured)
    peak[123_456] = 9.0
    plots = run_plots(
        [Run(name, long, long) for name in ("train", "validation", "tests.a", "tests.b")],
        error_band(long),
    )
    kept = values(plots[0].series["measured 0"])
    assert kept.max() == pytest.approx(9.0, rel=1e-6) and kept.min() == pytest.approx(
        peak.min(), rel=1e-6
    )
    assert "points, the minimum and maximum of every stretch" in plots[0].caption
    assert (
        sum(len(json.dumps([p.traces, p.series])) for p in plots) < LARGEST - 2_200_000
    )  # the rest is Plotly's
    short = run_plots([Run("train", wave(5000))], {})[0]
    assert len(values(short.series["measured 0"])) == 5000 and "is drawn by" not in short.caption
    both = compared_plots({name: {"train": long} for name in "abc"})[0]
    assert len(json.dumps([both.traces, both.series])) < LARGEST - 2_200_000


@pytest.mark.parametrize("kind", KINDS)
def test_where_samples_share_pixels_the_measured_curve_is_an_area_and_a_model_its_outline(
    pages, kind
):
    runs = [f for f in figures(pages[kind]) if "measured 0" in (f["series"] or {})]
    drawn = {t["name"]: t.get("envelope") for f in runs for t in f["data"] if "series" in t}
    assert drawn.pop("measured") == "area"
    assert "outline" in drawn.values()
    assert kind != "compared" or set(drawn.values()) == {"outline"}


def test_packed_curves_keep_their_digits_beside_an_offset():
    given = 1e6 + np.sin(np.arange(100.0))
    assert values(pack_curve(given, 0.0, 1.0)) == pytest.approx(given, abs=1e-6)


def test_the_band_holds_most_errors_of_training():
    response = wave(4000)
    (limits,) = error_band(response).values()
    errors = response.trajectories[0].measured - response.trajectories[0].model
    assert np.mean((errors > limits[0]) & (errors < limits[1])) == pytest.approx(0.95, abs=0.002)
    assert error_band(wave(300, wild=100)) == {}


def with_warning(fitted, code: str, text: str):
    return fitted.result.changed(warnings=[*fitted.result.warnings, Warning(code, text)])


def test_the_verdict_is_built_from_the_findings(lagged, motion):
    good = fit_verdict(motion.result)
    assert good.level in ("good", "care") and "its free run on tests.steps is" in good.trust
    assert (
        "m and k as physics" in good.use
        and "The data alone do not determine c, because" in good.use
    )
    ran = fit_verdict(
        with_warning(lagged, "free_run_diverged", "tests.steps: the free run diverged.")
    )
    assert ran.level == "bad" and "its free run diverges on tests.steps" in ran.trust
    untold = lagged.result.model_copy(update={"data": lagged.result.data.model_copy(update={"tests": None}),
                                              "validation": None})  # fmt: skip
    assert "not tested on held-out data" in fit_verdict(untold).trust
    row = lagged.result.parameters[0]
    bias = {"value": 10 * (row.std or 1.0), "cause": "square", "share": 0.9}
    biased = row.model_copy(update={"bias": type("B", (), bias)()})
    one = lagged.result.model_copy(update={"parameters": [biased]})
    share = percent(10 * (row.std or 1.0) / (row.value or 1.0), signed=True)
    assert f"a is biased by about {share}, 10 times its standard error" in fit_verdict(one).trust
    bias["value"] = 1500 * (row.std or 1.0)
    biased = row.model_copy(update={"bias": type("B", (), bias)()})
    many = lagged.result.model_copy(update={"parameters": [biased]})
    assert ", 1500 times its standard error" in fit_verdict(many).trust
    for name in ("unmodelled", "sensor_noise"):
        residuals = motion.result.residuals.model_copy(
            update={"verdict": name, "changes": [], "missing": None}
        )
        warned = with_warning(motion, name, "")  # of noise on the sensor, where it biases θ
        doubted = fit_verdict(warned.model_copy(update={"residuals": residuals}))
        assert doubted.level != "good" and "Do not read m and k as physics yet" in doubted.use
        assert not doubted.then.startswith("Nothing further")
    residuals = residuals.model_copy(update={"verdict": "unmodelled", "steps": {"x": 0.1}})
    ended = motion.result.status.model_copy(update={"code": "converged"})
    unbiased = [row.model_copy(update={"bias": None}) for row in motion.result.parameters]
    changed = {
        "residuals": residuals,
        "status": ended,
        "validation": None,
        "parameters": unbiased,
        "advice": [],
    }
    coarse = fit_verdict(motion.result.model_copy(update=changed))
    assert (
        "its error is no larger than the steps in which x is recorded" in coarse.trust
        and "the steps of x are as large as the error" in coarse.then
    )
    white = residuals.model_copy(update={"verdict": "white", "steps": None})
    for code, words in (
        ("little_left", "rests on little of its regressor"),
        ("output_without_learner", "an output has parameters of a learned equation"),
        ("few_frequencies", "too few frequencies"),
    ):
        seen = changed | {"residuals": white, "warnings": [Warning(code, "…")]}
        untested = fit_verdict(motion.result.model_copy(update=seen))
        assert untested.level == "care" and words in untested.trust
        assert "Do not read" in untested.use and "the warning names" in untested.use
    few = changed | {"residuals": None, "warnings": [Warning("no_degrees_of_freedom", "…")]}
    empty = fit_verdict(motion.result.model_copy(update=few))
    assert empty.level == "bad" and empty.trust.startswith("Do not use the model as it is")
    assert "no more rows than it has unknowns" in empty.trust and empty.use.startswith("Give more")
    train, test = (motion.result.scores[part] for part in ("train", "tests.steps"))
    far = test.simulation.model_copy(
        update={"rmse": [2 * value for value in train.simulation.rmse]}
    )
    scores = {**motion.result.scores, "tests.steps": test.model_copy(update={"simulation": far})}
    beyond = fit_verdict(motion.result.model_copy(update={"scores": scores}))
    assert (
        "its error on tests.steps is 2 times that on the training data" in beyond.trust
        and beyond.level == "care"
    )
    hurts = lagged.result.validation.model_copy(update={"verdict": "hurts"})
    found = fit_verdict(lagged.result.model_copy(update={"validation": hurts, "advice": []}))
    assert found.level == "bad" and "physics alone (`learner.kind" in found.then
    assert all(
        sentence.endswith(".") for verdict in (good, ran, found) for sentence in verdict.sentences
    )


def test_a_fit_without_degrees_of_freedom_says_so():
    record = oa.Record.from_arrays([0.1, 0.9, -0.4], [0.0, 0.3, 0.7], inputs=["u"], outputs=["y"])
    physics = oa.Baseline.from_terms([oa.Term("a", "y[k-1]"), oa.Term("b", "u[k-1]")])
    found = oa.estimate(record, physics, learner=None).diagnose(blocks=0)
    assert "no_degrees_of_freedom" in [warning.code for warning in found.warnings]


def test_the_verdict_of_a_comparison_names_a_model(compared):
    verdict = compare_verdict(compared.result)
    names = [row.name for row in compared.result.comparison]
    assert (
        any(f"Take “{name}”" in verdict.trust for name in names)
        and "validation part" in verdict.then
    )
    first = next(row for row in compared.result.comparison if row.validation)
    twin = compared.result.model_copy(
        update={"comparison": [first, first.model_copy(update={"name": "twin"})]}
    )
    trust = compare_verdict(twin.model_copy(update={"chosen": None})).trust
    assert (
        "as does “twin”, and no other model has a smaller error" in trust
        and "the smallest of all models" not in trust
    )


def test_a_witness_is_reported_where_runs_are_shown(lagged):
    found = "train: findings and figures use 10 of 99 rows, in windows spread over them."
    page = Read(replace(lagged, result=with_warning(lagged, "witness", found)).report().html)
    (section,) = page.text("section", id="free-run")
    assert found in section


def test_minus_signs_of_texts_are_those_of_tables_and_short_cells_stay_whole(lagged):
    outcome = "moves a by -0.015, see `a-1`: y[k-1] goes from -2 to 3, by 5 % or −1 %"
    page = replace(lagged, result=with_warning(lagged, "small_margin", outcome)).report().html
    words = "moves a by −J0.015, see <code>a-1</code>: y[k-1] goes from −J2 to 3, by 5N% or −J1N%"
    assert words.replace("J", "\u2060").replace("N", "\xa0") in page  # no line ends within these
    whole = [
        "".join(text)
        for _, given, text in Read(page).found
        if "whole" in (given.get("class") or "").split()
    ]
    assert any(" … " in cell for cell in whole) and "(1)" in whole


def test_what_looks_like_markup_is_text(lagged):
    odd = "</script><b>&"
    origin = replace(origin_of(lagged.job, "fit"), toml=odd, name=odd)
    runs = {part: (one_step, replace(free, outputs=(Channel("y", odd),)))
            for part, (one_step, free) in lagged.responses.items()}  # fmt: skip
    page = Read(fit_page(FitPage(origin, lagged.result, runs)))
    assert page.text("pre")[-1] == odd and not page.text("b") and page.text("h1")[0].endswith(odd)


def test_the_page_does_not_import_plotly_nor_does_help():
    program = (
        "import sys; from orthaug.commands import cli; import orthaug.reports.page as page; "
        "page._plotly(); "
    )
    program += (
        "print([name for name in sys.modules if name.split('.')[0] in ('plotly', 'narwhals')])"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "[]"
    program = (
        "import sys; sys.argv = ['orthaug', '--help']\nfrom orthaug.commands.cli import main\n"
    )
    program += (
        "try: main()\nexcept SystemExit: print('reports.page' in str(sorted(sys.modules)), "
        "file=sys.stderr)"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    assert done.stderr.strip().endswith("False")


def test_a_learned_curve_fills_its_panel_where_data_are():
    """Beyond them it may go anywhere: a tank's went to thirty times what it learned."""
    along = np.linspace(-2, 2, 41)
    inside = np.abs(along) <= 1
    curve = Curve(along, inside, np.where(inside, along, 30 * along)[:, None], None)
    low, high = curve_limits(curve, 0, np.array([-1.1, 0.9]))
    assert -1.6 < low < -1.1 and 1.0 < high < 1.5


def test_the_bar_of_the_learner_is_the_share_that_the_table_says(motion):
    page = FitPage(origin_of(motion.job, "fit"), motion.result, motion.responses)
    table, bar = next(section.blocks for section in fit_sections(page) if section.key == "share")
    part = motion.result.motion.parts[0]
    assert bar.traces[0]["x"][0] == pytest.approx(100 * part.share)
    assert table.rows[0][-1] == percent(part.share) and "over that of their sum" in table.caption


def test_a_comparison_says_the_biases(compared):
    def heads(result):
        sections = compare_sections(ComparePage(origin_of(compared.job, "compare"), result, {}))
        table = next(section for section in sections if section.key == "parameters").blocks[-1]
        return table.head, table.rows[0][-1]

    def with_bias(bias):
        first = compared.result.comparison[0]
        parameters = [row.model_copy(update={"bias": bias}) for row in first.parameters]
        return compared.result.model_copy(
            update={"comparison": [first.model_copy(update={"parameters": parameters})]}
        )

    assert "bias" not in heads(with_bias(None))[0]
    head, cell = heads(with_bias(BiasResult(value=-0.25, cause="drag", share=0.9)))
    assert head[-1] == "bias" and cell == "−0.25"


def test_long_runs_open_where_the_model_errs_most():
    measured = np.sin(np.arange(3000) / 20)[:, None]
    model = measured.copy()
    model[1800:1900] += 0.5
    first = worst_window(measured, model, 400)
    assert first <= 1800 and first + 400 >= 1900
    model[100:120] = np.inf  # a run that left all bounds does not hide the rest
    assert worst_window(measured, np.where(np.isfinite(model), model, np.nan), 400) == first
    model, none = model.clip(-9, 9), np.zeros_like(measured)
    run = Trajectory(model, none, none, measured, 0)
    response = Response((run,), None, (Channel("y", "m"),), 0.01)
    (plot,) = run_plots([Run("train", response)], {})
    low, high = plot.layout["xaxis"]["range"]
    assert high - low == pytest.approx(399 * 0.01) and plot.whole == pytest.approx((0.0, 29.99))
    assert "where the error is largest" in plot.caption
    lost = Response((replace(run, diverged=(2500, "y")),), None, response.outputs, 0.01)
    (plot,) = run_plots([Run("train", lost)], {})
    low, high = plot.layout["xaxis"]["range"]
    assert low < 25.0 < high and "where the run diverges" in plot.caption
    short = Response(
        (Trajectory(measured[:300], measured[:300], 0 * measured[:300], measured[:300], 0),),
        None,
        response.outputs,
        0.01,
    )
    assert run_plots([Run("train", short)], {})[0].whole is None
