"""What a learner has found: terms with their coefficients, the loop to the true physics, and where there is nothing."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from test_cli import one_line, run, write_csv

import orthaug as oa
from orthaug import InputError, Output, State
from orthaug._base.lines import narrow_screen
from orthaug.analysis.findings import MemoryResult
from orthaug.data.expressions import parse_named
from orthaug.reports.explanation import ExplainResult, explain_text
from orthaug.selection.explaining import Candidate, _expression_text, candidates_of
from orthaug.selection.explanation import NewTerm, SingleTerm, _base_name, added_to_motion
from orthaug.selection.learned_linearization import (
    MotionResponse,
    _move_parameters,
    linearization_of,
)

ROWS = 600
SPEC = """
[data]
sampling_time = 0.1
inputs = ["u"]
outputs = ["y"]
train = { files = ["run.csv"] }
[data.channels]
y = { unit = "m" }
[[baseline.terms]]
parameter = "a"
regressor = "y[k-1]"
[[baseline.terms]]
parameter = "b"
regressor = "y[k-2]"
[[baseline.terms]]
parameter = "g"
regressor = "u[k-1]"
"""
ALONE = '[learner]\nkind = "none"\n'
LEARNER = "[learner]\nhidden = [6]\n"
TRUE = {"a": 0.6, "b": -0.2, "g": 1.0}


def system(cubic: float, noise: float = 0.02) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    u, y = rng.uniform(-1, 1, ROWS), np.zeros(ROWS)
    for k in range(2, ROWS):
        y[k] = (
            0.6 * y[k - 1]
            - 0.2 * y[k - 2]
            + u[k - 1]
            + cubic * y[k - 1] ** 3
            + noise * rng.normal()
        )
    return {"u": u, "y": y}


def fitted(cubic: float, **options) -> oa.Estimate:
    given = system(cubic)
    units = {"inputs": [oa.Channel("u", "V")], "outputs": [oa.Channel("y", "m")]}
    record = oa.Record.from_arrays(given["u"], given["y"], **units, sampling_time=0.1)
    terms = [oa.Term("a", "y[k-1]"), oa.Term("b", "y[k-2]"), oa.Term("g", "u[k-1]")]
    return oa.estimate(
        record, oa.Baseline.from_terms(terms), **{"learner": oa.MLP(hidden=(6,)), **options}
    )


@pytest.fixture(scope="module")
def hardening() -> oa.Estimate:
    return fitted(-0.3)


def test_a_cubic_is_found_with_its_coefficient_and_theta(hardening):
    found = oa.explain(hardening)
    (term,) = found.terms
    assert term.expression == "y[k-1]**3" and term.unit == "1/m**2" and term.added_to == "y"
    assert (
        term.coefficient == pytest.approx(-0.3, rel=0.03)
        and abs(term.coefficient + 0.3) < 4 * term.std
    )
    assert found.share > 0.95 and term.alone == pytest.approx(found.share)
    assert found.p < 1e-6 and found.noise < 0.05
    now = {moved.name: moved.value for moved in found.parameters}
    then = {moved.name: moved.value_with for moved in found.parameters}
    assert now["a"] < 0.45, "the physics took on the cubic's nearest line"
    assert then == pytest.approx(TRUE, abs=0.01)


def test_the_physics_with_the_term_leaves_the_learner_nothing(hardening):
    grown = oa.explain(hardening).physics
    assert grown.names == ("a", "b", "g", "cubic") and grown.initial[3] == pytest.approx(
        -0.3, rel=0.03
    )
    again = fitted(-0.3, learner=None)
    again = oa.estimate(again.problem.record, grown, learner=oa.MLP(hidden=(6,)))
    result = oa.explain(again)
    assert (
        not result.found and result.physics is None and result.spec is None and result.share == 0.0
    )
    assert "is not significant against its own errors" in result.text
    assert dict(zip(grown.names, again.theta, strict=True)) == pytest.approx(
        TRUE | {"cubic": -0.3}, abs=0.01
    )


def test_a_suspect_that_is_given_is_tried(hardening):
    own = oa.Suspect("strange", "y[k-1]**3 + 0.02*y[k-2]**2")
    assert oa.explain(hardening, suspects=[own], degree=1).singles
    with pytest.raises(InputError, match="adds nothing to 'w', but to y"):
        oa.explain(hardening, suspects=[oa.Suspect("far", "y[k-1]**3", output="w")])


def test_a_function_from_another_toolbox_is_explained_as_it_is():
    given = fitted(-0.3, learner=None).problem
    plant = lambda x: (x @ [0.6, -0.2, 1.0] - 0.3 * x[:, 0] ** 3)[:, None]  # noqa: E731
    found = oa.explain(oa.orthogonalize(given.record, given.baseline, plant))
    (term,) = found.terms
    assert (
        term.expression == "y[k-1]**3"
        and term.coefficient == pytest.approx(-0.3)
        and term.std is None
    )
    assert found.share == pytest.approx(1) and found.p is None and found.noise is None
    assert [moved.value_with for moved in found.parameters] == pytest.approx(list(TRUE.values()))


def test_an_expression_with_commas_is_reported_as_it_is_written():
    given = fitted(-0.3, learner=None).problem
    plant = lambda x: (x @ [0.6, -0.2, 1.0] + x[:, 2] - np.clip(x[:, 2], -0.4, 0.4))[:, None]  # noqa: E731
    found = oa.explain(oa.orthogonalize(given.record, given.baseline, plant))
    (term,) = found.terms
    assert term.kind in ("dead_zone", "saturation")  # beside the linear term they are the same
    assert ", " in term.expression and found.text.startswith(f"{term.expression} explains")


def test_terms_of_several_equations_are_named_with_them():
    rng = np.random.default_rng(5)
    u, y = rng.uniform(-1, 1, ROWS), np.zeros((ROWS, 2))

    def plant(x):
        cubes = x[:, :2] ** 3
        return np.column_stack([x @ [0.6, 0.1, 0.5], x @ [0.0, 0.5, 0.4]]) - 0.2 * cubes[:, [0, 0]]

    for k in range(1, ROWS):
        y[k] = plant(np.array([[*y[k - 1], u[k - 1]]]))[0]
    lags = ("y1[k-1]", "y2[k-1]", "u[k-1]")
    terms = [
        oa.Term(f"{name}{place}", lag, output=place)
        for place in ("y1", "y2")
        for name, lag in zip("abc", lags, strict=True)
    ]
    record = oa.Record.from_arrays(u, y, outputs=["y1", "y2"])
    found = oa.explain(oa.orthogonalize(record, oa.Baseline.from_terms(terms), plant))
    assert {(term.expression, term.added_to) for term in found.terms} == {
        ("y1[k-1]**3", "y1"),
        ("y1[k-1]**3", "y2"),
    }
    first, second = (f"y1[k-1]**3 in {term.added_to}" for term in found.terms)
    assert found.text.startswith(f"{first} and {second} explain 100 %")


def test_of_a_level_a_root_is_tried_and_no_friction_and_of_a_velocity_the_reverse():
    rng = np.random.default_rng(4)
    kinds = {}
    for low in (0.0, -1.0):
        u, y = rng.uniform(low, 1, ROWS), np.zeros(ROWS)
        for k in range(1, ROWS):
            y[k] = (
                0.8 * y[k - 1] + 0.5 * u[k - 1] - 0.1 * np.sign(y[k - 1]) * np.sqrt(abs(y[k - 1]))
            )
        baseline = oa.Baseline.from_terms([oa.Term("a", "y[k-1]"), oa.Term("g", "u[k-1]")])

        def plant(x):
            return (x @ [0.8, 0.5] - 0.1 * np.sign(x[:, 0]) * np.sqrt(np.abs(x[:, 0])))[:, None]

        fit = oa.orthogonalize(oa.Record.from_arrays(u, y), baseline, plant)
        tried = candidates_of(linearization_of(fit.model, fit.problem.record), 2, (), ())
        kinds[low] = {one.kind for one in tried if one.on == "y[k-1]"}
        if low == 0.0:
            (term,) = oa.explain(fit).terms
            assert (
                term.expression == "sign(y[k-1])*sqrt(abs(y[k-1]))"
                and term.coefficient == pytest.approx(-0.1)
            )
    friction = {"coulomb", "tanh", "atan", "stribeck", "stribeck_gauss"}
    assert kinds[0.0] ^ kinds[-1.0] == {"square_root", *friction}
    assert "square_root" in kinds[0.0] and "coulomb" in kinds[-1.0]


@pytest.mark.parametrize("bend", ["tanh", "arctan"])
def test_smooth_friction_is_named_with_its_width(bend):
    rng = np.random.default_rng(4)
    u, y = rng.normal(size=ROWS), np.zeros(ROWS)

    def plant(x):
        bent = getattr(np, bend)((x[:, 0] - x[:, 1]) / 0.3)
        return (x @ [1.5, -0.6, 0.5] - 0.2 * bent)[:, None]

    for k in range(2, ROWS):
        y[k] = plant(np.array([[y[k - 1], y[k - 2], u[k - 1]]]))[0, 0]
    terms = (("a", "y[k-1]"), ("b", "y[k-2]"), ("g", "u[k-1]"))
    baseline = oa.Baseline.from_terms([oa.Term(name, lag) for name, lag in terms])
    record = oa.Record.from_arrays(u, y, outputs=[oa.Channel("y", "rad")])
    fit = oa.orthogonalize(record, baseline, plant)
    (term,) = oa.explain(fit).terms
    name = bend.replace("arc", "a")
    assert (term.kind, term.parameter, term.unit) == (name, "friction", "rad")
    assert term.expression == f"{name}(((y[k-1] - y[k-2])/Ts)/{term.width})"
    assert term.width == pytest.approx(0.3, rel=1e-3)
    assert term.coefficient == pytest.approx(-0.2, rel=1e-3)


def friction(rows: int = 2000) -> oa.Record:
    """A mass of 1 kg on 2 N s/m and 100 N/m, with Coulomb friction of 0.8 N that starts at 1.6 N (backward Euler)."""
    step, rng = 0.01, np.random.default_rng(3)
    gain = step**2 / (1.0 + 2.0 * step + 100.0 * step**2)
    force, y, e = (
        np.repeat(rng.normal(0, 6.0, rows // 20), 20),
        np.zeros(rows),
        1e-5 * rng.normal(size=rows),
    )
    for k in range(2, rows):
        v = (y[k - 1] - y[k - 2]) / step
        held = (0.8 + 0.8 * np.exp(-((v / 0.1) ** 2))) * np.sign(v)
        free = (2.0 + 2.0 * step) / step**2 * y[k - 1] - y[k - 2] / step**2
        y[k] = gain * (free + force[k - 1] - held) + e[k]
    units = {"inputs": [oa.Channel("force", "N")], "outputs": [oa.Channel("position", "m")]}
    return oa.Record.from_arrays(force, y, **units, sampling_time=step)


def test_the_loop_ends_at_the_friction_law():
    """The learner sees all lags. Its jump is smooth; the terms are sign(v) and the Stribeck peak all the same."""
    record, gain = friction(), 1e-4 / 1.03
    terms = [
        oa.Term("a", "position[k-1]"),
        oa.Term("b", "position[k-2]"),
        oa.Term("g", "force[k-1]", unit="m/N"),
    ]
    speed = "(position[k-1] - position[k-2])/Ts"
    options = {"learner": oa.MLP(hidden=(8,)), "solver": oa.LevenbergMarquardt(iterations=1500)}
    first = oa.explain(oa.estimate(record, oa.Baseline.from_terms(terms), **options))
    assert [warning.code for warning in first.warnings] == ["conditional_on_selection"], (
        "training ended at a minimum"
    )
    coulomb, peak = first.terms
    assert coulomb.expression == f"sign({speed})" and coulomb.unit == "m"
    assert (
        peak.kind == "stribeck_gauss"
        and peak.on == speed
        and peak.width == pytest.approx(0.1, rel=0.05)
    )
    assert [coulomb.coefficient, peak.coefficient] == pytest.approx(
        [-0.8 * gain, -0.8 * gain], rel=0.05
    )
    assert first.share > 0.99 and coulomb.share + peak.share == pytest.approx(first.share)
    again = oa.estimate(record, first.physics, **options)
    then = dict(zip(again.problem.baseline.names, again.theta, strict=True))
    assert then["coulomb"] / then["g"] == pytest.approx(-0.8, rel=0.03), "in N"
    assert then["stribeck"] / then["g"] == pytest.approx(-0.8, rel=0.05)
    assert not oa.explain(again).found


def test_nothing_is_found_where_nothing_is_missing():
    result = oa.explain(fitted(0.0))
    assert not result.found and result.terms == () and "its own errors" in result.text
    assert all(moved.value == moved.value_with for moved in result.parameters)


def test_what_python_is_given(hardening):
    model, record = hardening.model, hardening.problem.record
    with pytest.raises(InputError, match="the model is physics alone: it has no learner"):
        oa.explain(fitted(-0.3, learner=None))
    with pytest.raises(
        InputError, match="`model` must be a model or what `estimate` returns; got 3"
    ):
        oa.explain(3, record)
    with pytest.raises(InputError, match="record"):
        oa.explain(model)
    with pytest.raises(InputError, match="`least` must be a share between 0 and 1; got 2"):
        oa.explain(model, record, least=2)
    with pytest.raises(InputError, match="`functions` must be a list of names"):
        oa.explain(model, record, functions="abs")
    with pytest.raises(
        InputError, match="a library has no terms of the function 'asb', did you mean 'abs'"
    ):
        oa.explain(model, record, functions=["asb"])
    with pytest.raises(InputError, match="candidate terms; at most 3000 are looked at"):
        oa.explain(model, record, degree=30)
    with pytest.MonkeyPatch.context() as patch:  # before the learner is evaluated
        patch.setattr("orthaug.selection.explanation.linearization_of", None)
        with pytest.raises(InputError, match="to the degree 100 make .* at most 3000"):
            oa.explain(model, record, degree=100)


@pytest.mark.parametrize("half", [0.0, 0.005])
def test_the_response_of_a_motion_has_its_transpose(half):
    rng = np.random.default_rng(1)
    begins = np.array([1, 0, 0, 1, 0, 0, 0])
    steps, outputs = rng.normal(size=(7, 2, 2)), rng.normal(size=(7, 1, 2))
    entries = rng.normal(size=(7, 2, 2))
    response = MotionResponse(steps, outputs, begins, np.array([[1.3]]), half, entries)
    terms, values = rng.normal(size=(7, 3, 2)), rng.normal(size=(7, 4))
    back = np.einsum("mnk,mnj->kj", response.adjoint(values), terms)
    assert back == pytest.approx(values.T @ response.forward(terms))


def test_a_step_of_parameters_ends_at_their_bounds_but_at_no_zero_that_is_divided_by():
    parameters = [
        oa.PhysicalParameter("c", 0.5, min=0),
        oa.PhysicalParameter("m", 2.0, min=0, max=3.0),
    ]
    motion = oa.Motion.from_equations(
        [State("v", "(u - c*v)/m")], [Output("y", "v")], parameters, ["u"]
    )
    x, u, q = np.ones((3, 1)), np.ones((3, 1)), motion.coordinates.of([0.5, 2.0])
    assert _move_parameters(motion, q, np.array([-0.4, 0.1]), x, u) == pytest.approx([0.3, 2.2])
    assert _move_parameters(motion, q, np.array([-1.1, 0.6]), x, u) == pytest.approx([0.0, 3.0])
    assert _move_parameters(motion, q, np.array([0.0, -1.1]), x, u) == pytest.approx(
        [0.5, 2.0 * np.exp(-1.1)]
    )


@pytest.fixture(scope="module")
def project(tmp_path_factory):
    folder = tmp_path_factory.mktemp("explained")
    write_csv(folder / "run.csv", **system(-0.3))
    (folder / "plant.toml").write_text(SPEC + LEARNER, encoding="utf-8")
    (folder / "alone.toml").write_text(SPEC + ALONE, encoding="utf-8")
    for name in ("plant", "alone"):
        assert run("fit", folder / f"{name}.toml", "--out", folder / name).code == 0
    return folder


@pytest.mark.usefixtures("without_figures")
def test_the_command_says_what_to_write_and_that_can_be_read(project):
    done = run("explain", project / "plant", project / "run.csv", "--json")
    result = json.loads(done.out)
    assert done.code == 0 and result["found"] and result["terms"][0]["expression"] == "y[k-1]**3"
    grown = project / "grown.toml"
    grown.write_text(SPEC + result["spec"] + "\n" + ALONE, encoding="utf-8")
    assert [term.parameter for term in oa.load_spec(grown).spec.baseline.terms] == [
        "a",
        "b",
        "g",
        "cubic",
    ]
    assert [bool(term.selected) for term in oa.load_spec(grown).spec.baseline.terms] == [
        False,
        False,
        False,
        True,
    ]
    page = run("explain", project / "plant", project / "run.csv").out
    assert (
        page.startswith("y[k-1]**3 explains 9")
        and "[[baseline.terms]]" in page
        and "1/m**2" in page
    )


@pytest.mark.usefixtures("without_figures")
def test_where_the_spec_has_a_map_to_physical_parameters_its_lines_are_given(project, tmp_path):
    names = ("a", "b", "g")
    own = "[physics.parameters]\n" + "".join(f"p{name} = {{ initial = 1.0 }}\n" for name in names)
    own += "cubic = { initial = -0.2 }\n[physics.theta]\n" + "".join(
        f'{name} = "p{name}"\n' for name in names
    )
    shutil.copytree(project / "plant", tmp_path / "plant")
    result = json.loads((project / "plant" / "result.json").read_text(encoding="utf-8"))
    result["spec"]["physics"] = {"theta": dict(zip(names, names, strict=True))}
    (tmp_path / "plant" / "result.json").write_text(json.dumps(result), encoding="utf-8")
    plain, mapped = (
        run("explain", model / "plant", project / "run.csv", "--json")
        for model in (project, tmp_path)
    )
    assert (
        plain.err == ""
        and mapped.err.startswith("note: the spec has [physics]")
        and '"drag"' in mapped.err
    )
    term = "".join(
        line
        for line in json.loads(mapped.out)["spec"].splitlines(True)
        if not line.startswith("initial")
    )
    (project / "mapped.toml").write_text(
        SPEC + term + "\n" + own + 'cubic = "cubic"\n' + ALONE, encoding="utf-8"
    )
    assert oa.load_spec(project / "mapped.toml").spec.baseline.terms[3].parameter == "cubic"


@pytest.mark.parametrize(
    ("text", "unit"), [("T**3", "W/degC**3"), ("sign(T)", "W"), ("T", "W/degC")]
)
def test_a_coefficient_within_an_equation_has_the_unit_of_the_sum_over_that_of_its_term(text, unit):
    parameters = [
        oa.PhysicalParameter("h", 0.5, "W/degC"),
        oa.PhysicalParameter("C", 400.0, "J/degC"),
    ]
    motion = oa.Motion.from_equations(
        states=[State("T", "(heat - h*T)/C", unit="degC")],
        outputs=[Output("y", "T")],
        parameters=parameters,
        inputs=["heat"],
    )
    units = {"heat": "W", "T": "degC", "h": "W/degC", "C": "J/degC"}
    term = NewTerm(
        "lost", text, "T", -1e-8, "degC/s", scale=parse_named(text, motion.known, "the term")
    )
    changed = added_to_motion(motion, np.array([0.5, 400.0]), [term], units)
    (lost,) = changed.parameters
    assert (lost.unit, lost.initial) == (unit, pytest.approx(4e-6))
    assert (
        changed.equations[0][2].endswith(f" - lost*{text})/C")
        and f'unit = "{unit}"' in changed.lines()
    )


@pytest.mark.usefixtures("without_figures")
def test_explain_takes_the_rows_of_training_and_several_files(project, tmp_path):
    one, other = (json.loads(run("explain", project / "plant", project / "run.csv", "--json", *more).out)
                  for more in ((), ("--rows", "0:300")))  # fmt: skip
    lost = len(system(-0.3)["y"]) - one["points"]
    assert other["points"] == 300 - lost < one["points"]
    assert run("explain", project / "plant", project / "run.csv", "--rows", "x").code == 2
    assert [warning["code"] for warning in one["warnings"]] == ["conditional_on_selection"]

    shutil.copytree(project / "plant", tmp_path / "part")
    result = json.loads((project / "plant" / "result.json").read_text(encoding="utf-8"))
    result["spec"]["data"]["train"]["rows"] = [[0, 150], [200, 350]]
    (tmp_path / "part" / "result.json").write_text(json.dumps(result), encoding="utf-8")
    whole = system(-0.3)
    write_csv(tmp_path / "more.csv", **{name: column[:200] for name, column in whole.items()})
    part = run("explain", tmp_path / "part", project / "run.csv", tmp_path / "more.csv", "--json")
    assert json.loads(part.out)["points"] == 150 + 150 + 200 - 3 * lost
    assert (
        part.err
        == "note: run.csv: rows 0:150 and 200:350, those of the training; --rows takes others.\n"
    )
    result["spec"]["data"]["train"]["rows"] = "abc"
    (tmp_path / "part" / "result.json").write_text(json.dumps(result), encoding="utf-8")
    assert run("explain", tmp_path / "part", project / "run.csv", "--json").err == ""


@pytest.mark.usefixtures("without_figures")
def test_explain_leaves_out_missing_cells_or_refuses_them(project, tmp_path):
    """Without --missing, gaps of other files are left out."""
    columns = {name: column[:200].copy() for name, column in system(-0.3).items()}
    columns["y"][[100, 199]] = np.nan
    write_csv(tmp_path / "gaps.csv", **columns)
    given = ("explain", project / "plant", tmp_path / "gaps.csv", "--json")
    plain, skipped = run(*given), run(*given, "--missing", "skip")
    assert plain.code == skipped.code == 0 and plain.out == skipped.out
    refused = run(*given, "--missing", "error")
    assert refused.code == 2
    assert one_line(refused.err, "column 'y'", "--missing skip leaves such rows out")
    assert one_line(run(*given, "--missing", "drop").err, "--missing", "'drop'")


@pytest.mark.usefixtures("without_figures")
def test_wrong_use_is_reported_in_a_line(project):
    refused = run("explain", project / "alone", project / "run.csv")
    assert refused.code == 2 and one_line(
        refused.err, f"{project / 'alone'}: the model is physics alone"
    )
    write_csv(project / "inputs.csv", u=np.zeros(50))
    assert one_line(
        run("explain", project / "plant", project / "inputs.csv").err, "the data have no y"
    )
    write_csv(project / "other.csv", w=np.zeros(50))
    assert one_line(run("explain", project / "plant", project / "other.csv").err, "u")
    write_csv(project / "short.csv", u=np.ones(9), y=np.ones(9))
    assert one_line(
        run("explain", project / "plant", project / "short.csv").err, "at least 20 are needed"
    )
    assert one_line(run("explain", project, project / "run.csv").err, "no saved model")
    for option in ("--terms", "--degree"):
        refused = run("explain", project / "plant", project / "run.csv", option, "0")
        assert refused.code == 2 and one_line(refused.err, f"`{option}` must be a whole number of")


@pytest.mark.parametrize(
    ("on", "expected"),
    [("v", "v**3"), ("y[k-2]", "y[k-2]**3"), ("(y[k-1] - y[k-2])/Ts", "((y[k-1] - y[k-2])/Ts)**3")],
)
def test_a_cube_of_what_is_no_name_has_brackets(on, expected):
    assert _expression_text("cubic", on) == expected


def test_no_difference_of_two_peaks_is_proposed():
    """They cancel: large coefficients of terms that explain nothing alone."""
    rng = np.random.default_rng(12)
    a, b, e = rng.uniform(-1, 2, 800), rng.normal(size=800), 0.05 * rng.normal(size=800)
    y = 2 + 3 * a - 1.5 * b + 0.8 * a * b + 0.5 * np.sin(3 * a) * b**2 + e
    record = oa.Record.from_arrays(np.column_stack([a, b])[:600], y[:600], inputs=["a", "b"])
    terms = [oa.Term(name, lag) for name, lag in (("ca", "a[k]"), ("cb", "b[k]"), ("c0", "1"))]
    fit = oa.estimate(
        record, oa.Baseline.from_terms(terms), learner=oa.MLP(hidden=(8,)), restarts=3
    )
    found = [term.expression for term in oa.explain(fit.model, record).terms]
    assert "a[k]*b[k]" in found and sum("exp(" in text for text in found) < 2


@pytest.mark.parametrize("slope", [10.0, 0.0])
def test_an_end_stop_or_a_limit_of_a_spring_leaves_it_its_stiffness(slope):
    """Both are the same force beside a spring; the one is named that leaves the spring its stiffness."""
    rng = np.random.default_rng(2)
    x = rng.normal(scale=0.7, size=800)
    beyond = x - np.clip(x, -1.0, 1.0)
    y = 2.0 * (x - beyond) + slope * beyond + 0.01 * rng.normal(size=800)
    record = oa.Record.from_arrays(x, y, inputs=["x"], outputs=["force"])
    spring = oa.Baseline.from_terms([oa.Term("k", "x[k]")])
    fit = oa.estimate(record, spring, learner=oa.MLP(hidden=(12,), inputs=("x[k]",)))
    found = oa.explain(fit, record)
    assert found.terms[0].kind == "dead_zone"
    assert found.parameters[0].value_with == pytest.approx(2.0, rel=0.05)


def test_a_narrow_table_keeps_a_share_with_its_term():
    long = "a friction-like hysteresis (LuGre) of position[k-1] and of angle, width 0.0056"
    wide = "position[k-1]*position[k-2] + position[k-1]*position[k-3] + angle"
    memory = MemoryResult(
        name=long, kind="lugre", on="x", scale=1.0, equation="position", share=0.574, p=0.0
    )
    single = SingleTerm("sum", wide, "position", 0.9)
    other = replace(single, added_to="angle")
    found = ExplainResult(
        found=False,
        share=0.0,
        noise=None,
        p=None,
        points=100,
        terms=[],
        singles=[single, other],
        parameters=[],
        spec=None,
        text="nothing.",
        memory=[memory],
        warnings=[],
    )
    with narrow_screen(80):
        lines = explain_text(found).splitlines()
    assert max(map(len, lines)) <= 80
    rows = [line for line in lines if line[:4] in ("57.4", "90 %")]
    begins = ("90 %   position  position[k-1]*", "90 %   angle     position[k-1]*")
    assert [any(row.startswith(begin) for row in rows) for begin in begins] == [True, True]
    assert (
        rows[-1].startswith("57.4 %  position  a friction-like hysteresis (LuGre)")
        and len(rows) == 3
    )


def test_a_jump_of_an_input_is_not_named_as_friction():
    jump = Candidate("coulomb", "valve", None, 0, "sign(valve)")
    assert _base_name(jump, ("valve",)) == "jump" and _base_name(jump, ()) == "coulomb"
    peak = Candidate("stribeck_gauss", "valve", 0.5, 0, "sign(valve)*exp(-(valve/0.5)**2)")
    assert _base_name(peak, ("valve",)) == "peak" and _base_name(peak, ("u",)) == "stribeck"
