"""`orthaug reproduce`: every study at reduced size against stored values, its page, its refusals.

`python tests/test_reproduction.py` stores the values anew, in tests/references/studies.json. They are this program's
own: they show that nothing changed unnoticed. What is published is compared in the studies' findings.
"""

from __future__ import annotations

import csv
import json
import math
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from html import unescape
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from test_cli import run as run_command

from orthaug import InputError
from orthaug.studies.common import Counts, Finding, extremes, panels, scripts_bars, whiskers
from orthaug.studies.references import Spread
from orthaug.studies.reproduction import (
    HYPHEN,
    WIDTH,
    StudyOutcome,
    as_rows,
    catalogue,
    choose_studies,
    reproduce,
    text,
    when_text,
    write,
)
from orthaug.studies.study import Run, run
from orthaug.studies.theory import THEORY

REFERENCES = Path(__file__).parent / "references" / "studies.json"
NAMES = (
    "static_errors",
    "data_length",
    "static_noise",
    "covariance",
    "consistency",
    "regularization_weight",
    "coverage",
    "solver_times",
)
# columns of each study: relative and absolute tolerance. θ that is solved is exact on every machine; what training
# found moves with rounding, so it is compared loosely; what is absent is compared nowhere (seconds, lottery)
TOLERANCES: dict[str, dict[str, tuple[float, float]]] = {
    "static_errors": {"test_rmse": (9.0, 0.0), "uniform_error": (0.0, 1e-4)},
    "data_length": {"theta_error": (1e-6, 2e-4)},
    "static_noise": {"test_rmse": (0.4, 0.0)},
    "covariance": {"std": (0.02, 0.0), "std_paper": (0.02, 0.0), "zeros_across": (0.0, 0.5)},
    "consistency": {},
    "regularization_weight": {"one_step": (0.5, 0.0), "free_run": (0.5, 0.0)},
    "coverage": {"theta": (1e-9, 0.0), "training_width": (0.05, 0.0), "uniform_width": (0.3, 0.0)},
    "solver_times": {"loss": (0.5, 1e-5)},
}
EXACT: dict[str, str] = {  # rows of which θ is solved, whatever the learner does
    "static_errors": "structure == 'orthogonal'",
    "data_length": "measure == 'training'",
    "static_noise": "structure == 'orthogonal'",
    "consistency": "curve == 'orthogonal'",
    "regularization_weight": "structure == 'orthogonal'",
}


