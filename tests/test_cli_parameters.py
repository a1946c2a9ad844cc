"""Physical parameters, suspects, splits and designs through the commands: JSON, text, and one line for bad input."""

from __future__ import annotations

import io
import json
import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import scipy.stats
from test_cli import MLP, SPEC, finite_json, make_project, one_line, run, write_csv

from orthaug import load, load_spec, synthetic

TRUE = {"m": 1.0, "cd": 100.0, "ks": 1000.0}
SYSTEM = synthetic.MassSpringDamper()
GAMMA = "(m + cd*Ts + ks*Ts**2)"
TERMS = """
[data]
sampling_time = 0.01
inputs = ["force"]
outputs = ["position"]
train = { files = ["run.csv"] }
[[baseline.terms]]
parameter = "theta1"
regressor = "position[k-1]"
[[baseline.terms]]
parameter = "theta2"
regressor = "position[k-2]"
[[baseline.terms]]
parameter = "theta3"
regressor = "force[k-1]"
unit = "m/N"
[learner]
kind = "none"
[baseline.constants]
Ts = 0.01
"""
PHYSICS = f"""
[physics.parameters]
m = {{ initial = 1.1, unit = "kg", min = 0 }}
cd = {{ initial = 90, unit = "Ns/m" }}
ks = {{ initial = 1100, unit = "N/m" }}
[physics.theta]
theta1 = "(2*m + cd*Ts) / {GAMMA}"
theta2 = "-m / {GAMMA}"
theta3 = "Ts**2 / {GAMMA}"
"""
MACHINE = TERMS + PHYSICS
VELOCITY = "(position[k-1] - position[k-2])/Ts"


pytestmark = pytest.mark.usefixtures("without_figures", "without_trials")


def euler(m, cd, ks, sign=1, ts=0.01) -> np.ndarray:
    """Backward Euler; the paper prints it with sign −1."""
    return np.array([2 * m + sign * cd * ts, -m, ts**2]) / (m + cd * ts + ks * ts**2)


def machine(
    folder: Path, spec: str = MACHINE, sign: int = 1, friction: bool = False, noise: float = 2e-6
) -> Path:
    """A spec and its record of a mass, a spring and a damper; returns the spec's path."""
    rng = np.random.default_rng(4)
    force = rng.uniform(-100, 100, 1500)
    system = SYSTEM if friction else synthetic.MassSpringDamper(coulomb=0.0, static=0.0)
    position = system.simulate(force, euler(**TRUE, sign=sign), noise * rng.normal(size=1498))
    write_csv(folder / "run.csv", force=force, position=position)
    (folder / "machine.toml").write_text(spec)
    return folder / "machine.toml"


@pytest.fixture
def project(tmp_path, monkeypatch) -> Path:
    """The machine's spec in a folder of its own, which is the current one."""
    monkeypatch.chdir(tmp_path)
    return machine(tmp_path)


def result_of(spec: Path, text: str | None = None, command: str = "fit") -> dict:
    """The JSON that a command prints for a spec."""
    if text is not None:
        spec.write_text(text)
    done = run(
        command, spec, "--json", *(["--out", spec.parent / "out"] if command == "fit" else [])
    )
    assert (done.code, done.err) == (0, "")
    return finite_json(done.out)


@pytest.fixture(scope="module")
def plain(tmp_path_factory) -> tuple[Path, dict, str]:
    """The folder of the machine's fit in `out`, its result and what was printed; tests leave it as it is."""
    folder = tmp_path_factory.mktemp("plain")
    done = run("fit", machine(folder), "--out", folder / "out")
    assert (done.code, done.err) == (0, "")
    return (
        folder,
        finite_json((folder / "out" / "result.json").read_text(encoding="utf-8")),
        done.out,
    )


def values(rows: list[dict], key: str = "value") -> dict:
    return {row["name"]: row[key] for row in rows}


# --- physical parameters


def test_physical_parameters_with_intervals(plain):
    _, result, _ = plain
    rows = result["physical_parameters"]
    assert [(r["name"], r["unit"], r["initial"]) for r in rows] == [
        ("m", "kg", 1.1),
        ("cd", "Ns/m", 90.0),
        ("ks", "N/m", 1100.0),
    ]
    for row in rows:
        assert row["value"] == pytest.approx(TRUE[row["name"]], abs=4 * row["std"])
        assert 0 < row["std"] < 1e-2 * row["value"]
        expected = scipy.stats.t(1498 - 3, row["value"], row["std"]).interval(0.95)
        np.testing.assert_allclose(row["ci95"], expected, rtol=1e-9)
    assert result["physical_consistency"] is None and result["warnings"] == []


def test_the_initial_theta_is_what_the_map_gives(plain):
    rows = plain[1]["parameters"]
    np.testing.assert_allclose([row["initial"] for row in rows], euler(1.1, 90, 1100), rtol=1e-12)


def test_an_initial_that_agrees_with_the_map_may_stand(project):
    project.write_text(
        MACHINE.replace('"theta3"', f'"theta3"\ninitial = {euler(1.1, 90, 1100)[2]:.9g}')
    )
    assert run("check", project).code == 0


def test_the_papers_map_recovers_its_own_machine(tmp_path, monkeypatch):
    """It has 2m − c Ts in θ₁, a slip; on data of that recursion its map is right and the correct one is not."""
    monkeypatch.chdir(tmp_path)
    spec = machine(tmp_path, MACHINE.replace("2*m + cd*Ts", "2*m - cd*Ts"), sign=-1)
    for row in result_of(spec)["physical_parameters"]:
        assert row["value"] == pytest.approx(TRUE[row["name"]], rel=5e-3)
    other = values(result_of(spec, MACHINE)["physical_parameters"])
    assert abs(other["cd"] / 100 - 1) > 0.5


