"""Remedies of a bias: other learner inputs, another measure. Each is computed, and only what works is named."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from orthaug._base.checks import Vector
from orthaug._base.errors import InputError
from orthaug.analysis.bias import SuspectedBias
from orthaug.analysis.imitation import other_inputs
from orthaug.analysis.measure_bias import MeasureLinearization
from orthaug.analysis.suspects import Suspect
from orthaug.data.expressions import parse
from orthaug.data.regressors import Features
from orthaug.inference.measures import Symmetrized, Uniform, weigh_problem
from orthaug.physics.output_weights import times
from orthaug.physics.shared import seen, shared_directions

_REMOVED = 0.1  # of the bias may remain
_MEASURED_ROWS = 50_000  # above which no other measure is tried


def remedies(linearization: MeasureLinearization, cause: SuspectedBias, biased: Sequence[str]) -> list[str]:
    """Return sentences on what removes the bias by a cause from the parameters named, the easiest first."""
    return [*_by_inputs(linearization, cause, biased), *_by_measure(linearization, cause, biased)]


def _by_inputs(linearization: MeasureLinearization, cause: SuspectedBias, biased: Sequence[str]) -> Iterator[str]:
    """The choice of learner inputs that frees most of the parameters."""
    problem, suspect = linearization.problem, cause.suspect
    layout, x = problem.layout, problem.rows.x
    now = {str(entry) for entry in problem.features.entries}
    best: tuple[tuple[str, ...], tuple[str, ...]] = ((), ())
    for inputs in dict.fromkeys((*(((suspect.on,),) if suspect.on else ()), *other_inputs(problem))):
        if set(inputs) == now:
            continue
        features = Features(tuple(parse(text, dict(problem.baseline.constants)) for text in inputs))
        if not set(features.lags) <= set(layout):
            continue
        if not seen(features, layout, x, lambda rows: suspect.form(rows, layout)[:, None])[0]:
            continue
        shared = shared_directions(problem.baseline, features, layout, problem.outputs, x)
        if shared.all:
            continue
        left = _bias(replace(linearization, directions=shared.basis), suspect)
        freed = _freed(linearization, cause, left, biased)
        if len(freed) > len(best[1]):
            best = (inputs, freed)
    if best[1]:
        listed = ", ".join(f'"{text}"' for text in best[0])
        rest = "" if len(best[1]) == len(biased) else f" for {', '.join(best[1])}"
        yield f"set learner.inputs = [{listed}]{rest}"


def _by_measure(linearization: MeasureLinearization, cause: SuspectedBias, biased: Sequence[str]) -> Iterator[str]:
    """A measure that brings the bias of all of them near zero."""
    if cause.seen is False or len(linearization.problem.rows) > _MEASURED_ROWS:
        return
    for measure in (Symmetrized(), Uniform()):
        if measure.name == linearization.weighed.measure.name:
            continue
        try:
            other = replace(linearization, weighed=weigh_problem(measure, linearization.problem), learned=None)
            left = _bias(other, cause.suspect)
        except InputError:
            continue
        if len(_freed(linearization, cause, left, biased)) == len(biased):
            yield f"split under the {measure.name} measure"
            return


def _bias(linearization: MeasureLinearization, suspect: Suspect) -> Vector:
    """The bias per unit of a suspect that the learner sees."""
    values = suspect.values(linearization.weighed.points.x, linearization.problem.layout, linearization.problem.outputs)
    return linearization.weighed.projection.solve_along(
        times(linearization.weighed.unit, values), linearization.directions
    )


def _freed(
    linearization: MeasureLinearization, cause: SuspectedBias, left: Vector, biased: Sequence[str]
) -> tuple[str, ...]:
    """Parameters, physical ones by their slopes, whose bias shrinks to a small part."""
    names, before = linearization.problem.baseline.names, np.array(cause.bias)
    rows = dict(zip(names, np.eye(len(names)), strict=True)) | (linearization.slopes[0] if linearization.slopes else {})
    return tuple(name for name in biased if abs(rows[name] @ left) <= _REMOVED * abs(rows[name] @ before))
