"""How does a step depend on the one before? A_k = ∂x_{k+1}/∂x_k along a run, and its spectral radius.

A small change of the state obeys `δx_{k+1} = A_k δx_k` in a free run. The state of the lagged form is
`x_k = (y_{k−1}, …, y_{k−na})`: its A_k is a companion matrix, with ∂g/∂y_{k−i} in the first ny rows and shifts below.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from orthaug._base.checks import Vector, check_choice
from orthaug.analysis.local_dynamics import linearised
from orthaug.analysis.visited import MOST_STEPS, Place, Visited, measured_by, visited_by
from orthaug.data.record import Record
from orthaug.models.model import Model
from orthaug.models.response import Response

MOST_WORK = 4e7  # rows times n0³
_LONGEST_STATE = 200  # n0 with eigenvalues at all


@dataclass(frozen=True, eq=False)
class Feedback:
    """How m of the `steps` of a run, spread evenly, depend on the state before.

    `transition` are the A_k in the units of the state, `radius` (m,) their spectral radii, and their summary is None
    where there are none. `skipped` points are left out because the model has no finite derivative there; `diverged`
    says in which output and where a free run left all bounds; `unit` (n0,) is the deviation of each entry of the state.
    """

    points: Visited
    transition: Float[np.ndarray, "m n0 n0"]
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
    """A_k = ∂x_{k+1}/∂x_k and its spectral radius along a run; None for a model without a state.

    At most 20000 steps, spread evenly: fewer where the state is large, none where n0 is above 200. Radii below 1 do not
    make a nonlinear run stable, nor do some above 1 make it unstable. They say where to look.

    Args:
        along: "simulation", states of the free run up to where it diverges, or "measured", as the outputs give them.
        response: the model's free run of the record, if it is there already.

    Raises:
        InputError: a record that does not fit the model, or another `along`.
    """
    check_choice(along, ("simulation", "measured"), "`along`")
    if not (size := model.form.states):
        return None
    most = 0 if size > _LONGEST_STATE else min(MOST_STEPS, int(MOST_WORK / size**3))
    if along == "simulation":
        run = visited_by(model, record, model.simulate(record) if response is None else response, most)
    else:
        run = measured_by(model, record, most)
    points, transition, radius = linearised(model, run.points)
    largest, worst = points.worst(record, radius, model.form.describe)
    median, share = (float(np.median(radius)), float(np.mean(radius > 1 + 1e-6))) if worst else (None, None)
    skipped = len(run.points) - len(points)
    return Feedback(
        points, transition, radius, run.unit, largest, median, share, worst, run.steps, skipped, run.diverged
    )
