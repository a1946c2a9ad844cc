"""A sampled linear system in continuous time.

A lagged model is written first with as many states as its transfer function needs (observer form), less dead time that
belongs to an input alone. Then `zoh`: `[[A, B], [0, 0]] = ln [[A_d, B_d], [0, I]] / Ts`, exact for inputs that are held
between samples; or `tustin`: `z = (1 + s Ts/2) / (1 − s Ts/2)`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.linalg

from orthaug._base.checks import Matrix, Vector
from orthaug.analysis.linear_system import System
from orthaug.models.stepping import Memory

METHODS = ("zoh", "tustin")
_ROUNDING = 1e-8  # of a matrix: what the logarithm must give back


@dataclass(frozen=True, eq=False)
class Continuous:
    """The system in continuous time; `dead_time` [s] (nu,) delays its inputs. `method` is that of the conversion.

    "equations" are a motion's own. `states` are their names.
    """

    system: System
    dead_time: Vector
    method: str
    states: tuple[str, ...]


def converted(system: System, method: str, memory: Memory | None, names: tuple[str, ...]) -> Continuous | str:
    """The system in continuous time, or why there is none."""
    step = system.step
    assert step is not None
    dead = np.zeros(system.d.shape[1], dtype=int)
    if memory is not None:
        system, dead = observer_form(system, memory)
        names = tuple(f"x{i + 1}" for i in range(system.states))
    poles = system.modes
    if method == "tustin":
        if np.any(np.abs(poles.values + 1) < 1e-9):
            return "a pole at -1 has no counterpart under Tustin's rule."
        return Continuous(System(_tustin(system, step), system.states, None), dead * step, method, names)
    if poles.at_zero:
        count = "a pole at 0 has" if poles.at_zero == 1 else f"{poles.at_zero} poles at 0 have"
        return f"{count} no counterpart under a hold (what is forgotten within a sample); tustin gives one."
    values: Any = poles.values
    negative = values[(values.real < 0) & (np.abs(values.imag) < 1e-9 * np.abs(values))]
    if len(negative):
        told = ", ".join(f"{value.real:.4g}" for value in negative)
        return (
            f"a real pole below 0 ({told}) alternates from sample to sample, which no real system does under a hold; "
            "tustin gives one."
        )
    found = _logarithm(system, step)
    if found is None:
        return "the matrix logarithm cannot be computed to the digits that are needed; tustin gives a system."
    return Continuous(System(found, system.states, None), dead * step, method, names)


def observer_form(system: System, memory: Memory) -> tuple[System, Any]:
    """A lagged system with `Σ n_i` states, n_i the largest lag in the equation of output i; and dead samples (nu,).

    `s_i,l⁺ = s_i,l+1 + Σ_j a_ij,l y_j + Σ_j b_ij,l u_j`, `y_i = s_i,1 + Σ_j d_ij u_j`.
    """
    c, d = system.c, system.d
    ny, nu = d.shape
    inputs = list(memory.inputs)
    outputs = [name for name, _ in memory.depths[:ny]]
    longest = max((lag.lag for lag in memory.lags), default=0)
    of_y, of_u = np.zeros((longest, ny, ny)), np.zeros((longest + 1, ny, nu))
    of_u[0] = d
    for column, lag in zip(c.T, memory.lags, strict=True):
        if lag.channel in inputs:
            of_u[lag.lag, :, inputs.index(lag.channel)] = column
        else:
            of_y[lag.lag - 1, :, outputs.index(lag.channel)] = column
    dead = np.zeros(nu, dtype=int)
    for j in range(nu):
        acts = np.flatnonzero(np.any(of_u[:, :, j] != 0, axis=1))
        dead[j] = max(acts[0] - 1, 0) if len(acts) else 0
        of_u[:, :, j] = np.roll(of_u[:, :, j], -dead[j], axis=0)
    used = [np.any(of_y[:, i] != 0, axis=1) | np.any(of_u[1:, i] != 0, axis=1) for i in range(ny)]
    orders = [int(np.max(np.flatnonzero(u), initial=-1)) + 1 for u in used]
    n, first = sum(orders), np.concatenate([[0], np.cumsum(orders)]).astype(int)
    matrix = np.zeros((n + ny, n + nu))
    read = np.zeros((ny, n + nu))  # y of state and inputs
    read[:, n:] = of_u[0]
    for i in range(ny):
        if orders[i]:
            read[i, first[i]] = 1.0
    for i in range(ny):
        for lag in range(orders[i]):
            row = matrix[first[i] + lag]
            row += of_y[lag, i] @ read
            row[n:] += of_u[lag + 1, i]
            if lag + 1 < orders[i]:
                row[first[i] + lag + 1] += 1.0
    matrix[n:] = read
    return System(matrix, n, system.step), dead


def _logarithm(system: System, step: float) -> Matrix | None:
    n, nu = system.states, system.d.shape[1]
    whole = np.eye(n + nu)
    whole[:n] = system.matrix[:n]
    with np.errstate(all="ignore"):
        found: Any = np.asarray(scipy.linalg.logm(whole)) if n else np.zeros((nu, nu))
    if not np.isfinite(found).all() or np.abs(found.imag).max(initial=0.0) > _ROUNDING * np.abs(found).max(initial=0.0):
        return None
    back = scipy.linalg.expm(found.real)
    if np.abs(back - whole).max(initial=0.0) > _ROUNDING * np.abs(whole).max(initial=1.0):
        return None
    matrix = system.matrix.copy()
    matrix[:n] = found.real[:n] / step
    return matrix


def _tustin(system: System, step: float) -> Matrix:
    n = system.states
    inverse = np.linalg.inv(system.a + np.eye(n))
    a = 2 / step * (system.a - np.eye(n)) @ inverse
    b = 2 / np.sqrt(step) * inverse @ system.b
    c = 2 / np.sqrt(step) * system.c @ inverse
    return np.block([[a, b], [c, system.d - system.c @ inverse @ system.b]])
