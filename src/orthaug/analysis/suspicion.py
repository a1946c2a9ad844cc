"""Which unmodelled terms would bias θ: the table of suspects that `orthaug check` and `orthaug fit` show."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from orthaug._base.checks import Vector
from orthaug.analysis.bias import SuspectedBias, bias_table
from orthaug.analysis.suspects import Suspect, data_width, suspect_columns
from orthaug.inference.measures import Support
from orthaug.physics.parameters import PhysicsMap
from orthaug.physics.problem import Problem
from orthaug.physics.projection import Projection

if TYPE_CHECKING:
    from orthaug.commands.job import Job
    from orthaug.commands.spec import SuspectSection

CERTIFIED_ROWS = 200_000  # of a measure at most, over which certificates are sought
_VELOCITY = ("coulomb", "stribeck", "quadratic_drag", "cubic")
_POSITION = ("cubic", "dead_zone")
_INPUT = ("cubic", "dead_zone", "saturation")
_WIDTHS = ("stribeck", "stribeck_gauss", "dead_zone", "saturation")


def declared(sections: Sequence[SuspectSection], problem: Problem) -> tuple[Suspect, ...]:
    """The suspects of a spec; a width that is not given is the median size of what the term acts on.

    Raises:
        InputError: an unknown kind, channel or lag, an expression that cannot be read.
    """
    constants = dict(problem.baseline.constants)
    found = []
    for section in sections:
        width = section.width
        if width is None and section.kind in _WIDTHS and section.on is not None:
            width = data_width(section.on, problem.rows.x, problem.layout, constants)
        only = problem.outputs[0] if len(problem.outputs) == 1 else None
        output = section.output if section.output is not None else only
        options = {"width": width, "output": output, "coefficient": section.coefficient, "name": section.name}
        found.append(Suspect.of(section.kind, section.on, constants=constants, **options))
    return tuple(found)


def usual(problem: Problem) -> tuple[Suspect, ...]:
    """What is often missing: friction, drag, hardening, dead zone and saturation, an offset."""
    layout, outputs = problem.layout, problem.outputs
    pairs: list[tuple[str, str]] = []
    for channel in dict.fromkeys(lag.channel for lag in layout):
        lags = sorted(lag.lag for lag in layout if lag.channel == channel)
        first = next(str(lag) for lag in layout if lag.channel == channel and lag.lag == lags[0])
        pairs += [(kind, first) for kind in (_POSITION if channel in outputs else _INPUT)]
        if channel in outputs and len(lags) > 1:
            second = next(str(lag) for lag in layout if lag.channel == channel and lag.lag == lags[1])
            pairs += [(kind, f"{first} - {second}") for kind in _VELOCITY]
    found = []
    for output in outputs:
        own = output if len(outputs) > 1 else None
        label = f" in {output}" if own else ""
        for kind, on in pairs:
            width = data_width(on, problem.rows.x, layout) if kind in _WIDTHS else None
            found.append(Suspect.of(kind, on, width=width, output=output, name=f"{kind} of {on}{label}"))
        found.append(Suspect.of("offset", output=output, name=f"offset{label}"))
    return tuple(found)


def suspected(job: Job, theta: Vector | None = None, learned: Any = None) -> list[dict[str, Any]]:
    """The bias of every suspect under the spec's measure, for θ and, to first order, for the physical parameters.

    Args:
        theta: θ̂ for relative biases and for dp/dθ; None for one-step least squares.
        learned: f at the measure's points (M, ny) after a fit, to tell how much of it a suspect explains.
    """
    problem = job.problem
    if not problem.baseline.names:
        return []
    points = job.measure.points(Support(job.train.record, problem.layout, job.used))
    suspects = declared(job.spec.suspects, problem) if job.spec.suspects else usual(problem)
    gain = np.sqrt(points.weight)[:, None] * problem.weight
    with np.errstate(all="ignore"):
        phi = np.asarray(problem.baseline.phi(points.x, problem.layout, problem.outputs, np))
        deltas = suspect_columns(suspects, points.x, problem.layout, problem.outputs)
    wanted = bool(job.spec.suspects)  # of the usual ones, those that have an effect
    kept = [i for i in range(len(suspects)) if wanted or np.any(deltas[i])]
    theta = problem.projection.solve(problem.whitened_target) if theta is None else theta
    slopes = _slopes(job.physics, problem, theta)
    table = bias_table(
        Projection.factor(phi * gain[:, :, None]),
        problem.baseline.names,
        [suspects[i] for i in kept],
        deltas[kept],
        gain=gain,
        theta=theta,
        physical=None if slopes is None else slopes[0],
        learned=learned,
        certify=len(points.x) <= CERTIFIED_ROWS or bool(job.spec.suspects),
    )
    sizes = [float(np.sqrt(np.sum((deltas[i] * gain) ** 2))) for i in kept]
    return [
        entry.as_dict()
        | {"relative_physical_bias": _relative(entry, slopes), "size": size}
        | {"expected_physical_bias": _expected(entry, job.physics, problem, theta)}
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


def _slopes(physics: PhysicsMap | None, problem: Problem, theta: Vector) -> tuple[dict[str, Vector], Vector] | None:
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


def check_suspects(sections: Sequence[SuspectSection], problem: Problem) -> None:
    """Raise InputError for suspects that cannot be read, or have no value on some training row."""
    suspect_columns(declared(sections, problem), problem.rows.x, problem.layout, problem.outputs)