def test_profile_intervals(project):
    result = result_of(
        project,
        MACHINE.replace("[physics.parameters]", "[physics]\nprofile = true\n[physics.parameters]"),
    )
    for row in result["physical_parameters"]:
        np.testing.assert_allclose(row["profile95"], row["ci95"], rtol=1e-4)


FEWER = PHYSICS.replace('cd = { initial = 90, unit = "Ns/m" }\n', "")
SURE = {"agree": (100.0, "agree with"), "contradict": (130.0, "contradict")}


@pytest.mark.parametrize("case", SURE)
def test_more_theta_than_parameters_test_the_physics(project, case):
    cd, verb = SURE[case]
    text = TERMS.replace("Ts = 0.01\n", f"Ts = 0.01\ncd = {cd}\n") + FEWER
    result = result_of(project, text)
    found = result["physical_consistency"]
    assert found["df"] == 1 and f"The data {verb} the physics' own constraint" in found["text"]
    assert (
        (found["p"] < 0.05)
        == (case == "contradict")
        == any("contradict" in w["text"] for w in result["warnings"])
    )
    if case == "agree":
        assert values(result["physical_parameters"])["m"] == pytest.approx(1, rel=1e-3)


def test_the_summary_shows_physical_parameters(plain):
    out = plain[2]
    (line,) = [line for line in out.splitlines() if line.startswith("ks ")]
    assert "N/m" in line and "1100" in line
    assert "physical " in out and "initial  unit" in out


PHYSICS_ERRORS = [
    (
        '"theta1"',
        '"theta1"\ninitial = 0.5',
        "theta1: initial 0.5 but the physics gives 1.469194; leave one out",
    ),
    (
        f"-m / {GAMMA}",
        f"-mm / {GAMMA}",
        "physics.theta 'theta2' = ",
        "unknown name 'mm', did you mean 'm'",
    ),
    ('theta2 = "-m', 'theta9 = "-m', "physics.theta 'theta9' is no parameter of the baseline"),
    (
        f"-m / {GAMMA}",
        "-0.5*Ts",
        "'theta2' = -0.5*Ts depends on no physical parameter; use one of m, cd, ks",
    ),
    (
        "ks = {",
        "extra = { initial = 1 }\nks = {",
        "the physical parameter 'extra' is in no expression of theta",
    ),
    (
        f"(2*m + cd*Ts) / {GAMMA}",
        f"2*(m + cd*Ts + ks*Ts**2)/{GAMMA} - m/{GAMMA}",
        "cannot be distinguished",
        "rank 2 of 3",
    ),
    ("min = 0", "min = 2", "the initial value of 'm' is 1.1; its bounds are 2 and inf"),
    ("min = 0", "least = 0", "unknown key 'physics.parameters.m.least'"),
    ("Ts = 0.01", "Ts = 0.01\nm = 1.0", "'m' is a physical parameter and a constant"),
    (
        f"-m / {GAMMA}",
        "-m / (m - 1.1)",
        "is -inf at the initial values of m, cd, ks; expected a finite value",
    ),
    (f"-m / {GAMMA}", "-m*position[k-1]", "a signal such as y[k-1] is not allowed here"),
    (
        '"theta1"',
        '"theta1"\nfixed = true\ninitial = 1',
        "physics.theta 'theta1' is a fixed term of the baseline",
    ),
    (
        "[physics.parameters]",
        "[physics]\nprofile = 1\n[physics.parameters]",
        "'physics.profile': found 1",
        "boolean",
    ),
]


@pytest.mark.parametrize(
    ("old", "new", "words"), [(old, new, words) for old, new, *words in PHYSICS_ERRORS]
)
def test_bad_physics(project, old, new, words):
    assert old in MACHINE
    project.write_text(MACHINE.replace(old, new, 1))
    done = run("fit", project)
    assert done.code == 2 and one_line(done.err, "machine.toml", *words)


def test_a_theta_without_expression_is_named(project):
    project.write_text(
        TERMS + FEWER.replace(f'theta1 = "(2*m + cd*Ts) / {GAMMA}"\n', "").replace("cd*Ts", "1")
    )
    assert one_line(run("check", project).err, "machine.toml", "the physics gives no 'theta1'")


# --- suspects

KINDS = {
    "coulomb": f'on = "{VELOCITY}"',
    "stribeck": f'on = "{VELOCITY}"\nwidth = 0.02',
    "stribeck_gauss": f'on = "{VELOCITY}"\nwidth = 0.02',
    "quadratic_drag": f'on = "{VELOCITY}"',
    "cubic": 'on = "position[k-1]"',
    "square_root": 'on = "position[k-1]"',
    "dead_zone": 'on = "force[k-1]"\nwidth = 5.0',
    "saturation": 'on = "force[k-1]"',
    "offset": "",
    "expression": 'on = "abs(force[k-1])"',
}


def suspects(*bodies: str) -> str:
    return "".join(f"[[suspects]]\n{body}\n" for body in bodies)


def test_check_of_suspects_of_every_kind(project):
    project.write_text(
        MACHINE
        + suspects(
            *(f'kind = "{kind}"\n{body}\nname = "the {kind}"' for kind, body in KINDS.items())
        )
    )
    report = finite_json(run("check", project, "--json").out)
    assert [entry["name"] for entry in report["bias"]] == [f"the {kind}" for kind in KINDS]
    for entry in report["bias"]:
        assert set(entry["bias"]) == {"theta1", "theta2", "theta3"} and set(
            entry["physical_bias"]
        ) == set(TRUE)
        assert 0 <= entry["cosine"] <= 1
        assert entry["certificate"]["verdict"] in ("unremovable", "removable", "orthogonal")
    verdict = {entry["name"]: entry["certificate"]["verdict"] for entry in report["bias"]}
    assert (verdict["the coulomb"], verdict["the saturation"], verdict["the offset"]) == (
        "unremovable",
        "unremovable",
        "removable",
    )
    out = run("check", project).out
    for kind in KINDS:
        assert f"the {kind}" in out


