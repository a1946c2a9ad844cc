"""What stands for any function of a learner's features: fixed functions of them, linear in their weights."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from orthaug._base.checks import Matrix, Vector
from orthaug._base.jax import jnp

WAVES = 24  # tanh functions
_STEEPEST = 30.0  # of their slopes, in units of 1 / range of z
_SEED = 20_241_122


@dataclass(frozen=True)
class Waves:
    """A constant, the features z in [-1, 1] and tanh waves of them, each with a weight."""

    inputs: tuple[str, ...] | None = None

    def init(self, key: Any, nz: int, ny: int) -> Any:
        return jnp.zeros((ny, 1 + nz + WAVES))

    def apply(self, tree: Any, z: Any) -> Any:
        return tree @ functions_of(z, jnp)


def functions_of(z: Any, xp: Any) -> Any:
    """The functions (1 + nz + WAVES, …) of features (nz, …), by `xp` (numpy or jax.numpy)."""
    slopes, offsets = _drawn(len(z))
    shape = (-1, *(1,) * (z.ndim - 1))
    return xp.concatenate([xp.ones((1, *z.shape[1:])), z, xp.tanh(xp.tensordot(slopes, z, 1) - offsets.reshape(shape))])


@lru_cache(maxsize=16)
def _drawn(nz: int) -> tuple[Matrix, Vector]:
    """Slopes (WAVES, nz) and offsets: every wave has its centre among the features."""
    random = np.random.default_rng(_SEED)
    slopes = random.normal(size=(WAVES, nz))
    steep = np.exp(random.uniform(0.0, np.log(_STEEPEST), size=(WAVES, 1)))
    slopes *= steep / np.linalg.norm(slopes, axis=1)[:, None]
    centres = random.uniform(-1, 1, size=(WAVES, nz))
    return slopes, np.sum(slopes * centres, axis=1)
