"""The small form of benchmarks/silent_misses.py: the truth is in an interval that is shown, or something warns."""

import sys
from importlib import import_module
from pathlib import Path

import pytest

sys.path.append(str(Path(__file__).resolve().parents[1] / "benchmarks"))
DRAWS = 10
SYSTEMS = {
    "coloured noise of the equation": ("coverage_noise", "3000 rows", "AR(0.2)"),
    "noise of uneven size": ("coverage_noise", "300 rows", "uneven"),
    "smooth friction": ("coverage_causes", "-.15 tanh(v/.3)", 0.02),
    "friction that no catalogue has": ("coverage_causes", "-.4 v/(1+v²)", 0.02),
    "friction of two laws": ("coverage_causes", "Stribeck, v²", 0.02),
}


@pytest.mark.proof
@pytest.mark.parametrize("name", SYSTEMS)
def test_silent_misses_are_few(name, record_property, monkeypatch):
    """Ten draws of a row: no more than 5 % and twice its standard error."""
    names = ("coverage_causes", "coverage_noise", "silent_misses")
    coverage_causes, coverage_noise, silent_misses = map(import_module, names)
    where, system, noise = SYSTEMS[name]
    if where == "coverage_noise":
        monkeypatch.setattr(coverage_noise, "row", lambda *given: given)
        (given,) = [
            given for given in coverage_noise.lagged_rows(DRAWS) if given[:2] == (system, noise)
        ]
        monkeypatch.undo()
        row = coverage_noise.row(*given)
    else:
        forms = {**coverage_causes.IN_CATALOGUE, **coverage_causes.OUTSIDE}
        monkeypatch.setattr(coverage_causes, "NOISES", (noise,))
        monkeypatch.setattr(coverage_causes, "IN_CATALOGUE", {system: forms[system]})
        monkeypatch.setattr(coverage_causes, "OUTSIDE", {})
        monkeypatch.setattr(coverage_causes, "MOTIONS", {})
        (row,) = coverage_causes.rows(DRAWS, 0)
    record_property("silent misses [%]", f"{row.silent:.0f}")
    assert (
        row.silent
        <= silent_misses.Row(system, str(noise), "", DRAWS, row.held, row.silent, row.width).most
    )
    assert row.held > 0


@pytest.mark.proof
@pytest.mark.parametrize("seed", [5, 6])
def test_folds_that_evidence_silences_do_not_cost_the_learner(seed):
    """On two or three of four folds evidence leaves nothing of the learner; on all rows it finds the friction."""
    coverage_shared = import_module("coverage_shared")
    value, (low, high), _ = coverage_shared.motion("independent noise", 0.01, seed)
    assert low < coverage_shared.TRUTH < high
    assert high - low < 0.2 and abs(value - coverage_shared.TRUTH) < 0.05