def test_without_suspects_the_usual_ones_are_shown(project):
    done = run("check", project)
    assert (done.code, done.err) == (0, "")
    for name in ("coulomb of position[k-1] - position[k-2]", "saturation of force[k-1]", "offset"):
        assert name in done.out


def test_bias_is_a_regression_on_the_suspect(project):
    report = result_of(project, MACHINE + suspects('kind = "coulomb"\non = "force[k-1]"'), "check")
    table = pd.read_csv("run.csv")
    y, u = table["position"].to_numpy(), table["force"].to_numpy()
    phi = np.stack([y[1:-1], y[:-2], u[1:-1]], axis=1)
    size = np.linalg.norm(phi, axis=0)
    expected = np.linalg.lstsq(phi / size, np.sign(u[1:-1]), rcond=None)[0] / size
    np.testing.assert_allclose(list(report["bias"][0]["bias"].values()), expected, rtol=1e-9)


def test_after_a_fit_the_bias_is_in_the_result(project):
    result = result_of(
        project, MACHINE + suspects('kind = "cubic"\non = "force[k-1]"\ncoefficient = 1e-12')
    )
    (entry,) = result["bias"]
    theta = values(result["parameters"])
    assert entry["expected_bias"]["theta3"] == pytest.approx(1e-12 * entry["bias"]["theta3"])
    assert entry["relative_bias"]["theta3"] == pytest.approx(
        entry["bias"]["theta3"] / theta["theta3"]
    )


BAD_SUSPECTS = [
    (
        'kind = "columb"\non = "force[k-1]"',
        "unknown kind of suspect 'columb', did you mean 'coulomb'",
    ),
    ('kind = "cubic"', "a suspect of kind cubic needs `on`"),
    ("", "needs `on`"),
    ('kind = "offset"\non = "force[k-1]"', "takes no `on`"),
    (
        'kind = "dead_zone"\non = "force[k-1]"\nwidth = -1.0',
        "'suspects[0].width'",
        "greater than 0",
    ),
    ('kind = "cubic"\non = "force[k-1]"\nwidth = 1.0', "a suspect of kind cubic takes no `width`"),
    ('kind = "cubic"\non = "torque[k-1]"', "torque[k-1]", "it holds position[k-1]"),
    ('kind = "cubic"\non = "position[k-7]"', "position[k-7]", "which the regressor does not hold"),
    ('kind = "cubic"\non = "force[k-1]*q"', "unknown constant 'q'"),
    ('kind = "offset"\noutput = "speed"', "unknown output 'speed'", "known are position"),
    ('kind = "offset"\ncoefficient = "big"', "'suspects[0].coefficient'", "expected a number"),
    ('kind = "offset"\ncoefficient = nan', "'suspects[0].coefficient'", "finite"),
    ('kind = "offset"\ncoeff = 1.0', "unknown key 'suspects[0].coeff', did you mean 'coefficient'"),
    ('kind = "saturation"\non = "0*force[k-1]"', "is zero on all rows; the data give no width"),
    ('on = "log(position[k-1])"', "is not finite"),
    ('on = "sqrt(force[k-1] + 99)"', "is not finite"),
    ('kind = "offset"\n[[suspects]]\nkind = "offset"', "suspect 'offset' is given twice"),
]


@pytest.mark.parametrize(("body", "words"), [(body, words) for body, *words in BAD_SUSPECTS])
@pytest.mark.parametrize("command", ["check", "fit"])
def test_bad_suspects(project, body, words, command):
    project.write_text(MACHINE + suspects(body))
    done = run(command, project)
    assert done.code == 2 and done.out == "" and one_line(done.err, "machine.toml", *words)


def test_a_suspect_is_named_once_in_its_error(project):
    project.write_text(MACHINE + suspects('kind = "cubic"\non = "position[k-7]"'))
    assert run("check", project).err.count("suspect 'cubic(position[k-7])'") == 1


def test_a_suspect_without_effect_is_reported(project):
    """Zero on all rows: it biases nothing here, but it must not vanish from the answer."""
    report = result_of(
        project, MACHINE + suspects('on = "0*force[k-1]"', 'kind = "offset"'), "check"
    )
    found = [entry["name"] for entry in report["bias"]] + [
        warning["text"] for warning in report["warnings"]
    ]
    assert any("0*force[k-1]" in text for text in found)


def test_physics_without_parameters_has_no_bias_table(project):
    """All terms fixed: nothing is estimated, and nothing is in the way of a check or a fit."""
    fixed = TERMS
    for i, value in enumerate(euler(**TRUE)):
        fixed = fixed.replace(
            f'"theta{i + 1}"', f'"theta{i + 1}"\nfixed = true\ninitial = {float(value)!r}'
        )
    project.write_text(fixed)
    for command in ("check", "fit"):
        done = run(command, project, "--json")
        assert (done.code, done.err) == (0, "")
        assert not finite_json(done.out)["bias"]


def test_rank_deficient_physics_has_its_report_and_no_bias(project):
    project.write_text(TERMS.replace('"force[k-1]"', '"2*position[k-1] - position[k-2]"'))
    done = run("check", project, "--json")
    assert done.code == 2 and one_line(done.err, "machine.toml", "rank-deficient")
    assert finite_json(done.out)["bias"] is None
    assert "rank 2 of 3 on the data" in run("check", project).out


