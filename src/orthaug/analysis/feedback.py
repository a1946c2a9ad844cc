"""How does a step depend on the one before? A_k along a run, and its spectral radius.

With `A_{k,i} = ∂g/∂y_{k−i}` (ny, ny) a small change of the past, `s_k = (δy_{k−1}, …, δy_{k−na})`, obeys
`s_{k+1} = A_k s_k` in a free run. The companion matrix A_k has the A_{k,i} in its first ny rows and shifts the rest.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from orthaug._base.checks import Vector, check_choice
from orthaug.analysis.local_dynamics import linearised, measured_by, state_size, visited_by
from orthaug.analysis.visited import MOST_STEPS, Place, Visited, evenly
from orthaug.data.record import Record
from orthaug.models.model import Model
from orthaug.models.response import Response

MOST_WORK = 4e7  # rows times (na ny)³
_LONGEST_STATE = 200  # na ny with eigenvalues at all


@dataclass(frozen=True, eq=False)
class Feedback:
    """How m of the `steps` of a run, spread evenly, depend on the past outputs.

    `jacobians[:, i - 1]` are the A_{k,i} in the outputs' units, `radius` (m,) the spectral radii of the A_k, and their
    summary is None where there are none. `skipped` points are left out because the model has no finite derivative
    there; `diverged` says in which output and where a free run left all bounds; `unit` (ny,) is the deviation of y.
    """

    points: Visited
    jacobians: Float[np.ndarray, "m na ny ny"]
    radius: Vector
    unit: Vector
    largest: float | None
    median: float | None
    share_above_one: float | None
    worst: Place | None
    steps: int
    skipped: int
    diverged: tuple[str, ...]


def feedback(
    model: Model, record: Record, *, along: str = "simulation", response: Response | None = None
) -> Feedback | None:
    """A_{k,i} = ∂g/∂y_{k−i} and the spectral radius of A_k along a run; None for a model without past outputs.

    At most 20000 steps, spread evenly: fewer where na ny is large, none where it is above 200. Radii below 1 do not
    make a nonlinear run stable, nor do some above 1 make it unstable. They say where to look.

    Args:
        along: "simulation", regressors of the model's own outputs up to where it diverges, or "measured".
        response: the model's free run of the record, if it is there already.

    Raises:
        InputError: a record that does not fit the model, or another `along`.
    """
    check_choice(along, ("simulation", "measured"), "`along`")
    if not (size := state_size(model)):
        return None
    if along == "simulation":
        run = model.simulate(record) if response is None else response
        every, unit, diverged = visited_by(model, record, run)
    else:
        (every, unit), diverged = measured_by(model, record), ()
    some = every.take(evenly(len(every), 0 if size > _LONGEST_STATE else min(MOST_STEPS, int(MOST_WORK / size**3))))
    points, jacobians, radius = linearised(model, some)
    largest, worst = points.worst(record, radius)
    median, share = (float(np.median(radius)), float(np.mean(radius > 1 + 1e-6))) if worst else (None, None)
    skipped = len(some) - len(points)
    return Feedback(points, jacobians, radius, unit, largest, median, share, worst, len(every), skipped, diverged)
