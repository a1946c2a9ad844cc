"""Compiled programs take memory maps, and Linux ends a process that has too many of them."""

import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import orthaug as oa
from orthaug._base import jax as own

MAPS = Path("/proc/self/maps")
pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="other systems have no such limit")


def count() -> int:
    return MAPS.read_bytes().count(b"\n")


def test_programs_go_where_they_take_too_many_maps():
    assert not own.release_programs(1.0)
    for size in range(1, 12):
        jax.jit(lambda x: jnp.sin(x) @ x)(jnp.ones(size))
    before = count()
    assert own.release_programs(0.0) and count() < before


def test_a_loop_of_fits_lets_them_go(monkeypatch):
    """Each fit of other orders compiles anew; the numbers of a fit do not depend on it."""
    u = np.random.default_rng(1).normal(size=120)
    y = np.convolve(u, [0, 0.5, 0.2, 0.1])[:120] + 0.1 * u**2
    record = oa.Record.from_arrays(u, y, sampling_time=0.1)
    physics = oa.Baseline.from_terms([oa.Term("b", "u[k-1]")])

    def fit(hidden):
        return oa.estimate(record, physics, learner=oa.MLP((hidden,), inputs=("u[k]",))).theta

    kept = fit(3)
    monkeypatch.setattr(own.release_programs, "__defaults__", (0.0,))
    assert fit(3) == pytest.approx(kept, rel=1e-12)
    counts = []
    for hidden in range(2, 7):
        fit(hidden)
        counts.append(count())
    assert max(counts) < 1.2 * counts[0]