def reduced(store: Path) -> list[StudyOutcome]:
    """Every study at its reduced size; where training takes longest it ends before it has converged.

    The uniform measure's rule has 2¹² of its 2²⁰ nodes, which integrate these smooth functions to rounding as well.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("orthaug.inference.measures._NODES", (1 << 12, 512, 64))
        patch.setattr("orthaug.studies.regularization_weight.ITERATIONS", 15)
        return reproduce(choose_studies(None), small=True, store=store)


def stored_columns(one: StudyOutcome) -> dict[str, list]:
    """What is kept of a study: its axes, and the columns that are compared."""
    name = one.entry.name
    axes = list(one.entry.study("ours", True).grid)
    columns = [*axes, *TOLERANCES[name], *(["theta"] if name in EXACT else [])]
    return {column: one.table[column].tolist() for column in dict.fromkeys(columns)}


@pytest.fixture(scope="module")
def store(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("store")


@pytest.fixture(scope="module")
def found(store) -> list[StudyOutcome]:
    return reduced(store)


@pytest.fixture(scope="module")
def page(found, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("page") / "out"
    write(found, folder, "ours")
    return folder


@pytest.fixture(scope="module")
def references() -> dict:
    return json.loads(REFERENCES.read_text(encoding="utf-8"))


def test_the_catalogue_is_in_the_papers_order():
    assert tuple(catalogue()) == NAMES
    assert [entry.name for entry in choose_studies(None)] == list(NAMES)


@pytest.mark.parametrize("name", NAMES)
def test_values_are_the_stored_ones(found, references, name):
    one = next(o for o in found if o.entry.name == name)
    now, then = stored_columns(one), references[name]
    for axis in one.entry.study("ours", True).grid:
        assert now[axis] == then[axis]
    for column, (relative, absolute) in TOLERANCES[name].items():
        np.testing.assert_allclose(
            now[column], then[column], relative, absolute, err_msg=f"{name}, {column}"
        )
    if name in EXACT:
        rows = one.table.reset_index(drop=True).query(EXACT[name]).index
        assert len(rows)
        values = [np.array([kept["theta"][i] for i in rows]) for kept in (now, then)]
        np.testing.assert_allclose(*values, rtol=1e-9, err_msg=f"{name}, θ")


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("pipeline", ["ours", "paper", "scripts"])
def test_the_full_size_is_larger_and_holds_the_reduced_axes(name, pipeline):
    entry = catalogue()[name]
    full, small = (entry.study(pipeline, reduced) for reduced in (False, True))
    assert len(small.cases()) < len(full.cases())
    assert list(full.grid) == list(small.grid) and full.one is small.one and full.name == name


@pytest.mark.parametrize("name", NAMES)
def test_findings_are_sentences_without_holes(found, name):
    one = next(o for o in found if o.entry.name == name)
    assert len(one.findings) >= 2 and one.figures and one.entry.text.endswith(".")
    for finding in one.findings:
        assert all(isinstance(part, str) for part in finding[:5]) and all(finding[:3]), finding
        assert all(mark is None or type(mark) is bool for mark in finding[5:])
        # what is met or missed has something to be compared with
        assert finding.published or finding.as_published is None
        assert finding.scripts or finding.as_scripts is None
        assert "nan" not in " ".join(finding[:5]).lower()


def test_a_quantity_is_counted_once(found):
    quantities = [finding.quantity for one in found for finding in one.findings]
    assert len(set(quantities)) == len(quantities)
    # Φ⁺Y of the paper's noisy record is the answer of every regularization and of the shortest consistency run
    shown = [
        finding for one in found for finding in one.findings if finding.ours.startswith("0.0089013")
    ]
    assert len(shown) == 1


@pytest.mark.parametrize("name", NAMES)
def test_figures_say_in_sentences_what_they_show(found, name):
    one = next(o for o in found if o.entry.name == name)
    for drawing in one.figures.values():
        assert (
            drawing.shows[0].isupper()
            and drawing.shows.endswith(".")
            and len(drawing.shows.split()) > 8
        )
        assert drawing.reading == "" or (
            drawing.reading[0].isupper() and drawing.reading.endswith(".")
        )
        assert ".png" not in drawing.shows


@pytest.mark.parametrize("name", NAMES)
def test_logarithmic_axes_are_not_stretched_by_rounding(found, name):
    one = next(o for o in found if o.entry.name == name)
    for drawing in one.figures.values():
        for axis in drawing.figure.axes:
            low, high = sorted(axis.get_ylim())
            assert axis.get_yscale() == "linear" or 0 < high < 1e12 * low


def test_whiskers_end_at_the_smallest_and_the_largest_value():
    """As far below as it may be, which mean minus deviation is not."""
    table = pd.DataFrame({"n": [1, 1, 1, 2, 2, 2], "error": [1e-6, 1.0, 10.0, 3.0, 2.0, 4.0]})
    _, (axis,) = panels(1)
    whiskers(axis, [1, 2], extremes(table, "n", "error"), "orthogonal")
    (drawn,) = axis.containers
    middle, (low, high) = drawn[0].get_ydata(), (cap.get_ydata() for cap in drawn[1])
    assert list(middle) == [1.0, 3.0]
    np.testing.assert_allclose(
        np.array([low, high], dtype=float), [[1e-6, 2.0], [10.0, 4.0]], rtol=1e-9
    )


def test_what_the_scripts_gave_is_drawn_from_their_smallest_to_their_largest_run():
    _, (axis,) = panels(1)
    scripts_bars(axis, [1.0], [Spread(2.0, 0.5, 9.0, 10)], "additive")
    (drawn,) = axis.containers
    assert [float(line.get_ydata()[0]) for line in (drawn[0], *drawn[1])] == [2.0, 0.5, 9.0]


def by_quantity(found: list[StudyOutcome], name: str, start: str) -> Finding:
    one = next(o for o in found if o.entry.name == name)
    (finding,) = (f for f in one.findings if f.quantity.startswith(start))
    return finding


@pytest.mark.parametrize(
    ("name", "start", "by_paper", "by_scripts"),
    [
        ("static_errors", "set 1, no noise, orthogonal: ‖", True, True),
        ("static_errors", "set 2, no noise, orthogonal: ‖", True, True),
        ("static_errors", "set 3, no noise, orthogonal: ‖", True, True),
        ("static_errors", "set 3, no noise, uniform measure", None, None),
        ("static_errors", "set 1, no noise, additive from θ⁰: ‖", True, True),
        ("static_errors", "set 1, no noise, additive, θ eliminated: ‖", None, None),
        ("static_errors", "set 1, no noise, additive, θ eliminated: test", None, None),
        ("static_noise", "set 1, 30 dB, orthogonal: ‖", True, True),
        (
            "covariance",
            "P̂ between θ and the weights: share of entries below 10⁻⁶ of the geometric",
            True,
            None,
        ),
        (
            "covariance",
            "P̂ between θ and the weights: share of entries below 10⁻⁶ in absolute value",
            True,
            None,
        ),
        ("regularization_weight", "orthogonal: relative error", None, True),
        ("regularization_weight", "orthogonal-penalty, λ = 100", True, None),
        ("regularization_weight", "baseline-penalty, λ = 100", True, None),
        ("regularization_weight", "runs that converged", None, None),
        ("coverage", "set 1, 30 dB, training measure", None, None),
        ("solver_times", "static example, Adam, then L-BFGS", None, None),
    ],
)
def test_what_no_sample_size_excuses(found, name, start, by_paper, by_scripts):
    finding = by_quantity(found, name, start)
    assert (finding.as_published, finding.as_scripts) == (by_paper, by_scripts)
    assert finding.beyond is (by_paper is None and by_scripts is None)


def test_the_only_additive_structure_of_a_pipeline_is_compared_with_the_scripts(found):
    """As both other pipelines have it, whose θ always starts at θ⁰."""
    one = next(one for one in found if one.entry.name == "static_errors")
    findings = one.entry.findings(one.table[one.table.structure != "additive-initial"])
    alone = [finding for finding in findings if ", additive: " in finding.quantity]
    assert len(alone) == 6 and all(finding.as_scripts is not None for finding in alone)
    assert not any("eliminated" in finding.quantity for finding in findings)


def test_the_uniform_measure_leaves_a_hundredth_of_the_error(found):
    table = next(one for one in found if one.entry.name == "static_errors").table
    rows = table[(table.data_set == 3) & (table.structure == "orthogonal")]
    assert rows.uniform_error.max() < 0.01 * rows.theta_error.min()


def test_the_papers_record_has_the_scripts_error_at_every_place_where_it_is_solved(found):
    """It is shown once, and solved in three studies."""
    tables = {one.entry.name: one.table for one in found}
    noise, lengths, errors = (
        tables[name] for name in ("consistency", "data_length", "static_errors")
    )
    own = noise[
        (noise.data_set == 1)
        & (noise.curve == "orthogonal")
        & (noise.run == 0)
        & (noise.samples == 1024)
    ]
    solved = tables["static_noise"].query("structure == 'orthogonal'").theta_error
    np.testing.assert_allclose(solved, own.theta_error.iloc[0], rtol=1e-9)
    for data_set in (2, 3):
        of = errors[(errors.data_set == data_set) & (errors.structure == "orthogonal")].theta_error
        paper = lengths.query(
            f"data_set == {data_set} and measure == 'training' and draw == 0 and samples == 1024"
        )
        np.testing.assert_allclose(of, paper.theta_error.iloc[0], rtol=1e-9)


def test_the_papers_sums_of_squares_are_compared_with_sums_of_squares(found):
    one = next(o for o in found if o.entry.name == "static_noise")
    rows = one.table.query("regularization == 'none' and structure == 'orthogonal'")
    finding = by_quantity(
        found, "static_noise", "set 1, 30 dB, orthogonal: sum of squared test errors"
    )
    squares = 1024 * rows.test_rmse**2
    assert finding.published == "0.000535" and finding.ours.startswith(f"{squares.mean():.3g}")
    assert finding.as_published is bool(squares.min() <= 5.35e-4 <= squares.max())
    # on the axis of RMSE the printed sum is drawn as the RMSE that it amounts to, which the scripts' own runs have
    axis = one.figures["errors"].figure.axes[0]
    (line,) = (line for line in axis.lines if line.get_label() == "the paper's table, orthogonal")
    assert float(np.asarray(line.get_ydata())[0]) == pytest.approx(1e3 * (5.35e-4 / 1024) ** 0.5)


@pytest.mark.parametrize(("slowest", "noisy"), [(1.2, False), (1.3, True)])
def test_a_time_that_differs_from_start_to_start_is_no_result(found, slowest, noisy):
    one = next(o for o in found if o.entry.name == "solver_times")
    rows = [
        dict(one.table.iloc[i]) | {"seed": seed} for i in range(len(one.table)) for seed in range(2)
    ]
    seconds = [row["iterations"] * (slowest if row["seed"] else 1.0) for row in rows]
    findings = one.entry.findings(pd.DataFrame(rows).assign(seconds=seconds))
    assert all(("noisy" in finding.ours) is noisy for finding in findings)
    assert all(("no result in time" in finding.verdict) is noisy for finding in findings)


def test_counts_keep_the_three_kinds_apart():
    rows = [
        Finding("a", "1", "x", "1", "2", as_published=True, as_scripts=False),
        Finding("b", "1", "x", scripts="1", as_scripts=True),
        Finding("c", "1", "x", "1", as_published=False),
        Finding("d", "1", "x", scripts="shown, but not comparable"),
        Finding("e", "1", "x"),
    ]
    assert Counts.of(rows) == Counts(
        published_met=1, published=2, scripts_met=1, scripts=2, beyond=2
    )
    assert [row.beyond for row in rows] == [False, False, False, True, True]


def test_the_text_fits_a_terminal_and_counts(found):
    lines, counts = (
        text(found).splitlines(),
        Counts.of(finding for one in found for finding in one.findings),
    )
    assert max(map(len, lines)) <= WIDTH == 100
    made, whole_size = sum(len(one.runs) for one in found), sum(one.whole for one in found)
    assert any(
        line.startswith(f"small: {made} of {whole_size} runs. At this size differences")
        for line in lines
    )
    assert lines[-3:] == [
        f"met against the printed paper: {counts.published_met} of {counts.published}",
        f"met against its scripts, as measured: {counts.scripts_met} of {counts.scripts}",
        f"beyond the paper, neither met nor missed: {counts.beyond}",
    ]
    whole = " ".join(lines)
    assert all(one.entry.title in whole for one in found)
    assert whole.count("(met)") <= counts.published_met + counts.scripts_met
    assert "(differs)" not in whole and all(
        f"small: {len(o.runs)} of {o.whole} runs" in lines for o in found
    )
    # a quantity is wrapped in its column, so that its first words are together
    assert all(finding.quantity[:12] in whole for one in found for finding in one.findings)


def test_when_runs_were_made_is_said_apart_for_stored_ones():
    now = [Run({}, {}, "2025-03-04T10:00:00+00:00", 1.5, stored=False)]
    old = [Run({}, {}, f"2025-03-0{day}T10:00:00+00:00", 10.0, stored=True) for day in (1, 3, 2)]
    assert when_text(now) == "1 run: 1 made now, on 2025-03-04 in 1.5 s, summed over runs"
    assert when_text(now + old) == (
        "4 runs: 1 made now, on 2025-03-04 in 1.5 s; "
        "3 read from the store, made on 2025-03-01 to 2025-03-03 in 30 s, summed over runs"
    )


class Tags(HTMLParser):
    """Counts tags and refuses any that is not closed in its place."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.images: list[dict[str, str | None]] = []
        self.ids: list[str | None] = []
        self.links: list[str | None] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = dict(attrs)
        if tag == "img":
            self.images.append(given)
        if "id" in given:
            self.ids.append(given["id"])
        if tag == "a":
            self.links.append(given["href"])
        if tag not in ("meta", "img", "br"):
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def test_the_page_holds_every_figure_and_finding(found, page):
    html = (page / "index.html").read_text(encoding="utf-8")
    tags = Tags()
    tags.feed(html)
    assert not tags.open
    assert len(tags.images) == sum(len(one.figures) for one in found)
    assert all((image["src"] or "").startswith("data:image/png;base64,") for image in tags.images)
    alts = [drawing.shows for one in found for drawing in one.figures.values()]
    assert [image["alt"] for image in tags.images] == alts
    assert tags.ids == [*NAMES, "theory"] and tags.links == [f"#{name}" for name in tags.ids]
    plain = unescape(html.replace(HYPHEN, "-"))
    for finding in (finding for one in found for finding in one.findings):
        assert finding.quantity in plain and finding.verdict in plain and finding.ours in plain
    for statement in THEORY:
        assert all(part in plain for part in statement)
    assert (
        "At this size differences from the paper and its scripts are expected" in plain
        and "http" not in html.replace("charset", "")
    )
    rows = [finding for one in found for finding in one.findings]
    marks = [
        mark for row in rows for mark in (row.as_published, row.as_scripts) if mark is not None
    ]
    assert html.count("✓ met") == sum(marks) and html.count("≠ differs at small size") == len(
        marks
    ) - sum(marks)
    assert html.count("≠ differs") == len(marks) - sum(marks)
    assert all(
        f"small: {len(one.runs)} of {one.whole} runs of the full size." in plain for one in found
    )
    counts = Counts.of(rows)
    assert f"<td>{counts.published_met} of {counts.published}</td>" in html
    assert f"<td>{counts.scripts_met} of {counts.scripts}</td><td>{counts.beyond}</td>" in html


