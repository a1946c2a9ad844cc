"""`orthaug recover`: the truth is planted, the spec's own fit is run on it, and the report is what follows."""

from __future__ import annotations

import json
import shutil
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
from test_cli import finite_json, run, write_csv

import orthaug as oa

SPEC = """
[data]
sampling_time = 0.1
inputs = ["u", "w"]
outputs = ["y"]
train = { files = ["run.csv"] }
[[baseline.terms]]
parameter = "a"
regressor = "u[k]"
[[baseline.terms]]
parameter = "b"
regressor = "w[k]"
[[suspects]]
name = "cube"
kind = "cubic"
on = "u[k]"
coefficient = 0.5
[learner]
hidden = [3]
[training]
iterations = 15
focus = "prediction"
regularization = 0.01
[validation]
blocks = 0
"""
LAGGED = """
[data]
sampling_time = 0.1
inputs = ["u"]
outputs = ["y"]
train = { files = ["run.csv"] }
[[baseline.terms]]
parameter = "a"
regressor = "y[k-1]"
[[baseline.terms]]
parameter = "b"
regressor = "u[k-1]"
[learner]
hidden = [3]
[training]
iterations = 15
focus = "prediction"
regularization = 0.01
[validation]
blocks = 0
"""
ROWS = 200


@pytest.fixture
def static(tmp_path) -> Path:
    """The spec of a static system that lacks the cube of u."""
    rng = np.random.default_rng(4)
    u, w = rng.uniform(-1, 1, ROWS), rng.normal(size=ROWS)
    y = 2 * u - w + 0.5 * u**3 + 0.05 * rng.normal(size=ROWS)
    write_csv(tmp_path / "run.csv", u=u, w=w, y=y)
    (tmp_path / "plant.toml").write_text(SPEC)
    return tmp_path / "plant.toml"


@pytest.fixture
def lagged(tmp_path) -> Path:
    """The spec of a first-order system that lacks the square of its input."""
    rng = np.random.default_rng(5)
    u, y = rng.uniform(-1, 1, ROWS), np.zeros(ROWS)
    for k in range(1, ROWS):
        y[k] = 0.6 * y[k - 1] + 0.5 * u[k - 1] + 0.2 * u[k - 1] ** 2 + 0.02 * rng.normal()
    write_csv(tmp_path / "run.csv", u=u, y=y)
    (tmp_path / "plant.toml").write_text(LAGGED)
    return tmp_path / "plant.toml"


def test_the_bias_is_what_the_planted_term_does_to_least_squares(static):
    """θ of the orthogonal structure is Φ⁺Y (F1), so its error is Φ⁺Δ and noise, computed here in NumPy."""
    result = oa.recover(static, draws=4, choices=0, terms=["declared"]).result
    data = np.loadtxt(static.parent / "run.csv", delimiter=",", skiprows=1)
    u, w = data[:, 0], data[:, 1]
    expected = np.linalg.lstsq(np.column_stack([u, w]), 0.5 * u**3, rcond=None)[0]
    assert [term.coefficient for term in result.terms] == [0.5]
    for row, bias, column in zip(result.parameters, expected, (u, w), strict=True):
        noise = result.noise.std["y"] / np.linalg.norm(column) / np.sqrt(result.draws)
        assert row.bias == pytest.approx(bias, abs=4 * noise)
    assert result.parameters[0].bias > 0.25  # much of the cube is a slope
    assert result.noise.enters == "equation"


def test_more_rows_are_said_not_to_help_a_bias(static):
    made = oa.recover(static, draws=3, choices=1, terms=["declared"])
    a, b = made.result.parameters
    assert a.more_rows_help is False
    assert "More rows do not help a" in made.summary()
    assert b.rows_for_half == 4 * ROWS
    assert b.width_twice == pytest.approx(b.width / np.sqrt(2), rel=0.1)


