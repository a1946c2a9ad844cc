"""One `orthaug fit` does each thing once: it poses, factorises and stacks once, and simulates once per part."""

from __future__ import annotations

import sys
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from test_cli import run as command

from orthaug import Model, synthetic
from orthaug.commands import demo
from orthaug.data import regressors
from orthaug.physics import problem
from orthaug.physics.projection import Projection

pytestmark = pytest.mark.usefixtures("without_figures")


@pytest.fixture
def spec(tmp_path: Path) -> Path:
    """The demo's spec with its data, trained for a moment."""
    example = synthetic.mass_spring_damper()
    for name, record in (("train", example.train), ("test", example.test)):
        run = record.experiments[0].rows(0, 1500)
        table = np.column_stack([run.inputs, run.outputs])
        np.savetxt(
            tmp_path / f"{name}.csv",
            table,
            fmt="%.17g",
            delimiter=",",
            header="force,position",
            comments="",
        )
    text = demo.SPEC.replace("[training]", '[training]\nfocus = "prediction"\niterations = 3')
    (tmp_path / "spec.toml").write_text(text, encoding="utf-8")
    return tmp_path / "spec.toml"


@pytest.fixture
def counted(monkeypatch: pytest.MonkeyPatch) -> Counter[str]:
    """How often each of the dear steps is taken, from wherever it is called."""
    calls: Counter[str] = Counter()

    def count(owner: object, name: str) -> None:
        original = getattr(owner, name)

        def counting(*args: object, **kwargs: object) -> object:
            calls[name] += 1
            return original(*args, **kwargs)

        monkeypatch.setattr(owner, name, counting)

    for name, home in (("pose", problem), ("stack_rows", regressors)):
        original = getattr(home, name)
        users = [
            m
            for key, m in sys.modules.items()
            if key.startswith("orthaug") and getattr(m, name, None) is original
        ]
        count(home, name)
        for module in users:
            monkeypatch.setattr(module, name, getattr(home, name))
    count(Projection, "factor")
    simulate = Model.simulate

    def simulating(self: Model, *args: object, **kwargs: object) -> object:
        calls["simulate physics alone" if not self.learns else "simulate"] += 1
        return simulate(self, *args, **kwargs)

    monkeypatch.setattr(Model, "simulate", simulating)
    return calls


def test_the_counts_of_a_fit(
    spec: Path, tmp_path: Path, counted: Counter[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Both parts are scored, of the model and of physics alone, which the verdict takes; the page drops the learner."""
    monkeypatch.setattr(
        "orthaug.commands.fit.with_advice", lambda fitted: fitted
    )  # which fits other specs
    assert command("fit", spec, "--out", tmp_path / "result").code in (0, None)
    assert counted["pose"] == counted["factor"] == counted["stack_rows"] == 1
    assert counted["simulate"] == 2
    assert (
        counted["simulate physics alone"] <= 4
    )  # the fit of physics alone on both parts; the page's on both
