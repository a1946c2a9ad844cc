"""Both penalties on the mass-spring-damper: their limits, and their trends beside the published scripts."""

from __future__ import annotations

import json
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest

from orthaug import (
    MLP,
    AdamLBFGS,
    Additive,
    BaselinePenalty,
    LevenbergMarquardt,
    Orthogonal,
    OrthogonalPenalty,
    estimate,
    synthetic,
)

# Of the scripts' 2500 and 500: θ stands by then
PIPELINE = AdamLBFGS(adam_iterations=100, lbfgs_iterations=60)
# Where the weight is neither small nor large
LONGER = AdamLBFGS(adam_iterations=300, lbfgs_iterations=150)
SHORT = LevenbergMarquardt(iterations=30)
PENALTIES = (OrthogonalPenalty, BaselinePenalty)


@lru_cache
def example():
    return synthetic.mass_spring_damper()


@lru_cache
def fit(structure, solver):
    options = {"learner": MLP(hidden=(16,)), "structure": structure, "solver": solver}
    return estimate(example().train, example().baseline, regularization="none", **options)


def error(structure, pipeline=PIPELINE):
    """Relative error of θ to the truth after the paper's pipeline, shortened, as the published scripts measure it."""
    truth = example().theta
    return np.linalg.norm((fit(structure, pipeline).theta - truth) / truth)


def published(structure):
    """(mean, standard deviation) of that error over the scripts' five initialisations."""
    file = Path(__file__).resolve().parents[2] / "shared" / "reference" / "mass_spring_damper.json"
    if not file.is_file():
        pytest.skip(f"no {file}: the published scripts' results")
    runs = json.loads(file.read_text())
    weight = getattr(structure, "weight", 0.0)
    found = [
        run["theta_relative_error"] for run in runs
        if run["structure"].replace("_", "-") == structure.name and run["weight"] == weight
    ]  # fmt: skip
    assert len(found) == 5
    return np.mean(found), np.std(found)


def test_a_large_orthogonal_penalty_gives_the_orthogonal_structure():
    np.testing.assert_allclose(
        fit(OrthogonalPenalty(1e5), SHORT).theta, fit(Orthogonal(), SHORT).theta, rtol=1e-4
    )


def test_a_large_orthogonal_penalty_drives_the_learner_out_of_the_physics():
    defects = [fit(OrthogonalPenalty(weight), SHORT).defect for weight in (1e-12, 1.0, 1e5)]
    assert defects[0] > 1e-2 and defects[2] < defects[1] < defects[0] and defects[2] < 1e-3


def test_a_large_baseline_penalty_gives_the_initial_values():
    np.testing.assert_allclose(
        fit(BaselinePenalty(1e5), SHORT).theta, (0.61, -0.52, 4.7e-5), rtol=1e-4
    )


@pytest.mark.parametrize("penalty", PENALTIES)
def test_a_small_penalty_gives_the_additive_structure(penalty):
    found, additive = fit(penalty(1e-12), SHORT), fit(Additive(), SHORT)
    np.testing.assert_allclose(found.theta, additive.theta, rtol=1e-3)
    assert not np.allclose(additive.theta, fit(Orthogonal(), SHORT).theta, rtol=1e-2)


@pytest.mark.parametrize("penalty", PENALTIES)
def test_no_penalty_is_the_additive_structure(penalty):
    np.testing.assert_allclose(
        fit(penalty(0.0), SHORT).theta, fit(Additive(), SHORT).theta, rtol=1e-6
    )


@pytest.mark.proof
def test_theta_error_falls_with_the_orthogonal_penalty(record_property):
    """Published: 0.104, 0.078, 0.0141, 0.0130 at 1e-4, 1e-2, 0.1, 10, and 0.01325 of the orthogonal structure."""
    weights, pipelines = (1e-4, 1e-1, 10.0), (PIPELINE, LONGER, PIPELINE)
    small, large, largest = (
        error(OrthogonalPenalty(w), p) for w, p in zip(weights, pipelines, strict=True)
    )
    record_property("relative error of θ", f"{small:.4f}, {large:.4f}, {largest:.4f}")
    assert small > large > 0.012
    assert large == pytest.approx(0.0133, abs=0.002)
    assert largest == pytest.approx(0.0133, abs=0.001)


def test_theta_error_of_the_orthogonal_structure():
    mean, deviation = published(Orthogonal())
    assert error(Orthogonal()) == pytest.approx(mean, abs=1e-5)
    assert deviation < 1e-5


def test_a_baseline_penalty_of_ten_ends_where_the_published_scripts_end():
    mean, deviation = published(BaselinePenalty(10.0))
    found = error(BaselinePenalty(10.0))
    assert mean == pytest.approx(0.294, abs=5e-4) and deviation < 2e-3
    assert found == pytest.approx(0.294, abs=0.01)


def test_theta_error_of_a_large_baseline_penalty_is_that_of_the_initial_values():
    truth = example().theta
    limit = np.linalg.norm((example().baseline.initial - truth) / truth)
    assert limit == pytest.approx(0.296, abs=5e-4)
    assert error(BaselinePenalty(10.0)) == pytest.approx(limit, rel=1e-3)