NARROW = 'kind = "uniform"\nbox = { "position[k-1]" = [0.001, 0.002] }'


@pytest.mark.parametrize("command", ["check", "fit"])
def test_a_measure_under_which_the_physics_is_rank_deficient_is_bad_input_of_the_spec(
    project, command
):
    """On one side of zero the sign is an offset; it is said before training."""
    text = TERMS.replace('"position[k-2]"', '"sign(position[k-1])"').replace('"force[k-1]"', '"1"')
    project.write_text(
        text.replace('kind = "none"', "hidden = [2]\n[structure.measure]\n" + NARROW)
    )
    done = run(command, project)
    assert done.code == 2 and one_line(
        done.err, "machine.toml", "uniform measure", "theta2, theta3"
    )
    assert "on the data" not in done.err


def friction_suspects() -> str:
    """The paper's Stribeck friction as two suspects: its force times θ₃, against the motion."""
    theta3 = float(SYSTEM.paper_theta()[2])
    coulomb, rest = -SYSTEM.coulomb * theta3, -(SYSTEM.static - SYSTEM.coulomb) * theta3
    return suspects(
        f'kind = "coulomb"\non = "{VELOCITY}"\ncoefficient = {coulomb!r}',
        f'kind = "stribeck"\non = "{VELOCITY}"\nwidth = {SYSTEM.stribeck!r}\ncoefficient = {rest!r}',
    )


def test_friction_of_the_papers_machine_is_predicted(tmp_path, monkeypatch):
    """The table foretells the shift of θ within 1 %, a stiffness 19 % off, and that no measure removes it."""
    monkeypatch.chdir(tmp_path)
    truth = (
        MACHINE.replace("2*m + cd*Ts", "2*m - cd*Ts")
        .replace("1.1", "1.0")
        .replace("90", "100")
        .replace("1100", "1000")
    )
    spec = machine(tmp_path, truth + friction_suspects(), sign=-1, noise=0.0)
    rng = np.random.RandomState(12345)  # the paper's force
    half = rng.normal(0.0, 100.0, 5000)
    force = np.concatenate([half, -half])
    write_csv(
        tmp_path / "run.csv", force=force, position=SYSTEM.simulate(force, SYSTEM.paper_theta())
    )
    report = result_of(spec, command="check")
    result = result_of(spec)
    theta = np.array([row["value"] for row in result["parameters"]])
    shift = np.sum([list(entry["expected_bias"].values()) for entry in report["bias"]], axis=0)
    np.testing.assert_allclose(shift, theta - SYSTEM.paper_theta(), rtol=0.01)
    ks = sum(entry["expected_physical_bias"]["ks"]["relative"] for entry in report["bias"])
    found = values(result["physical_parameters"])["ks"] / 1000 - 1
    assert ks == pytest.approx(found, rel=0.02) and found == pytest.approx(0.19, abs=0.005)
    assert [entry["certificate"]["verdict"] for entry in report["bias"]] == ["unremovable"] * 2
    assert (
        "A measure can then only make the bias small"
        in report["bias"][0]["certificate"]["sentence"]
    )


# --- split


@pytest.fixture(scope="module")
def fitted(tmp_path_factory) -> Path:
    """A project with its fit of a network in `out`, and a file of samples; tests leave it as it is."""
    folder = tmp_path_factory.mktemp("fitted")
    spec = make_project(folder, SPEC.replace('kind = "none"\n', MLP))
    assert run("fit", spec, "--out", folder / "out").code == 0
    rng = np.random.default_rng(4)
    columns = {name: rng.uniform(-1, 1, 60) for name in ("y[k-1]", "u[k-1]", "y[k-2]")}
    write_csv(folder / "points.csv", **columns, unused=np.full(60, np.nan))
    write_csv(folder / "weighted.csv", **columns, weight=rng.uniform(size=60))
    write_csv(folder / "weights.csv", weight=rng.uniform(size=120))
    write_csv(folder / "few.csv", weight=np.ones(60))
    write_csv(folder / "negative.csv", **columns, weight=-np.ones(60))
    write_csv(folder / "lacking.csv", **{name: columns[name] for name in ("y[k-1]", "u[k-1]")})
    return folder


@pytest.fixture
def inside(fitted, monkeypatch) -> Path:
    monkeypatch.chdir(fitted)
    return fitted


SPLITS = {
    "training": [],
    "symmetrized": ["--measure", "symmetrized"],
    "uniform": ["--measure", "uniform", "--box", "u[k-1]=-0.6:0.6", "--box", " y[k-2] = -1:1"],
    "samples": ["--measure", "samples", "--samples", "weighted.csv"],
    "weighted": ["--measure", "weighted", "--weights", "weights.csv"],
}


@pytest.mark.parametrize("kind", SPLITS)
def test_split_under_every_measure(inside, kind):
    done = run("split", "out", "run.csv", *SPLITS[kind], "--json")
    assert (done.code, done.err) == (0, "")
    found = finite_json(done.out)
    assert found["measure"] == found["measure_detail"]["kind"] == kind
    assert found["orthogonality_defect"] <= 1e-12
    assert [row["name"] for row in found["parameters"]] == ["a", "b", "c"]
    for row in found["parameters"]:
        assert row["std"] > 0 and row["ci95"][0] < row["value"] < row["ci95"][1]
    text = run("split", "out/model", "run.csv", *SPLITS[kind]).out
    assert text.startswith(f"measure     {kind}, {found['measure_detail']['points']} points")
    printed = re.search(r"^c +(\S+)", text, re.M)
    assert printed is not None
    third = found["parameters"][2]
    assert abs(float(printed[1]) - third["value"]) <= third["std"] / 20