def test_the_folder_holds_figures_runs_and_findings(found, page):
    names = [path.relative_to(page).as_posix() for path in page.rglob("*") if path.is_file()]
    known = re.compile(r"(reproduction|manifest)\.json|index\.html|[a-z_]+/(runs\.csv|[\w-]+\.png)")
    assert [name for name in names if not known.fullmatch(name)] == []
    for one in found:
        with (page / one.entry.name / "runs.csv").open(encoding="utf-8", newline="") as file:
            rows = list(csv.DictReader(file))
        assert len(rows) == len(one.table) and set(rows[0]) == set(one.table.columns)
        for name in one.figures:
            content = (page / one.entry.name / f"{name}.png").read_bytes()
            assert content.startswith(b"\x89PNG") and len(content) > 10_000
    content = json.loads((page / "reproduction.json").read_text(encoding="utf-8"))
    assert content["findings"] == as_rows(found) and content["pipeline"] == "ours"
    size = content["size"]
    assert (
        size["small"] is True
        and "differences from the paper and its scripts are expected" in size["text"]
    )
    assert size["studies"] == {
        one.entry.name: {"runs": len(one.runs), "of": one.whole} for one in found
    }
    assert all(part["runs"] < part["of"] for part in size["studies"].values())
    assert content["counts"]["beyond"] == sum(
        finding.beyond for one in found for finding in one.findings
    )
    assert content["runs"] == {one.entry.name: when_text(one.runs) for one in found}


