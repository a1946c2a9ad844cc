"""`orthaug reproduce`: every study at reduced size against stored values, its page, its refusals.

`python tests/test_reproduction.py` stores the values anew, in tests/references/studies.json. They are this program's
own: they show that nothing changed unnoticed. What is published is compared in the studies' findings.
"""

from __future__ import annotations

import csv
import importlib
import json
import math
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from test_cli import run as run_command

from orthaug._base.errors import InputError
from orthaug.studies.catalogue import catalogue
from orthaug.studies.entry import Finding
from orthaug.studies.reproduction import Reproduced, as_rows, chosen, is_reproduction, reproduce, text, write
from orthaug.studies.study import run
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
LABELS = """assum:phi_full_rank assum:data_gen_sys_recovered assum:baseline_mdl_dominant exmp:non-uniqueness
cond:special_PE cond:stable_sys cond:pred_stab cond:PE property:orthogonality lem:minimal_cost thm:error_val
thm:convergence thm:consistency thm:zero_cov"""
PAPER = Path(__file__).resolve().parents[2] / "shared" / "paper" / "orthogonal-by-construction.tex"

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


def reduced(store: Path) -> list[Reproduced]:
    """Every study at its reduced size."""
    return reproduce(chosen(None), small=True, store=store)


def stored_columns(one: Reproduced) -> dict[str, list]:
    """What is kept of a study: its axes, and the columns that are compared."""
    name = one.entry.name
    axes = list(one.entry.study("ours", True).grid)
    columns = [*axes, *TOLERANCES[name], *(["theta"] if name in EXACT else [])]
    return {column: one.table[column].tolist() for column in dict.fromkeys(columns)}