def test_split_under_the_training_measure_is_the_fit(inside):
    fit = json.loads(Path("out/result.json").read_text())["parameters"]
    found = finite_json(run("split", "out", "run.csv", "--json").out)["parameters"]
    for key, tolerance in (("value", 1e-10), ("std", 1e-2), ("ci95", 1e-2)):
        np.testing.assert_allclose([r[key] for r in found], [r[key] for r in fit], rtol=tolerance)


def test_samples_with_weights_and_without(inside):
    plain, weighted = (
        finite_json(
            run("split", "out", "run.csv", "--measure", "samples", "--samples", name, "--json").out
        )
        for name in ("points.csv", "weighted.csv")
    )
    assert plain["measure_detail"]["points"] == weighted["measure_detail"]["points"] == 60
    assert values(plain["parameters"]) != values(weighted["parameters"])


def test_rows_of_the_data(inside):
    found = finite_json(run("split", "out", "run.csv", "--rows", "10:60", "--json").out)
    assert found["measure_detail"]["points"] == 48


def test_several_files_are_one_measure(inside):
    found = finite_json(run("split", "out", "run.csv", "steps.csv", "--json").out)
    assert found["measure_detail"]["points"] == 118 + 58


def of_other_data(out: str) -> list[str]:
    """Return the warnings of a split that its data are not those of the training."""
    warnings = finite_json(out)["warnings"]
    return [one["text"] for one in warnings if one["code"] == "other_training_data"]


@pytest.mark.parametrize("files", [["steps.csv"], ["run.csv", "steps.csv"]])
def test_a_split_of_other_files_is_warned_of(inside, files):
    """By their checksums, whatever the name: a copy of the training file is it."""
    (text,) = of_other_data(run("split", "out/model", *files, "--json").out)
    assert "trained on run.csv; the checksums" in text
    assert f"differ from those of {', '.join(files)}" in text
    Path("copy.csv").write_bytes(Path("run.csv").read_bytes())
    assert of_other_data(run("split", "out", "copy.csv", "--json").out) == []


def test_a_split_takes_the_rows_of_the_training(inside, tmp_path):
    part = 'train = { files = ["run.csv"], rows = [0, 80] }'
    Path("part.toml").write_text(SPEC.replace('train = { files = ["run.csv"] }', part))
    fit = finite_json(run("fit", "part.toml", "--json", "--out", tmp_path / "part").out)
    split = run("split", tmp_path / "part", "run.csv", "--json")
    assert (
        "note: run.csv: rows 0:80, those of the training." in split.err
        and of_other_data(split.out) == []
    )
    assert values(finite_json(split.out)["parameters"]) == pytest.approx(
        values(fit["parameters"]), rel=1e-9
    )
    other = run("split", tmp_path / "part", "run.csv", "--rows", "0:90", "--json").out
    assert len(of_other_data(other)) == 1


@pytest.mark.proof
def test_the_measure_of_the_spec_is_that_of_split(tmp_path, monkeypatch):
    """Under noise of the equation: where errors are coloured, only the intervals of the fit are robust."""
    make_project(tmp_path)
    rng = np.random.default_rng(4)
    u, y = rng.uniform(-1, 1, 120), np.zeros(120)
    for k in range(2, 120):
        y[k] = (
            0.6 * y[k - 1]
            - 0.2 * y[k - 2]
            + 0.5 * u[k - 1]
            + 0.2 * u[k - 1] ** 2
            + 0.02 * rng.normal()
        )
    write_csv(tmp_path / "run.csv", u=u, y=y)
    monkeypatch.chdir(tmp_path)
    text = (
        SPEC.replace('kind = "none"\n', MLP.replace("iterations = 5", 'focus = "prediction"'))
        + '[structure.measure]\nkind = "uniform"\nbox = { "u[k-1]" = [-0.6, 0.6] }\n'
    )
    Path("uniform.toml").write_text(text)
    done = run("fit", "uniform.toml", "--json", "--out", "out")
    result = finite_json(done.out)
    split = finite_json(
        run(
            "split", "out", "run.csv", "--measure", "uniform", "--box", "u[k-1]=-0.6:0.6", "--json"
        ).out
    )
    assert result["measure"] == "uniform" and load(tmp_path / "out").measure == "uniform"
    for key in ("value", "std"):
        np.testing.assert_allclose(
            *[list(values(r["parameters"], key).values()) for r in (result, split)], rtol=1e-6
        )
    assert min(result["measure_detail"]["std_over_training"]) > 0.99


def test_samples_of_the_spec(inside, tmp_path):
    text = SPEC.replace('kind = "none"\n', MLP)
    Path("samples.toml").write_text(
        text + '[structure.measure]\nkind = "samples"\nfiles = ["points.csv"]\nrows = [0, 50]\n'
    )
    result = finite_json(run("fit", "samples.toml", "--json", "--out", tmp_path / "out").out)
    assert (result["measure"], result["measure_detail"]["points"]) == ("samples", 50)