def test_runs_of_a_store_are_the_same_file_and_said_to_be_stored(found, page, store, tmp_path):
    again = reproduce(choose_studies("static_noise"), small=True, store=store)
    write(again, tmp_path / "again", "ours")
    place = "static_noise/runs.csv"
    assert (tmp_path / "again" / place).read_bytes() == (page / place).read_bytes()
    html = (tmp_path / "again" / "index.html").read_text(encoding="utf-8")
    assert f"{len(again[0].runs)} read from the store" in html and "made now" not in html
    assert "made now" in (page / "index.html").read_text(encoding="utf-8")


def test_a_second_run_reads_the_store(found, store, monkeypatch):
    (first,) = (one for one in found if one.entry.name == "static_errors")
    study = first.entry.study("ours", True)
    monkeypatch.setattr(
        "orthaug.studies.static_errors.train", lambda *a, **k: pytest.fail("it ran again")
    )
    again = run(study, store=store)
    assert again.test_rmse.tolist() == first.table.test_rmse.tolist()


@pytest.mark.parametrize(
    ("name", "hint"),
    [("static_error", "static_errors"), ("consistancy", "consistency"), ("cover", "coverage")],
)
def test_an_unknown_study_has_a_nearest_one(name, hint):
    with pytest.raises(InputError, match=f"no study '{name}', did you mean '{hint}'"):
        choose_studies(name)