@pytest.fixture(scope="module")
def store(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("store")


@pytest.fixture(scope="module")
def found(store) -> list[Reproduced]:
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
    assert [entry.name for entry in chosen(None)] == list(NAMES)


@pytest.mark.parametrize("name", NAMES)
def test_values_are_the_stored_ones(found, references, name):
    one = next(o for o in found if o.entry.name == name)
    now, then = stored_columns(one), references[name]
    for axis in one.entry.study("ours", True).grid:
        assert now[axis] == then[axis]
    for column, (relative, absolute) in TOLERANCES[name].items():
        np.testing.assert_allclose(now[column], then[column], relative, absolute, err_msg=f"{name}, {column}")
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
        assert all(isinstance(part, str) and part for part in finding[:4]) and finding.verdict, finding
        assert isinstance(finding.met, bool)
        assert "nan" not in " ".join(finding[:4]).lower()
    quantities = [finding.quantity for finding in one.findings]
    assert len(set(quantities)) == len(quantities)


def by_quantity(found: list[Reproduced], name: str, start: str) -> Finding:
    one = next(o for o in found if o.entry.name == name)
    (finding,) = (f for f in one.findings if f.quantity.startswith(start))
    return finding


@pytest.mark.parametrize(
    ("name", "start"),
    [
        ("static_errors", "set 1, no noise, orthogonal: ‖"),
        ("static_errors", "set 2, no noise, orthogonal: ‖"),
        ("static_errors", "set 3, no noise, orthogonal: ‖"),
        ("static_errors", "set 3, uniform measure"),
        ("data_length", "set 2, the paper's record"),
        ("data_length", "set 3, the paper's record"),
        ("static_noise", "set 1, 30 dB, orthogonal, regularization none: ‖"),
        ("consistency", "set 1, 30 dB, the paper's record"),
        ("covariance", "P̂ between θ and the weights: largest correlation"),
        ("regularization_weight", "orthogonal: relative error"),
        ("regularization_weight", "orthogonal-penalty, λ = 100"),
        ("regularization_weight", "baseline-penalty, λ = 100"),
    ],
)
def test_what_no_sample_size_excuses_is_met(found, name, start):
    assert by_quantity(found, name, start).met


def test_the_text_has_a_line_per_finding(found):
    lines = text(found).splitlines()
    assert len(lines) == 1 + len(as_rows(found))
    assert all("  met  " in line or "  differs  " in line for line in lines[1:])


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
    assert all((image["src"] or "").startswith("data:image/png;base64,") and image["alt"] for image in tags.images)
    assert tags.ids == [*NAMES, "theory"] and tags.links == [f"#{name}" for name in tags.ids]
    plain = html.replace("&#39;", "'").replace("&#34;", '"').replace("&lt;", "<").replace("&gt;", ">")
    for finding in (finding for one in found for finding in one.findings):
        assert finding.quantity in plain and finding.verdict in plain and finding.ours in plain
    for statement in THEORY:
        assert all(part in plain for part in statement)
    assert "reduced size" in html and "http" not in html.replace("charset", "")


def test_the_folder_holds_figures_runs_and_findings(found, page):
    assert is_reproduction(page)
    for one in found:
        with (page / one.entry.name / "runs.csv").open(encoding="utf-8", newline="") as file:
            rows = list(csv.DictReader(file))
        assert len(rows) == len(one.table) and set(rows[0]) == set(one.table.columns)
        for name in one.figures:
            content = (page / one.entry.name / f"{name}.png").read_bytes()
            assert content.startswith(b"\x89PNG") and len(content) > 10_000
    content = json.loads((page / "reproduction.json").read_text(encoding="utf-8"))
    assert content["findings"] == as_rows(found) and content["pipeline"] == "ours"


def test_a_second_run_reads_the_store(found, store, monkeypatch):
    (first,) = (one for one in found if one.entry.name == "static_errors")
    study = first.entry.study("ours", True)
    monkeypatch.setattr("orthaug.studies.static_errors.trained", lambda *a, **k: pytest.fail("it ran again"))
    again = run(study, store=store)
    assert again.test_rmse.tolist() == first.table.test_rmse.tolist()


def test_the_theory_has_every_label_of_the_paper():
    labels = LABELS.split()
    if PAPER.is_file():
        kinds = "assum|exmp|cond|lem|thm|rem"
        source = PAPER.read_text(encoding="utf-8")
        found = re.findall(rf"\\begin\{{(?:{kinds})\}}(?:\[[^]]*\])?\s*\\label\{{([^}}]*)\}}", source)
        assert sorted(found) == sorted(labels)
        remarks = len(re.findall(r"\\begin\{rem\}", source))
        assert remarks == sum("emark" in statement.label for statement in THEORY)
    given = [statement.label for statement in THEORY]
    assert [label for label in labels if label not in given] == []
    assert all("\\" not in part and part.strip() for statement in THEORY for part in statement)


def test_what_the_theory_names_exists():
    root = Path(__file__).parent
    sources = {path.stem: path.read_text(encoding="utf-8") for path in root.glob("test_*.py")}
    for statement in THEORY:
        for place in re.findall(r"\b([a-z_]+(?:\.[a-z_]+)*)\.([A-Za-z_]+(?:\.[a-z_]+)*)", statement.computed):
            try:
                module = importlib.import_module(f"orthaug.{place[0]}")
            except ModuleNotFoundError:
                parts = place[1].split(".")
                module = importlib.import_module(f"orthaug.{place[0]}.{parts[0]}")
                place = (place[0], ".".join(parts[1:]))
            for name in filter(None, place[1].split(".")):
                module = getattr(module, name)
        for file in re.findall(r"tests/(test_\w+)\.py", statement.shown):
            assert file in sources
        file = ""
        for given, test in re.findall(r"(?:(test_\w+)\.)?(test_\w+)", statement.shown.replace("tests/", "/")):
            file = given or file
            if test not in sources:
                assert f"def {test}(" in sources[file], (file, test)
        for study in re.findall(r"stud(?:y|ies) (\w+)(?: and (\w+))?", statement.shown, flags=re.IGNORECASE):
            assert all(name in NAMES for name in study if "_" in name)


@pytest.mark.parametrize(
    ("name", "hint"), [("static_error", "static_errors"), ("consistancy", "consistency"), ("cover", "coverage")]
)
def test_an_unknown_study_has_a_nearest_one(name, hint):
    with pytest.raises(InputError, match=f"no study '{name}', did you mean '{hint}'"):
        chosen(name)


def test_an_unknown_pipeline_is_refused():
    with pytest.raises(InputError, match="--pipeline must be one of ours, paper, scripts; got 'nonsense'"):
        reproduce([], pipeline="nonsense")


def command(*arguments: str) -> list[str]:
    return [
        sys.executable,
        "-c",
        "import sys; from orthaug.commands.cli import main; sys.exit(main())",
        "reproduce",
        *arguments,
    ]


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


def test_ctrl_c_and_again(tmp_path):
    """Stopped by Ctrl-C, the next command goes on from what is kept."""
    if sys.platform != "linux":
        pytest.skip("the cache folder is elsewhere")
    whole = command("consistency", "--small", "--out", str(tmp_path / "out"))
    environment = dict(os.environ, XDG_CACHE_HOME=str(tmp_path / "cache"))
    process = subprocess.Popen(whole, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment)
    store = tmp_path / "cache" / "orthaug" / "studies"
    end = time.monotonic() + 60
    while not list(store.rglob("*.json")) and process.poll() is None and time.monotonic() < end:
        time.sleep(0.02)
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=60)
    kept = {path: path.stat().st_mtime_ns for path in store.rglob("*.json")}
    assert process.returncode != 0, "it was done before the signal came"
    assert kept and "Traceback" not in errors and not (tmp_path / "out").exists()
    done = subprocess.run(whole, capture_output=True, text=True, timeout=120, check=False, env=environment)
    assert done.returncode == 0, done.stderr
    assert {path: path.stat().st_mtime_ns for path in kept} == kept
    assert len(list(store.rglob("*.json"))) == len(catalogue()["consistency"].study("ours", True).cases())
    assert (tmp_path / "out" / "index.html").is_file()


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
    kept = {one.entry.name: {k: plain(v) for k, v in stored_columns(one).items()} for one in results}
    REFERENCES.parent.mkdir(exist_ok=True)
    REFERENCES.write_text(json.dumps(kept, ensure_ascii=False) + "\n", encoding="utf-8")