def test_weights_of_the_spec_are_those_of_split(inside, tmp_path):
    """One experiment after another, each with weights for the lags at its start, which count for nothing."""
    rng = np.random.default_rng(5)
    write_csv(inside / "some.csv", weight=rng.uniform(0.1, 1, size=90))
    text = SPEC.replace('kind = "none"\n', MLP).replace(
        'train = { files = ["run.csv"]',
        'train = { rows = [[0, 50], [60, 100]], files = ["run.csv"]',
    )
    Path("weights.toml").write_text(
        text + '[structure.measure]\nkind = "weighted"\nfiles = ["some.csv"]\n'
    )
    result = finite_json(run("fit", "weights.toml", "--json", "--out", tmp_path / "out").out)
    assert (result["measure"], result["measure_detail"]["points"]) == ("weighted", 86)
    changed = np.genfromtxt("some.csv", skip_header=1)
    changed[[0, 1, 50, 51]] = 7.0
    write_csv(inside / "some.csv", weight=changed)
    again = finite_json(run("fit", "weights.toml", "--json", "--out", tmp_path / "out").out)
    assert values(again["parameters"]) == values(result["parameters"])
    write_csv(inside / "some.csv", weight=changed[:-1])
    done = run("fit", "weights.toml", "--out", tmp_path / "out")
    assert done.code == 2 and one_line(
        done.err, "weights.toml", "some.csv: 89 weights for 90 rows of training data"
    )


BAD_SPLITS = [
    (
        ["out", "run.csv", "--measure", "gauss"],
        "--measure must be one of training, symmetrized, uniform, samples, weighted; got",
    ),
    (["out", "run.csv", "--measure", "samples"], "--samples is missing"),
    (
        ["out", "run.csv", "--measure", "samples", "--samples", "absent.csv"],
        "absent.csv: no such file",
    ),
    (
        ["out", "run.csv", "--measure", "samples", "--samples", "lacking.csv"],
        "lacking.csv: no column 'y[k-2]'",
    ),
    (
        ["out", "run.csv", "--measure", "samples", "--samples", "negative.csv"],
        "weight 0 of the samples",
    ),
    (
        ["out", "run.csv", "--measure", "weighted"],
        "--weights is missing; expected the files that hold the weights",
    ),
    (
        ["out", "run.csv", "--measure", "weighted", "--weights", "few.csv"],
        "few.csv: 60 weights for 120 rows",
    ),
    (
        ["out", "run.csv", "--measure", "weighted", "--weights", "points.csv"],
        "points.csv: no column 'weight'",
    ),
    (
        ["out", "run.csv", "--measure", "weighted", "--weights", "absent.csv"],
        "absent.csv: no such file",
    ),
    (
        ["out", "run.csv", "--weights", "weights.csv"],
        "--weights: belongs to --measure weighted; found --measure train",
    ),
    (
        ["out", "run.csv", "--measure", "weighted", "--samples", "points.csv"],
        "--samples: belongs to --measure samples; found --measure weighted",
    ),
    (
        ["out", "run.csv", "--measure", "uniform", "--box", "u[k-1]"],
        "--box: found 'u[k-1]'; expected a raw lag and",
    ),
    (
        ["out", "run.csv", "--measure", "uniform", "--box", "u[k-1]=a:b"],
        "--box: found 'u[k-1]=a:b'",
    ),
    (
        ["out", "run.csv", "--measure", "uniform", "--box", "u[k-1]=1:2:3"],
        "--box: found 'u[k-1]=1:2:3'",
    ),
    (
        ["out", "run.csv", "--measure", "uniform", "--box", "u[k-1]=1:0"],
        "box of u[k-1] is empty or reversed: 1 to 0",
    ),
    (["out", "run.csv", "--measure", "uniform", "--box", "u[k-1]=nan:0"], "the box of u[k-1]"),
    (
        ["out", "run.csv", "--measure", "uniform", "--box", "v[k-1]=0:1"],
        "'v[k-1]' is no raw lag that this model reads",
    ),
    (["out", "run.csv", "--box", "u[k-1]=0:1"], "--box", "uniform"),
    (["out", "run.csv", "--samples", "points.csv"], "--samples", "measure"),
    (
        ["out", "run.csv", "--measure", "uniform", "--box", "u[k-1]=0:1", "--box", "u[k-1]=0:2"],
        "--box",
        "twice",
    ),
    (
        ["out", "run.csv", "--rows", "5"],
        "--rows: found '5'; expected a half-open range of rows such as 0:1000",
    ),
    (["out", "run.csv", "--rows", "-3:5"], "--rows: found '-3:5'"),
    (["out", "run.csv", "--rows", "²:³"], "--rows: found '²:³'"),
    (["out", "run.csv", "--rows", "9:5"], "rows [9, 5] is not a half-open range"),
    (["out", "run.csv", "--rows", "0:999"], "reaches past the end; the file has 120 data rows"),
    (["out", "run.csv", "--rows", "0:4"], "2 usable rows for 3 parameters"),
    (["absent", "run.csv"], "absent: no saved model there"),
    (["out", "absent.csv"], "absent.csv: no such file"),
    (["out", "points.csv"], "points.csv: no column 'u'"),
    (["out"], "Missing argument 'DATA"),
]


@pytest.mark.parametrize(
    ("arguments", "words"), [(arguments, words) for arguments, *words in BAD_SPLITS]
)
def test_bad_splits(inside, arguments, words):
    done = run("split", *arguments)
    assert (done.code, done.out) == (2, "") and one_line(done.err, *words)


def test_a_measure_beyond_the_data_is_warned_of(inside):
    done = run(
        "split",
        "out",
        "run.csv",
        "--measure",
        "uniform",
        "--box",
        "u[k-1]=-5:5",
        "--box",
        "y[k-1]=-5:5",
    )
    assert (
        done.code == 0
        and "% of the uniform measure lies within reach of the training data" in done.out
    )


def test_physics_alone_does_not_speak_of_a_learner(plain):
    folder = plain[0]
    box = ["--measure", "uniform", "--box", "force[k-1]=-900:900"]
    assert "learner" not in run("split", folder / "out", folder / "run.csv", *box).out