def test_an_unknown_pipeline_is_refused():
    with pytest.raises(
        InputError, match="--pipeline must be one of ours, paper, scripts; got 'nonsense'"
    ):
        reproduce([], pipeline="nonsense")


def test_the_full_size_makes_no_excuse(found, tmp_path):
    """The same runs as if they were all: nothing is called small."""
    (one,) = (o for o in found if o.entry.name == "static_noise")
    full = [replace(one, small=False)]
    shown = " ".join(text(full).split())
    assert "small:" not in shown and "at small size" not in shown and "differs)" in shown
    write(full, tmp_path / "out", "ours")
    content = json.loads((tmp_path / "out" / "reproduction.json").read_text(encoding="utf-8"))[
        "size"
    ]
    assert content["small"] is False and content["text"] is None
    html = (tmp_path / "out" / "index.html").read_text(encoding="utf-8")
    assert "small:" not in html and "at small size" not in html and "≠ differs" in html


def test_longer_training_is_named_where_the_papers_sum_is_missed(found):
    """The row says what ours is when training stops early, and with how many effective weights."""
    (one,) = (o for o in found if o.entry.name == "static_noise")
    rows = one.table.query("regularization == 'stopping' and structure == 'orthogonal'")
    finding = by_quantity(
        found, "static_noise", "set 1, 30 dB, orthogonal: sum of squared test errors"
    )
    assert (
        f"after 50 iterations ours is {1024 * (rows.test_rmse**2).mean():.3g} (" in finding.verdict
    )
    assert f"with {rows.effective_weights.mean():.3g} instead of " in finding.verdict
    plain = one.table[one.table.regularization == "none"]  # as the other pipelines have it
    assert not any("after 50" in finding.verdict for finding in one.entry.findings(plain))


