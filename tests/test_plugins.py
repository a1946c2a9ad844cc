"""A package that is installed beside orthaug adds kinds by entry points; here one that a wheel's folder holds."""

import os
import subprocess
import sys
from importlib.metadata import EntryPoint

import numpy as np
import pytest

from orthaug import InputError
from orthaug._base import plugins
from orthaug.data import tables
from orthaug.models.kinds import LEARNERS

PACKAGE = '''
"""Kinds of another package."""

import json
from dataclasses import dataclass

import jax
import jax.numpy as jnp


@dataclass(frozen=True)
class Bumps:
    """Gaussian bumps at even places of each feature."""

    count: int = 5
    inputs: tuple[str, ...] | None = None

    def init(self, key, nz, ny):
        return 0.01 * jax.random.normal(key, (ny, nz, self.count))

    def apply(self, tree, z):
        centres = jnp.linspace(-1, 1, self.count)
        return jnp.einsum("ijp,jp->i", tree, jnp.exp(-(((z[:, None] - centres) * self.count / 2) ** 2)))


@dataclass(frozen=True)
class SignalList:
    """What goes in and out."""

    summary = "a list of signals"

    def files(self, program, vectors):
        return {"signals.json": json.dumps([signal.label for signal in program.inputs])}

    def usage(self, program):
        return "Read it."


def read(path):
    """Return the columns of a file whose rows are JSON."""
    rows = [json.loads(line) for line in path.read_text().splitlines()]
    return {name: [row[name] for row in rows] for name in rows[0]}
'''
ENTRIES = """[orthaug.learners]
bumps = other_kinds:Bumps
[orthaug.exporters]
signals = other_kinds:SignalList
[orthaug.readers]
jsonl = other_kinds:read
"""
SPEC = """
[data]
sampling_time = 0.1
inputs = ["u"]
outputs = ["y"]
train = { files = ["run.jsonl"] }
[[baseline.terms]]
parameter = "a"
regressor = "y[k-1]"
[[baseline.terms]]
parameter = "b"
regressor = "u[k-1]"
[learner]
kind = "bumps"
count = 7
inputs = ["y[k-1]"]
[training]
restarts = 1
iterations = 20
[validation]
blocks = 0
"""


@pytest.fixture
def installed(tmp_path):
    """A folder as pip makes it: a module, and what it declares."""
    site = tmp_path / "site"
    kept = site / "other_kinds-1.0.dist-info"
    kept.mkdir(parents=True)
    (site / "other_kinds.py").write_text(PACKAGE)
    (kept / "METADATA").write_text("Metadata-Version: 2.1\nName: other-kinds\nVersion: 1.0\n")
    (kept / "entry_points.txt").write_text(ENTRIES)

    def command(*words):
        path = os.pathsep.join(filter(None, [str(site), os.environ.get("PYTHONPATH", "")]))
        return subprocess.run(
            [sys.executable, "-m", "orthaug", *map(str, words)],
            cwd=tmp_path,
            env={**os.environ, "PYTHONPATH": path},
            capture_output=True,
            text=True,
            check=False,
        )

    return command


def test_a_package_adds_a_learner_an_exporter_and_a_reader(tmp_path, installed):
    rng = np.random.default_rng(10)
    u, y = rng.normal(size=400), np.zeros(400)
    for k in range(1, 400):
        y[k] = 0.7 * y[k - 1] + 0.5 * u[k - 1] + 0.1 * y[k - 1] ** 2 + 0.01 * rng.normal()
    rows = [f'{{"u": {a!r}, "y": {b!r}}}' for a, b in zip(u.tolist(), y.tolist(), strict=True)]
    (tmp_path / "run.jsonl").write_text("\n".join(rows))
    (tmp_path / "spec.toml").write_text(SPEC)
    done = installed("fit", "spec.toml", "--out", "result")
    assert done.returncode == 0, done.stderr
    assert "Bumps(count=7" in done.stdout
    done = installed("simulate", "result", "run.jsonl", "--out", "run.csv")
    assert done.returncode == 0, done.stderr
    done = installed("export", "result", "--to", "numpy", "--out", "code")
    assert done.returncode == 2 and "learner" in done.stderr  # no code is known of it
    (tmp_path / "physics.toml").write_text(SPEC.replace('kind = "bumps"', 'kind = "none"'))
    assert installed("fit", "physics.toml", "--out", "physics").returncode == 0
    done = installed("export", "physics", "--to", "signals", "--out", "signals")
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "signals" / "signals.json").read_text() == '["u"]'
    done = installed("export", "physics", "--to", "signal", "--out", "more")
    assert done.returncode == 2 and "did you mean 'signals'?" in done.stderr


def test_a_package_that_cannot_be_used_is_named(monkeypatch):
    def declare(value):
        entry = EntryPoint("odd", value, plugins.LEARNERS)
        monkeypatch.setattr(plugins, "entry_points", lambda group: (entry,))

    declare("no_such_package:Odd")
    with pytest.raises(
        InputError, match="the learner 'odd' of no_such_package:Odd cannot be loaded"
    ):
        LEARNERS.discover()
    declare("json:dumps")
    with pytest.raises(InputError, match="'odd' of json:dumps cannot be used: .* frozen dataclass"):
        LEARNERS.discover()
    assert "odd" not in LEARNERS


def test_a_reader_that_is_no_function_is_named(monkeypatch, tmp_path):
    entry = EntryPoint("odd", "math:pi", plugins.READERS)
    monkeypatch.setattr(plugins, "entry_points", lambda group: (entry,))
    (tmp_path / "a.odd").write_text("1")
    with pytest.raises(InputError, match="the reader 'odd' is no function of a path"):
        tables.read_table(tmp_path / "a.odd", ["u"])