def test_a_parameter_at_its_bound_is_not_split_off(inside, tmp_path):
    """As `fit.split` refuses it."""
    Path("bounded.toml").write_text(
        SPEC.replace('kind = "none"\n', MLP).replace("initial = 0.5", "initial = 0.3\nmax = 0.3")
    )
    assert run("fit", "bounded.toml", "--out", tmp_path / "out").code == 0
    done = run("split", tmp_path / "out", "run.csv", "--measure", "symmetrized")
    assert done.code == 2 and one_line(done.err, "a", "bound")


# --- design

DESIGN = "[design]\nsamples = 400\namplitude = 50\nnoise = 2e-6\n"
COULOMB = suspects(f'kind = "coulomb"\non = "{VELOCITY}"\ncoefficient = -3.8e-5')


def test_the_sampling_time_need_not_be_declared(project):
    """It is that of the data, from the spec or a time column, with `every` rows kept."""
    declared = load_spec(project)
    text = MACHINE.replace("[baseline.constants]\nTs = 0.01\n", "")
    project.write_text(text + COULOMB)
    np.testing.assert_array_equal(
        load_spec(project).problem.baseline.initial, declared.problem.baseline.initial
    )
    table = pd.read_csv("run.csv")
    table.insert(0, "t", 5 + 0.01 * np.arange(len(table)))
    table.to_csv("run.csv", index=False)
    project.write_text(text.replace("sampling_time = 0.01", 'time = "t"'))
    timed = load_spec(project).problem.baseline
    np.testing.assert_allclose(timed.initial, declared.problem.baseline.initial, rtol=1e-9)
    thinned = text.replace('["run.csv"]', '["run.csv"], every = 2')
    project.write_text(thinned)
    assert load_spec(project).physics.map.constants == (("Ts", 0.02),)
    project.write_text(thinned + "[baseline.constants]\nTs = 0.01\n")
    done = run("check", project)
    assert done.code == 2 and one_line(
        done.err, "machine.toml: the constant 'Ts' is 0.01", "sampled every 0.02 s"
    )