def test_a_term_is_as_large_as_asked_for(static):
    """`share` is of the physics in the equation of the term."""
    result = oa.recover(static, draws=1, choices=0, share=0.2, terms=["declared"]).result
    data = np.loadtxt(static.parent / "run.csv", delimiter=",", skiprows=1)
    u, w = data[:, 0], data[:, 1]
    a, b = (row.true for row in result.parameters)
    rms = [
        np.sqrt(np.mean(part**2)) for part in (result.terms[0].coefficient * u**3, a * u + b * w)
    ]
    assert rms[0] == pytest.approx(0.2 * rms[1], rel=1e-6)


def test_every_choice_has_its_row(lagged):
    """Structures, measures, the learner inputs of F8, and rows, all on the same draws."""
    result = oa.recover(lagged, draws=2, choices=1, terms=["memory", "usual"]).result
    rows = {(choice.kind, choice.name): choice for choice in result.choices}
    assert {"declared", "structure", "measure", "inputs", "rows"} == {kind for kind, _ in rows}
    structures = {name for kind, name in rows if kind == "structure"}
    assert {"additive", "physics alone", "orthogonal-penalty"} <= structures
    alternatives = json.loads(run("check", lagged, "--json").out)["shared"]["alternatives"]
    assert {", ".join(one["inputs"]) for one in alternatives} == {
        name for kind, name in rows if kind == "inputs"
    }
    # with a learner that sees all lags θ is that of physics alone (F1): a check that all of it is the same draw
    alone, declared = rows["structure", "physics alone"], rows["declared", "as the spec says"]
    for one, other in zip(alone.parameters, declared.parameters, strict=True):
        assert one.bias == pytest.approx(other.bias, rel=1e-6, abs=1e-12)
    assert {term.source for term in result.terms} == {"memory", "usual"}
    assert any(term.memory for term in result.terms)


def test_an_interrupted_rehearsal_goes_on(static):
    """Each draw is a file; the ones that are there are not made again, and the result is the same."""
    out = static.parent / "out"
    arguments = (
        "recover",
        static,
        "--draws",
        3,
        "--choices",
        0,
        "--terms",
        "declared",
        "--out",
        out,
    )
    first = run(*arguments)
    assert first.code == 0, first.err
    assert "rehearsal: 3 fits for 3 draws. They take " in first.err
    *lines, last = first.out.splitlines()
    said = " ".join(lines)
    for head in ("held: ", "with bias: ", "silent: ", "bias: ", "width: ", "2 N: "):
        assert head in said, head
    assert last.startswith("written to") and max(map(len, lines)) <= 80
    kept = json.loads((out / "recover.json").read_text())
    assert (out / "figures" / "recovery.png").stat().st_size > 5000
    files = sorted((out / "draws").glob("*.json"))
    assert len(files) == 3 and kept["stored"] == 0
    files[1].unlink()
    dates = [file.stat().st_mtime_ns for file in files if file.exists()]
    again = finite_json(run(*arguments, "--json").out)
    assert again["stored"] == 2
    assert again["outcomes"] == kept["outcomes"]
    assert [file.stat().st_mtime_ns for file in files if file != files[1]] == dates
    more = finite_json(run(*arguments[:2], "--draws", 4, *arguments[4:], "--json").out)
    assert more["stored"] == 3 and more["outcomes"][:3] == kept["outcomes"]


def test_another_spec_is_refused_and_begins_anew_by_force(static):
    out = static.parent / "out"
    given = ("--draws", 1, "--choices", 0, "--terms", "declared", "--out", out)
    assert run("recover", static, *given).code == 0
    static.write_text(SPEC.replace("coefficient = 0.5", "coefficient = 0.25"))
    done = run("recover", static, *given)
    assert done.code == 2
    assert "holds draws of another spec or other data; give another --out, or begin" in done.err
    assert run("recover", static, *given, "--force").code == 0
    assert len(list((out / "draws").iterdir())) == 1
    assert json.loads((out / "recover.json").read_text())["terms"][0]["coefficient"] == 0.25


