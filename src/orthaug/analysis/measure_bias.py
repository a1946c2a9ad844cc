"""What each suspect does to θ and to the physical parameters, under the measure that a spec declares."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from orthaug._base.checks import Matrix, Vector
from orthaug.analysis.bias import SuspectedBias, bias_table
from orthaug.analysis.suspects import Suspect, suspect_columns, usual_suspects
from orthaug.inference.weighed import Weighed
from orthaug.physics.output_weights import times
from orthaug.physics.parameters import PhysicsMap
from orthaug.physics.problem import Problem

CERTIFIED_ROWS = 200_000  # of a measure at most, over which certificates are sought for suspects that no one named


def bias_under(
    weighed: Weighed,
    problem: Problem,
    suspects: Sequence[Suspect] = (),
    *,
    physics: PhysicsMap | None = None,
    theta: Vector | None = None,
    learned: Matrix | None = None,
    certify_usual: bool = True,
) -> list[dict[str, Any]]:
    """The bias of every suspect under a measure, for θ and, to first order, for the physical parameters; for JSON.

    Args:
        weighed: the measure's points and the physics there, of one parameter or more.
        suspects: those that were named; without any, the usual ones that have an effect.
        physics: the map from physical parameters to θ.
        theta: θ̂ for relative biases and for dp/dθ; None for one-step least squares.
        learned: f at the measure's points (M, ny) after a fit, to tell how much of it a suspect explains.
        certify_usual: seek certificates, a linear program each, for suspects that no one named, too.
    """
    named, x = bool(suspects), weighed.points.x
    suspects = [suspect.sampled(problem.record.sampling_time) for suspect in suspects or usual_suspects(problem)]
    with np.errstate(all="ignore"):
        deltas = suspect_columns(suspects, x, problem.layout, problem.outputs)
    kept = [i for i in range(len(suspects)) if named or np.any(deltas[i])]
    theta = problem.least_squares if theta is None else theta
    slopes = physical_slopes(physics, problem, theta)
    table = bias_table(
        weighed.projection,
        problem.baseline.names,
        [suspects[i] for i in kept],
        deltas[kept],
        gain=weighed.unit,
        theta=theta,
        physical=None if slopes is None else slopes[0],
        learned=learned,
        certify=named or (certify_usual and len(x) <= CERTIFIED_ROWS),
    )
    sizes = [float(np.linalg.norm(times(weighed.unit, deltas[i]))) for i in kept]
    return [
        entry.as_dict()
        | {"relative_physical_bias": _relative(entry, slopes), "size": size}
        | {"expected_physical_bias": _expected(entry, physics, problem, theta)}
        for entry, size in zip(table, sizes, strict=True)
    ]


def _expected(
    entry: SuspectedBias, physics: PhysicsMap | None, problem: Problem, theta: Vector
) -> dict[str, dict[str, float | None]] | None:
    """What the guessed coefficient does to each physical parameter: p of θ̂ less p without the bias."""
    if physics is None or entry.expected is None:
        return None
    from orthaug.inference.physical import solve

    order = [problem.baseline.names.index(name) for name in physics.theta_names]
    without = theta - np.array(entry.expected)
    biased, true = (solve(physics, t[order], None, freedom=np.inf).value for t in (theta, without))
    return {
        name: {"bias": float(b - t), "relative": float((b - t) / t) if t else None}
        for name, b, t in zip(physics.names, biased, true, strict=True)
    }


def _relative(entry: SuspectedBias, slopes: tuple[dict[str, Vector], Vector] | None) -> dict[str, float | None] | None:
    """The bias of each physical parameter over its value."""
    if slopes is None or entry.physical is None:
        return None
    return {name: bias / p if p else None for (name, bias), p in zip(entry.physical, slopes[1], strict=True)}


def physical_slopes(
    physics: PhysicsMap | None, problem: Problem, theta: Vector
) -> tuple[dict[str, Vector], Vector] | None:
    """dp/dθ, in the order of the baseline's θ, at the p that θ gives; and that p."""
    if physics is None:
        return None
    from orthaug.inference.physical import solve

    order = [problem.baseline.names.index(name) for name in physics.theta_names]
    p = solve(physics, theta[order], None, freedom=np.inf).value
    inverse = np.linalg.pinv(physics.jacobian(p) / _size(physics, p)[0][:, None] * _size(physics, p)[1])
    inverse = inverse * _size(physics, p)[1][:, None] / _size(physics, p)[0]
    rows = np.zeros((len(p), len(problem.baseline.names)))
    rows[:, order] = inverse
    return dict(zip(physics.names, rows, strict=True)), p


def _size(physics: PhysicsMap, p: Vector) -> tuple[Vector, Vector]:
    """Scales of θ and p, so that the pseudo-inverse sees numbers of one size."""
    theta = np.abs(physics.theta(p))
    return np.where(theta > 0, theta, 1.0), np.where(p != 0, np.abs(p), 1.0)