def test_a_design_of_one_input_has_the_others_as_recorded(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    rng, y = np.random.default_rng(0), np.zeros(200)
    force, slope = rng.normal(size=200), 0.1 * np.sin(np.arange(200) / 20)
    for k in range(1, 200):
        y[k] = 0.9 * y[k - 1] + 0.2 * force[k - 1] - 0.5 * slope[k - 1] + 0.01 * rng.normal()
    write_csv(tmp_path / "run.csv", force=force, slope=slope, y=y)
    terms = "".join(
        f'[[baseline.terms]]\nparameter = "{name}"\nregressor = "{lag}[k-1]"\n'
        for name, lag in (("a", "y"), ("b", "force"), ("g", "slope"))
    )
    head = '[data]\nsampling_time = 1\ninputs = ["force", "slope"]\noutputs = ["y"]\ntrain = { files = ["run.csv"] }\n'
    both = f'{head}{terms}[learner]\nkind = "none"\n[design]\nsamples = 300\namplitude = 1\n'
    Path("both.toml").write_text(both)
    assert one_line(
        run("design", "both.toml", "--out", "u.csv").err,
        "`input` is missing: the one to design, of force,",
    )
    Path("both.toml").write_text(f'{both}input = "force"\n')
    done = run("design", "both.toml", "--out", "u.csv")
    note = "note: slope: as recorded in the training data.\n"
    assert (done.code, done.err) == (0, note)
    # With a learner what physics alone leaves is not all noise
    learner = f'{both}input = "force"\n'.replace('kind = "none"', "hidden = [2]")
    Path("learner.toml").write_text(learner)
    done = run("design", "learner.toml", "--out", "u.csv", "--force")
    assert "What the learner takes up of that is no noise" in " ".join(done.err.split())
    Path("learner.toml").write_text(learner + "noise = 0.01\n")
    done = run("design", "learner.toml", "--out", "u.csv", "--force")
    assert (done.code, done.err) == (0, note)
    table = pd.read_csv("u.csv")
    np.testing.assert_allclose(table["slope"], np.resize(slope, 300))
    assert list(table.columns) == ["time", "force", "slope"] and table["force"].abs().max() <= 1


def test_design_writes_an_input_within_its_limits(project):
    project.write_text(MACHINE + DESIGN + "rate = 1000\n" + COULOMB)
    done = run("design", project, "--out", "u.csv")
    assert (done.code, done.err) == (0, "")
    table = pd.read_csv("u.csv")
    assert list(table.columns) == ["time", "force"] and len(table) == 400
    np.testing.assert_allclose(np.diff(table["time"]), 0.01)
    force = table["force"].to_numpy()
    assert 25 < np.abs(force).max() <= 50 and np.abs(np.diff(force, prepend=0)).max() <= 10 + 1e-9
    for words in (
        "predicted   relative error of θ",
        "theta3",
        "what was tried",
        "written to u.csv",
    ):
        assert words in done.out


def test_design_as_json(project):
    project.write_text(
        MACHINE + DESIGN.replace("amplitude = 50", "minimum = 0\nmaximum = 50") + COULOMB
    )
    found = finite_json(run("design", project, "--out", "u.csv", "--json").out)
    assert found["samples"] == 400 and set(found["bias"]) == set(found["std"]) == {
        "theta1",
        "theta2",
        "theta3",
    }
    costs = [row["cost"] for row in found["candidates"]]
    assert (
        costs[0] == min(cost for cost in costs if cost is not None) == pytest.approx(found["cost"])
    )
    force = pd.read_csv("u.csv")["force"]
    assert 0 <= force.min() < 10 and 40 < force.max() <= 50


BAD_DESIGNS = [
    ("", "the section [design] is missing; it needs `samples` and limits, such as `amplitude`"),
    (
        DESIGN + COULOMB.replace("coefficient = -3.8e-5", ""),
        "has no `coefficient`; a design needs a guess of its size",
    ),
    (
        "[design]\nsamples = 400\n",
        "'design': give `amplitude`, or `minimum` and `maximum`; got none of them",
    ),
    (
        DESIGN + "minimum = 0\n",
        "'design': give `amplitude`, or `minimum` and `maximum`; got amplitude and minimum",
    ),
    (
        DESIGN.replace("amplitude = 50", "minimum = 3\nmaximum = 3"),
        "'design': `minimum` must be less than `maximum`",
    ),
    (DESIGN.replace("400", "-1"), "'design.samples': found -1"),
    (DESIGN.replace("400", "10"), "`samples` must be a whole number, 30 or more; got 10"),
    (DESIGN.replace("50", "0"), "'design.amplitude': found 0; expected greater than 0"),
    (DESIGN + 'input = "torque"\n', "`input`", "force", "'torque'"),
    (DESIGN + "condition = 1.01\n", "no candidate has a condition number", "Raise `condition`"),
    (DESIGN + "ratio = 1\n", "unknown key 'design.ratio'"),
]


@pytest.mark.parametrize(("text", "words"), [(text, words) for text, *words in BAD_DESIGNS])
def test_bad_designs(project, text, words):
    project.write_text(MACHINE + text)
    done = run("design", project, "--out", "u.csv")
    assert (done.code, done.out) == (2, "") and one_line(done.err, "machine.toml", *words)
    assert not Path("u.csv").exists()


@pytest.mark.parametrize(
    ("out", "words"),
    [
        ("absent/u.csv", "there is no folder absent"),
        (".", "is a folder"),
        ("run.csv", "is read by this run"),
        ("machine.toml", "is read by this run"),
    ],
)
def test_designs_that_cannot_be_written(project, out, words):
    project.write_text(MACHINE + DESIGN)
    before = Path("run.csv").read_bytes()
    done = run("design", project, "--out", out)
    assert done.code == 2 and one_line(done.err, words)
    assert Path("run.csv").read_bytes() == before


def test_design_needs_a_file(project):
    project.write_text(MACHINE + DESIGN)
    assert one_line(run("design", project).err, "--out")


@pytest.mark.parametrize("noise", ["uneven", "white"])
def test_a_split_says_where_the_fit_has_larger_standard_errors(tmp_path, monkeypatch, noise):
    """It has the statistics of white, even errors; the fit asked the residual."""
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(3)
    u, y = rng.normal(size=600), np.zeros(600)
    for k in range(1, 600):
        size = 0.3 * abs(u[k - 1]) if noise == "uneven" else 0.2
        y[k] = 0.7 * y[k - 1] + 0.5 * u[k - 1] + size * rng.normal()
    pd.DataFrame({"u": u, "y": y}).to_csv("run.csv", index=False)
    Path("spec.toml").write_text(
        '[data]\nsampling_time = 0.1\ninputs = ["u"]\noutputs = ["y"]\n'
        'train = { files = ["run.csv"] }\n[lags]\nna = 1\nnb = 1\n[validation]\nblocks = 0\n'
        '[baseline]\nterms = [{ parameter = "a", regressor = "y[k-1]" }, '
        '{ parameter = "b", regressor = "u[k-1]" }]\n[training]\nfocus = "prediction"\n'
    )
    assert run("fit", "spec.toml", "--out", "out").code == 0
    fit = json.loads(Path("out/result.json").read_text())
    split = finite_json(run("split", "out", "run.csv", "--json").out)
    found = [w["text"] for w in split["warnings"] if w["code"] == "plain_standard_errors"]
    if noise == "white":
        assert "standard_errors_by" not in fit and not found
        return
    assert fit["standard_errors_by"] == "hc3"
    ratio = max(row["std"] / row["plain_std"] for row in fit["parameters"])
    assert ratio > 1.2 and f"to {ratio:.2g} times as large" in found[0]
    # a fit that gave none: the split gives none
    fit["standard_errors_by"] = "none"
    Path("out/result.json").write_text(json.dumps(fit))
    split = finite_json(run("split", "out", "run.csv", "--json").out)
    assert all(row["std"] is None and row["ci95"] is None for row in split["parameters"])
    assert "the fit gave none" in split["warnings"][0]["text"]


def test_the_times_of_some_rows_are_those_of_the_file(inside, tmp_path):
    """Also behind a row that is missing, and where every second row is read."""
    columns = pd.read_csv("run.csv")
    columns.loc[50, "y"] = np.nan
    columns.to_csv(tmp_path / "hole.csv", index=False)
    whole = pd.read_csv(io.StringIO(run("simulate", "out", "run.csv").out))
    part = pd.read_csv(io.StringIO(run("simulate", "out", "run.csv", "--rows", "40:90").out))
    np.testing.assert_allclose(part["time"], whole["time"][40:90])
    hole = run("simulate", "out", tmp_path / "hole.csv", "--rows", "40:90", "--missing", "skip")
    np.testing.assert_allclose(pd.read_csv(io.StringIO(hole.out))["time"], whole["time"][40:90])
    second = run("predict", "out", "run.csv", "--rows", "40:90", "--every", 2)
    step = whole["time"][1]  # what the model knows is the time between the rows that are read
    found = pd.read_csv(io.StringIO(second.out))["time"]
    np.testing.assert_allclose(found, 20 * step + step * np.arange(25))