def test_draws_follow_their_seed(static):
    def values(seed: int) -> list[float]:
        made = oa.recover(static, draws=1, choices=0, terms=["declared"], seed=seed)
        return [one.value for one in made.result.outcomes[0].parameters.values()]

    assert values(1) == values(1) != values(2)


@pytest.mark.parametrize(
    ("change", "arguments", "words"),
    [
        ((), ("--draws", "0"), "`draws` must be a whole number from 1 to 10000; got 0"),
        ((), ("--choices", "-1"), "`choices` must be a whole number"),
        ((), ("--seed", "-1"), "`seed` must be a whole number"),
        ((), ("--share", "-0.1"), "share"),
        ((), ("--terms", "declared,usuall"), "must be one of declared, usual, memory"),
        ((), ("--terms", ","), "`terms` must be a list"),
        (('"run.csv"', '"absent.csv"'), (), "absent.csv: no such file"),
        ((), ("--out", "theirs"), "holds notes.txt and no manifest.json"),
        ((), ("--out", "theirs/notes.txt"), "not a folder"),
        ((), ("--out", "theirs/notes.txt/below"), "cannot be written"),
        (
            (("cubic", "expression"), ("u[k]", "2*u[k]")),
            ("--terms", "declared", "--share", "0.1"),
            "",
        ),
    ],
)
def test_bad_input_is_one_line(static, monkeypatch, change, arguments, words):
    monkeypatch.chdir(static.parent)
    Path("theirs").mkdir()
    Path("theirs/notes.txt").write_text("mine")
    if not words:  # a term that is the physics
        static.write_text(SPEC.replace('kind = "cubic"\non = "u[k]"', 'on = "2*u[k]"'))
        words = "no term can be planted (cube: zero on these rows, or a combination of the physics"
    elif change:
        static.write_text(SPEC.replace(*change))
    done = run("recover", static.name, *(arguments or ("--out", "new")))
    assert (done.code, done.out) == (2, "")
    assert words in done.err and done.err.count("\n") == 1, done.err
    assert Path("theirs/notes.txt").read_text() == "mine"
    assert not Path("new").exists() and not Path("orthaug-out").exists()


def test_physics_alone_is_rehearsed_with_what_it_lacks(static):
    static.write_text(SPEC.replace("hidden = [3]", 'kind = "none"'))
    made = oa.recover(static, draws=4, choices=1, terms=["declared"])
    result = made.result
    bias = next(one.bias for one in result.parameters if one.name == "a")
    assert bias == pytest.approx(0.5 * 3 / 5, abs=0.06)  # of u**3 along u, uniform in [-1, 1]
    assert {one.kind for one in result.choices} == {"declared", "rows"}
    assert "as large as the noise" in made.summary()


def test_python_takes_the_job_and_says_what_is_wrong(static):
    job = oa.load_spec(static)
    made = oa.recover(job, draws=1, choices=0, terms=["declared"])
    assert repr(made) == "Rehearsal(plant.toml: 1 draw)"
    with pytest.raises(oa.InputError, match="`terms` must be a list"):
        oa.recover(job, terms="usual")
    with pytest.raises(oa.InputError, match="`draws` must be a whole number"):
        oa.recover(job, draws=True)
    with pytest.raises(oa.InputError, match="`spec` must be"):
        oa.recover(3)  # type: ignore[arg-type]


def test_a_lost_helper_process_costs_time_only(static, monkeypatch):
    """The draws that another process was to make are made here where it fails."""
    from orthaug.commands import recover

    monkeypatch.setattr(recover.sys, "executable", shutil.which("false") or "false")
    monkeypatch.setattr(recover, "cores", lambda: 2)
    made = oa.recover(static, draws=5, choices=0, terms=["declared"])
    assert len(made.result.outcomes) == 5


