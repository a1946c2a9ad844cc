"""Test of the residual against every lag that the learner does not see.

Under that hypothesis the residual is `(I − P)ε`, P the projection onto the physics and the
functions of z. So it has no mean product with any function h of a lag from which P is taken off:
the score test of `Σ_k h̃_k e_k = 0` with h̃ = (I − P)h. Its covariance is that of Newey and West,
so that noise may be coloured and of uneven size.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.special
from jaxtyping import Float

from orthaug._base.checks import Matrix, Vector
from orthaug._base.errors import Warning
from orthaug._base.lines import percent
from orthaug.analysis.absorbed import Smoother
from orthaug.analysis.residuals import errors_of
from orthaug.fitting.lagged_estimate import LaggedEstimate
from orthaug.inference.covariance import newey_west
from orthaug.models.response import Response
from orthaug.physics.output_weights import times
from orthaug.physics.problem import Problem
from orthaug.physics.shared import seen_columns

LEVEL = 0.01
_FARTHEST = 4.0  # deviations: farther values count as this far
_PRODUCTS = 3  # of the lag with learner inputs, at most
_FEWEST_ROWS = 200
_RESOLVED = 1e-6  # of a function, its part that neither the physics nor the learner can be


@dataclass(frozen=True)
class LagTest:
    """Residual against a lag that the learner does not see: p-value, explained variance share."""

    lag: str
    p: float
    share: float


@dataclass(frozen=True)
class MissingLags:
    """The tests of all lags that the learner does not see.

    `missing` are those below `level`, surest first.
    """

    tests: tuple[LagTest, ...]
    level: float = LEVEL

    @property
    def missing(self) -> tuple[LagTest, ...]:
        """Below the level, divided by the number of lags (Bonferroni)."""
        found = [test for test in self.tests if test.p < self.level / len(self.tests)]
        return tuple(sorted(found, key=lambda test: (test.p, -test.share)))

    @property
    def text(self) -> str:
        """In a sentence."""
        tested = ", ".join(test.lag for test in self.tests)
        if not self.missing:
            return (
                f"The residual shows no dependence on lags that the learner does not see "
                f"({tested})."
            )
        first = self.missing[0]
        others = (
            f" (after it {', '.join(test.lag for test in self.missing[1:])})"
            if len(self.missing) > 1
            else ""
        )
        return (
            "The learner cannot express all that the physics lacks, which biases θ: "
            f"{first.lag} explains {percent(first.share)} of the residual's variance{others}. "
            "Add that lag to learner.inputs."
        )

    @property
    def warnings(self) -> tuple[Warning, ...]:
        """Warnings on missing lags."""
        return (Warning("missing_lag", self.text),) if self.missing else ()


def missing_lags(fit: LaggedEstimate, one_step: Response | None = None) -> MissingLags | None:
    """Return the tests of a one-step fit.

    None where the learner sees all lags, without a learner, with a noise model, or with too few
    rows.

    Args:
        one_step: the prediction of the training data, if it is there already.
    """
    problem = fit.problem
    if fit.criterion.free_run is not None or not problem.features.entries:
        return None
    if fit.model.coloured:  # the test takes errors that no filter has passed
        return None
    visible = seen_columns(problem.features, problem.layout, problem.rows.x, lambda rows: rows)
    hidden = [j for j, one in enumerate(visible) if not one]
    if not hidden or len(problem.rows) < _FEWEST_ROWS:
        return None
    response = fit.model.predict(problem.record) if one_step is None else one_step
    return MissingLags(lag_tests(problem, np.concatenate(errors_of(response)), hidden))


def lag_tests(problem: Problem, residual: Matrix, hidden: Sequence[int]) -> tuple[LagTest, ...]:
    """Return the test of each lag, by its place in the layout.

    Args:
        residual: of every row, (N, ny), in the outputs' units.
    """
    smoother = Smoother(problem)
    x, gain = problem.rows.x[smoother.every], problem.weight.matrix
    e = smoother.left(times(gain, residual[smoother.every]))
    rows, ny = e.shape
    phi = times(gain, problem.phi(x))
    phi = phi / np.maximum(np.sqrt(np.sum(phi**2, axis=(0, 1))), np.finfo(float).tiny)
    physics = _orthonormal(smoother.left(phi).reshape(rows * ny, phi.shape[2]), 1.0)
    e = _project_out(physics, e.reshape(-1)).reshape(rows, ny)
    cuts = _experiments(problem, len(e), smoother.every.step or 1)
    found = []
    for j in hidden:
        forms = _functions(x[:, j], smoother.inputs)
        stacked = np.einsum("kh,io->kioh", forms, np.eye(ny)).reshape(rows, ny, forms.shape[1] * ny)
        left = _project_out(physics, smoother.left(stacked).reshape(rows * ny, forms.shape[1] * ny))
        basis = _orthonormal(left, np.sqrt(rows))
        test = _score_test(basis.reshape(rows, ny, basis.shape[1]), e, cuts)
        if test is not None:
            found.append(LagTest(str(problem.layout[j]), *test))
    return tuple(found)


def _functions(lag: Vector, z: Matrix) -> Float[np.ndarray, "N h"]:
    """Return functions of a lag and its products with learner inputs, of mean square about 1."""
    size = lag.std()
    s = np.clip((lag - lag.mean()) / (size if size > 0 else 1.0), -_FARTHEST, _FARTHEST)
    forms = [s, s**2, s**3, np.abs(s), np.sign(s), *(s * column for column in z.T[:_PRODUCTS])]
    columns = np.stack(forms, axis=1)
    norm = np.sqrt(np.mean(columns**2, axis=0))
    return columns / np.where(norm > 0, norm, 1.0)


def _score_test(
    h: Float[np.ndarray, "N ny q"], e: Matrix, cuts: list[int]
) -> tuple[float, float] | None:
    """Return the p-value of `Σ h e = 0`, and the share of e that h explains, less chance."""
    scores = np.einsum("koq,ko->kq", h, e)
    rows, rank = scores.shape
    if rank == 0:
        return None
    total = scores.sum(axis=0)
    spread = newey_west(np.split(scores, cuts))
    values, vectors = np.linalg.eigh(spread)
    if values[0] <= 0:
        return None
    statistic = float(np.sum((vectors.T @ total) ** 2 / values))
    share = float(total @ total / np.vdot(e, e)) - rank / e.size
    return float(scipy.special.fdtrc(rank, rows - rank, statistic / rank)), max(share, 0.0)


def _orthonormal(columns: Matrix, size: float) -> Matrix:
    """Return an orthonormal basis of the columns, without what is rounding beside `size`."""
    if not columns.shape[1] or not size:
        return columns[:, :0]
    u, sigma, _ = np.linalg.svd(columns, full_matrices=False)
    return u[:, sigma > _RESOLVED * size]


def _project_out(basis: Matrix, values: np.ndarray) -> np.ndarray:
    return values - basis @ (basis.T @ values)


def _experiments(problem: Problem, rows: int, step: int) -> list[int]:
    """Return the ends of experiments among every `step`-th usable row."""
    ends = np.cumsum(
        [len(experiment) - problem.rows.start for experiment in problem.record.experiments]
    )[:-1]
    return [min(-(-int(end) // step), rows) for end in ends]
