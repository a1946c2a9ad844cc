"""How steep is the one-step predictor? Gradients over measured regressors (`cond:pred_stab`)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np

from orthaug._base.checks import Matrix
from orthaug.analysis.local_dynamics import gradients, measured_by, physics_at
from orthaug.analysis.visited import MOST_STEPS, Place, evenly, positive
from orthaug.data.record import Record
from orthaug.models.model import Model


@dataclass(frozen=True)
class Lipschitz:
    """Largest ‖∂g/∂x‖ and ‖∂φ/∂x‖ (Frobenius, no less than ‖·‖₂) over measured rows; None where none is finite.

    ∂g/∂x is (ny, nx) in output units per regressor unit, ∂φ/∂x is (ny nθ, nx). The scaled ones, and the places, are
    for regressors and outputs in their standard deviations and columns of φ in their RMS.
    """

    gradient: float | None
    gradient_scaled: float | None
    worst: Place | None
    phi: float | None
    phi_scaled: float | None
    phi_worst: Place | None
    rows: int


def lipschitz(model: Model, record: Record, *, x: Matrix | None = None) -> Lipschitz:
    """Gradients of the one-step predictor g, and of ∂g/∂θ = φ, over measured regressors (`cond:pred_stab`).

    The predictor γ_k = g(x_k) reads the last n samples only. With ‖∂g/∂x‖ ≤ L on a convex set of all regressors,
    `|γ − γ̃| ≤ L Σ_{i≥k−n} (|u_i − ũ_i| + |y_i − ỹ_i|) ≤ L λ⁻ⁿ Γ_k` for every λ in (0, 1), because λ^{k−i} ≥ λⁿ there:
    the condition holds with `C = max(L λ⁻ⁿ, |g(0)|)`, and likewise for ∂γ/∂θ. Bounded gradients are all that it asks
    of a finite memory. Here L is that of at most 20000 measured rows and of this θ; it may be larger elsewhere, and the
    learner's weights are not in φ. None of it tells about the free run: y_k = 2 y_{k−1} fulfils the condition.

    Args:
        x: the record's usable regressors (N, nx) in the model's layout, if they are stacked already.

    Raises:
        InputError: a record that does not fit the model, or has no outputs.
    """
    every, y_scale = measured_by(model, record, x)
    points, x_scale = every.take(evenly(len(every), MOST_STEPS)), every.x.std(axis=0)
    size = partial(np.linalg.norm, axis=(1, 2))
    largest = []
    with np.errstate(all="ignore"):
        phi = physics_at(model, points.x)
        rms = np.sqrt(np.mean(np.sum((phi / y_scale[:, None]) ** 2, axis=1), axis=0))
        for of_phi, scale in ((False, y_scale), (True, np.outer(y_scale, positive(rms)).ravel())):
            batches = (g.reshape(len(g), len(scale), len(x_scale)) for g in gradients(model, points.x, of_phi))
            norms = [(size(g), size(g * x_scale / scale[:, None])) for g in batches]
            plain, scaled = (np.concatenate(column) for column in zip(*norms, strict=True))
            largest += [points.worst(record, plain)[0], *points.worst(record, scaled)]
    return Lipschitz(*largest, rows=len(points))