@pytest.mark.proof
def test_the_gantry_pair(record_property, monkeypatch):
    """Making θ orthogonal to all of the physics is worse where the missing force lies in its span, else better."""
    monkeypatch.syspath_prepend(str(Path(__file__).resolve().parents[1] / "benchmarks"))
    inside, outside = import_module("recover").gantry(16)
    record_property("inside, all of θ over additive", f"{inside.all / inside.additive:.2g}")
    record_property("outside, additive over all of θ", f"{outside.additive / outside.all:.2g}")
    assert inside.spanned > 94 and outside.spanned < 3
    assert inside.all > 3 * inside.additive
    assert outside.additive > 3 * outside.all
    # the learner can imitate no direction of θ: then nothing is projected (F8)
    assert inside.shared == pytest.approx(inside.additive, rel=0.1)


@pytest.mark.proof
def test_a_motion_is_rehearsed(tmp_path, record_property):
    rng, step = np.random.default_rng(3), 0.02
    force, x, v, found = np.repeat(rng.uniform(-20, 20, 20), 20), 0.0, 0.0, []
    for u in force:
        found.append(x)
        for _ in range(20):
            v += step / 20 * (u - 2 * v - 100 * x - 1.5 * np.tanh(v / 0.05))
            x += step / 20 * v
    position = np.array(found) + 0.002 * rng.normal(size=len(force))
    write_csv(tmp_path / "run.csv", force=force, position=position)
    (tmp_path / "plant.toml").write_text("""
[data]
sampling_time = 0.02
inputs = ["force"]
outputs = ["position"]
train = { files = ["run.csv"] }
[motion.states]
x = { derivative = "v", start = "position" }
v = { derivative = "(force - c*v - k*x)", start = "derivative of position", learned = true }
[motion.outputs]
position = "x"
[motion.parameters]
c = { initial = 1.5, min = 0 }
k = { initial = 110.0, min = 0 }
[learner]
hidden = [4]
inputs = ["v"]
[[suspects]]
name = "friction"
kind = "coulomb"
on = "v"
coefficient = -1.5
[training]
iterations = 40
[validation]
blocks = 0
""")
    made = oa.recover(tmp_path / "plant.toml", draws=2, choices=1, terms=["declared", "memory"])
    result = made.result
    assert result.noise.enters == "output"
    assert result.noise.std["position"] == pytest.approx(0.002, rel=0.3)
    assert {term.source for term in result.terms} == {"declared", "memory"}
    k = next(row for row in result.parameters if row.name == "k")
    record_property("k, held", f"{k.held} of {k.shown}")
    assert k.true == pytest.approx(100, rel=0.05)
    friction = result.outcomes[0]
    assert friction.term == "friction"
    assert friction.parameters["k"].value == pytest.approx(k.true, rel=0.05)


def test_the_figure_is_there_for_a_draw_without_intervals(static):
    from orthaug.reports.finding_plots import recovery_figure
    from orthaug.reports.recovery import RecoverResult

    result = oa.recover(static, draws=2, choices=0, terms=["declared"]).result
    content = result.content()
    for one in content["outcomes"][1]["parameters"].values():
        one |= {"ci95": None, "with_bias": None, "held": None, "held_with_bias": None}
    figure = recovery_figure(RecoverResult.model_validate(content))
    assert len(figure.axes) == 2


@pytest.mark.parametrize(("shown", "said"), [(5, True), (6, False)])
def test_estimates_without_an_interval_are_counted(shown, said):
    from orthaug.reports.recovery import _sentences

    row = {"name": "c", "draws": 3, "silent": 0, "more_rows_help": None}
    rows = [
        {**row, "held_with_bias": 3, "shown": 3},
        {**row, "held_with_bias": 2, "shown": shown - 3},
    ]
    found = _sentences({"parameters": rows, "choices": [], "designs": [1]})
    assert ("1 of 6 estimates have no interval." in found) == said