def command(*arguments: str) -> list[str]:
    """The program as it is started; children of a background job would ignore Ctrl-C."""
    program = (
        "import signal; signal.signal(signal.SIGINT, signal.default_int_handler); "
        "from orthaug.commands.entry import main; main()"
    )
    return [sys.executable, "-c", program, "reproduce", *arguments]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["static_error"], "did you mean 'static_errors'?"),
        (["--pipeline", "nonsense"], "must be one of ours, paper, scripts"),
    ],
)
def test_refusals_of_the_command(tmp_path, arguments, message):
    done = run_command("reproduce", *arguments, "--out", tmp_path / "out")
    assert done.code == 2 and message in done.err and "Traceback" not in done.err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("number", "words"), [(signal.SIGINT, "interrupted"), (signal.SIGTERM, "terminated")]
)
def test_stopped_and_again(tmp_path, page, monkeypatch, number, words):
    """Stopped by a signal it names no file of the cache; the next command goes on from what is kept."""
    if sys.platform != "linux":
        pytest.skip("the cache folder is elsewhere")
    whole = command("consistency", "--small", "--out", str(tmp_path / "out"))
    environment = dict(os.environ, XDG_CACHE_HOME=str(tmp_path / "cache"))
    process = subprocess.Popen(
        whole, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment
    )
    store = tmp_path / "cache" / "orthaug" / "studies"
    end = time.monotonic() + 60
    while not list(store.rglob("*.json")) and process.poll() is None and time.monotonic() < end:
        time.sleep(0.02)
    process.send_signal(number)
    _, errors = process.communicate(timeout=60)
    kept = {path: path.stat().st_mtime_ns for path in store.rglob("*.json")}
    assert process.returncode == 128 + number, "it was done before the signal came"
    title, done = catalogue()["consistency"].title, r"\d+ of \d+ runs done"
    then = "The finished runs are kept; the same command continues from there"
    assert re.fullmatch(
        f"{words} during '{title}', {done}; nothing is written. {then}\n", errors
    ), errors
    assert kept and not (tmp_path / "out").exists()
    monkeypatch.setenv("XDG_CACHE_HOME", environment["XDG_CACHE_HOME"])
    done = run_command(*whole[3:])
    assert done.code == 0, done.err
    assert {path: path.stat().st_mtime_ns for path in kept} == kept
    assert len(list(store.rglob("*.json"))) == len(
        catalogue()["consistency"].study("ours", True).cases()
    )
    html = (tmp_path / "out" / "index.html").read_text(encoding="utf-8")
    assert "read from the store" in html and "made now" in html
    # as it would be without the interruption
    assert (tmp_path / "out" / "consistency" / "runs.csv").read_bytes() == (
        page / "consistency" / "runs.csv"
    ).read_bytes()


def plain(value):
    """Twelve digits, which is more than the comparison needs, and no NaN."""
    if isinstance(value, list):
        return [plain(item) for item in value]
    if isinstance(value, float):
        return float(f"{value:.12g}") if math.isfinite(value) else None
    return value


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        results = reduced(Path(folder))
    kept = {
        one.entry.name: {k: plain(v) for k, v in stored_columns(one).items()} for one in results
    }
    REFERENCES.parent.mkdir(exist_ok=True)
    REFERENCES.write_text(json.dumps(kept, ensure_ascii=False) + "\n", encoding="utf-8")
