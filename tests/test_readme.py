"""What the README shows works as it stands there."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from test_cli import run, write_csv

from orthaug.commands.opening import open_job

README = (Path(__file__).resolve().parents[1] / "README.md").read_text(encoding="utf-8")


def block(language: str, number: int = 0) -> str:
    return re.findall(rf"^```{language}\n(.*?)^```", README, flags=re.DOTALL | re.MULTILINE)[number]


def write_run(path: Path, rows: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    u, y = rng.normal(size=rows), np.zeros(rows)
    for k in range(2, rows):
        y[k] = 1.5 * y[k - 1] - 0.7 * y[k - 2] + 0.1 * u[k - 1] - 0.1 * y[k - 1] ** 3
    write_csv(path, force=u, position=y + 0.001 * rng.normal(size=rows))


def g(x: np.ndarray) -> np.ndarray:
    """A model trained elsewhere."""
    return (1.5 * x[:, 0] - 0.7 * x[:, 1] + 0.1 * x[:, 2] - 0.1 * x[:, 0] ** 3)[:, None]


def test_from_python(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    write_run(Path("run1.csv"), 400, 0)
    names: dict = {"g": g}
    exec(compile(block("python"), "README.md", "exec"), names)
    out = capsys.readouterr().out
    assert all(name in out for name in ("theta1", "theta2", "theta3", "m/N", "95 % interval"))
    fit = names["fit"]
    assert len(fit.restarts) == 3
    assert fit.parameters["value"].tolist() == fit.theta.tolist()
    loaded = names["oa"].load("model")
    np.testing.assert_array_equal(loaded.theta, fit.theta)


def test_the_spec(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for seed, name in enumerate(("run1", "run2", "steps")):
        write_run(Path(f"{name}.csv"), 200, seed)
    Path("spec.toml").write_text(block("toml"), encoding="utf-8")
    done = run("check", "spec.toml")
    assert (done.code, done.err) == (0, "")
    for words in ("theta1, theta2, theta3", "position[k-1], position[k-2], force[k-1]", "396", "rank 3 of 3"):
        assert words in done.out
    assert run("fit", "spec.toml", "--out", "result").code == 0
    assert Path("result/result.json").is_file()


def test_the_motion(tmp_path):
    for seed, name in enumerate(("run1", "run2", "steps")):
        write_run(tmp_path / f"{name}.csv", 200, seed)
    data = block("toml").partition("[[baseline.terms]]")[0]
    (tmp_path / "spec.toml").write_text(data + block("toml", 1), encoding="utf-8")
    job = open_job(tmp_path / "spec.toml")
    assert job.problem.motion.names_of_states == ("x", "v")
    assert job.spec.learner_inputs() == ("v",)


def test_the_commands_exist():
    shell = next(
        text for text in re.findall(r"^```\n(.*?)^```", README, re.DOTALL | re.MULTILINE) if "orthaug check" in text
    )
    named = re.findall(r"^orthaug (\w+) ", shell, flags=re.MULTILINE)
    assert {"check", "fit", "simulate", "predict"} <= set(named)
    for name in named:
        assert run(name, "--help").code == 0
