"""Measures: weighted points on which physics and learner are made orthogonal (F3).

θ under a measure is `Φ_μ⁺ G_μ`, the least-squares share of the fitted function g in the physics
over those points. The paper takes the training set. A function that is orthogonal to the physics
under one measure need not be so under another.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Annotated, Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from annotated_types import Len
from jaxtyping import Float

from orthaug._base.checks import Matrix, Vector, nearest
from orthaug._base.errors import InputError
from orthaug._base.registry import LIBRARY_ONLY, Option
from orthaug.data.channels import Channel
from orthaug.data.expressions import Lag
from orthaug.data.record import Experiment, Record
from orthaug.data.regressors import Layout, lag_matrix, largest_lag, stack_rows
from orthaug.physics.baseline import Baseline
from orthaug.physics.excitation import Excitation, excitation
from orthaug.physics.guessed_motion import layout_of
from orthaug.physics.motion import Motion
from orthaug.physics.noise import NoiseModel, RowFilter
from orthaug.physics.output_weights import times
from orthaug.physics.problem import Problem
from orthaug.physics.projection import Projection

_NODES = (1 << 20, 512, 64)  # of the rule for one, two and three coordinates, in each of them
_PANEL = 8  # Gauss-Legendre nodes of a panel
_QUASI_RANDOM = 1 << 17  # points for more coordinates, doubled by their mirror images
# points at most, of the data and of the measure, by which the reach of the data is judged
_NEIGHBOURS = 20_000


class Points(NamedTuple):
    """Regressors (M, nx) and their weights (M,), which add up to 1."""

    x: Matrix
    weight: Vector


@dataclass(frozen=True, eq=False)
class Support:
    """The training record, its regressor and the lags that the model reads, for measures."""

    record: Record
    layout: Layout
    used: tuple[Lag, ...]
    stacked: Matrix | None = None
    """The training regressors, where they are stacked already."""

    @classmethod
    def of(cls, problem: Problem) -> Support:
        """Return the support of a posed problem."""
        return cls(problem.record, problem.layout, problem.used, problem.rows.x)

    @classmethod
    def of_motion(cls, motion: Motion, x: Matrix, u: Matrix) -> Support:
        """Return the support of a motion's states (M, nx) and inputs (M, nu) at training rows."""
        layout, points = layout_of(motion), np.concatenate([x, u], axis=1)
        channels = tuple(Channel(f"c{i}") for i in range(len(layout)))
        return cls(
            Record((), channels, 1.0, (Experiment(points[:, :0], points),)), layout, layout, points
        )

    @cached_property
    def x(self) -> Matrix:
        """The training regressors (N, nx)."""
        return stack_rows(self.record, self.layout).x if self.stacked is None else self.stacked

    def share(self, points: Points) -> float:
        """Return the share of the measure's weight that lies in the operating range of the data.

        A point is within reach if its nearest training point is closer than a limit: twice the
        distance from a training point to its nearest neighbour, at the 99 % quantile. Each used lag
        counts in units of the range of its data.
        """
        columns = [j for j, lag in enumerate(self.layout) if lag in self.used]
        x = self.x[:, columns]
        if not columns:
            return 1.0
        unit = np.where(np.ptp(x, axis=0) > 0, np.ptp(x, axis=0), 1.0)
        known = np.unique(x[:: -(-len(x) // _NEIGHBOURS)] / unit, axis=0)
        if len(known) < 2:
            return float(np.sum(points.weight[(points.x[:, columns] / unit == known).all(axis=1)]))
        from scipy.spatial import KDTree  # slow to import, and few runs need it

        tree = KDTree(known)
        reach = 2 * np.quantile(tree.query(known, k=2)[0][:, 1], 0.99)
        some = slice(None, None, -(-len(points.x) // _NEIGHBOURS))
        weight = points.weight[some] / points.weight[some].sum()
        return float(np.sum(weight[tree.query(points.x[some][:, columns] / unit)[0] <= reach]))


@runtime_checkable
class Measure(Protocol):
    """A measure as `Orthogonal(measure=…)` and `fit.split(…)` accept it."""

    @property
    def name(self) -> str: ...

    def points(self, support: Support) -> Points:
        """Return the points over which physics and learner are made orthogonal."""
        ...


def _even_points(x: Matrix) -> Points:
    return Points(x, np.full(len(x), 1 / len(x)))


@dataclass(frozen=True)
class Training:
    """The training rows with equal weights: the paper's measure.

    `rows` (start, stop) of each experiment.
    """

    rows: tuple[int, int] | None = field(default=None, metadata=LIBRARY_ONLY)
    name: str = field(default="training", metadata=LIBRARY_ONLY)

    def points(self, support: Support) -> Points:
        if self.rows is None:
            return _even_points(support.x)
        start, stop = self.rows
        first = largest_lag(support.layout)
        kept = []
        for experiment in support.record.experiments:
            rows = lag_matrix(experiment, support.layout, support.record, first)
            kept.append(rows[max(start - first, 0) : max(stop - first, 0)])
        x = np.concatenate(kept)
        if not len(x):
            raise InputError(
                f"rows {start}:{stop} hold no usable row; the first is at row {first}."
            )
        return _even_points(x)


@dataclass(frozen=True)
class Symmetrized:
    """The training rows and their mirror images −x: the paper's sign trick."""

    name: str = field(default="symmetrized", metadata=LIBRARY_ONLY)

    def points(self, support: Support) -> Points:
        x = support.x
        return _even_points(np.concatenate([x, -x]))


@dataclass(frozen=True, eq=False)
class Weighted:
    """The training rows with given weights (N,), in the order of the usable rows."""

    weights: Any
    name: str = "weighted"

    def points(self, support: Support) -> Points:
        x = support.x
        return Points(x, _normalise(self.weights, len(x), "usable rows"))


OF_ROWS = (Training, Symmetrized, Weighted)
"""Measures whose points are those of the training rows, once or several times over."""


@dataclass(frozen=True, eq=False)
class Samples:
    """Given points: a column per raw lag that the model reads, named as in expressions.

    Args:
        columns: values (M,) of each lag, `{"force[k-1]": …}`.
        weights: (M,), none negative; None for equal ones.

    Examples:
        >>> Samples({"u[k-1]": [-1.0, 0.0, 1.0]}, weights=[0.25, 0.5, 0.25]).name
        'samples'
    """

    columns: Mapping[str, Any]
    weights: Any = None
    name: str = "samples"

    def points(self, support: Support) -> Points:
        values: dict[Lag, Vector] = {}
        for text, column in self.columns.items():
            lag = _lag_of(text, support)
            if lag in values:
                raise InputError(f"the samples give {lag} twice; one column for each lag.")
            try:
                values[lag] = np.asarray(column, dtype=float)
            except (TypeError, ValueError):
                raise InputError(f"the samples' column {lag} must be numbers.") from None
        missing = [str(lag) for lag in support.used if lag not in values]
        if missing:
            what = _entries(support)
            raise InputError(
                f"the samples lack {', '.join(missing)}; give a column for every {what} that "
                "is used."
            )
        lengths = {str(lag): v.shape for lag, v in values.items()}
        if len(set(lengths.values())) > 1 or any(len(shape) != 1 for shape in lengths.values()):
            raise InputError(
                f"the samples' columns differ in shape: {lengths}; give one vector of a length "
                "for each."
            )
        count = next(iter(values.values())).shape[0]
        if not count:
            raise InputError(
                "the samples have no rows; give at least as many as there are parameters."
            )
        bad = [str(lag) for lag, v in values.items() if not np.isfinite(v).all()]
        if bad:
            raise InputError(f"the samples' column {bad[0]} holds a value that is not finite.")
        x = np.zeros((count, len(support.layout)))
        for j, lag in enumerate(support.layout):
            x[:, j] = values.get(lag, 0.0)
        weight = np.ones(count) if self.weights is None else self.weights
        return Points(x, _normalise(weight, count, "samples"))


@dataclass(frozen=True, eq=False)
class Uniform:
    """Uniform over a box of raw lags.

    A deterministic rule that is symmetric about the box's centre integrates over it.

    Composite Gauss-Legendre in up to three coordinates, Sobol points with their mirror images in
    more.

    Args:
        box: limits of raw lags, `{"force[k-1]": (-200, 200)}`; lags that are not named take the
            data's own range.

    Examples:
        >>> Uniform(box={"u[k-1]": (-2, 2)}).name  # fit.split(Uniform(…)) gives θ under it
        'uniform'
    """

    box: Annotated[Mapping[str, Annotated[Sequence[float], Len(2, 2)]], Option("box")] = field(
        default_factory=dict
    )
    name: str = field(default="uniform", metadata=LIBRARY_ONLY)

    def points(self, support: Support) -> Points:
        low, high = self.limits(support)
        columns = [j for j, lag in enumerate(support.layout) if lag in support.used]
        unit = _rule(len(columns))
        x = np.zeros((len(unit.x), len(support.layout)))
        centre, half = (low + high) / 2, (high - low) / 2
        x[:, columns] = centre[columns] + half[columns] * unit.x
        return Points(x, unit.weight)

    def limits(self, support: Support) -> tuple[Vector, Vector]:
        """Return the lower and upper limits of every entry of the regressor, each (nx,).

        Raises:
            InputError: an unknown lag, limits that are empty or reversed.
        """
        x = support.x
        low, high = x.min(axis=0), x.max(axis=0)
        for text, limits in self.box.items():
            lag = _lag_of(text, support)
            try:
                start, stop = (float(limit) for limit in limits)
            except (TypeError, ValueError):
                raise InputError(
                    f"the box of {text} must be two numbers, lower and upper; got {limits!r}."
                ) from None
            if not (math.isfinite(start) and math.isfinite(stop) and start < stop):
                raise InputError(f"the box of {text} is empty or reversed: {start:g} to {stop:g}.")
            j = support.layout.index(lag)
            low[j], high[j] = start, stop
        return low, high


def _normalise(weights: Vector, count: int, what: str) -> Vector:
    try:
        values = np.asarray(weights, dtype=float)
    except (TypeError, ValueError):
        raise InputError("the weights must be numbers.") from None
    if values.shape != (count,):
        raise InputError(f"there are {values.shape} weights for {count} {what}; give one for each.")
    wrong = np.flatnonzero(~(np.isfinite(values) & (values >= 0)))
    if len(wrong):
        raise InputError(
            f"weight {wrong[0]} of the {what}, counted from 0, is {values[wrong[0]]:g}; expected "
            "a finite number, 0 or more."
        )
    if values.sum() <= 0:
        raise InputError(f"the weights of the {what} are all 0; expected one above.")
    return values / values.sum()


def _lag_of(text: str, support: Support) -> Lag:
    """Return the used lag that a text such as `force[k-1]` names."""
    known = {str(lag): lag for lag in support.used}
    plain = "".join(text.split())
    if plain.endswith("[k-0]"):
        plain = plain[:-3] + "]"
    if plain not in known:
        raise InputError(
            f"'{text}' is no {_entries(support)} that this model "
            f"reads{nearest(plain, known) or '.'} It reads {', '.join(known)}."
        )
    return known[plain]


def _entries(support: Support) -> str:
    """Return the entries that a measure may name: a motion has no lags."""
    return "raw lag" if any("[" in str(lag) for lag in support.used) else "state or input"


def _rule(coordinates: int) -> Points:
    """Return nodes on [−1, 1]ᵈ with weights that add up to 1, symmetric about 0."""
    if coordinates == 0:
        return _even_points(np.zeros((1, 0)))
    if coordinates <= len(_NODES):
        panels = _NODES[coordinates - 1] // _PANEL
        node, weight = np.polynomial.legendre.leggauss(_PANEL)
        edges = np.linspace(-1, 1, panels + 1)
        line = ((edges[:-1] + edges[1:])[:, None] / 2 + node / panels).ravel()
        share = np.tile(weight / (2 * panels), panels)
        grid = np.meshgrid(*[line] * coordinates, indexing="ij")
        shares = np.meshgrid(*[share] * coordinates, indexing="ij")
        return Points(
            np.stack([g.ravel() for g in grid], axis=-1),
            np.prod([s.ravel() for s in shares], axis=0),
        )
    import scipy.stats.qmc  # slow to import, and few boxes have so many coordinates

    quasi = 2 * scipy.stats.qmc.Sobol(coordinates, scramble=True, rng=0).random(_QUASI_RANDOM) - 1
    return _even_points(np.concatenate([quasi, -quasi]))


@dataclass(frozen=True, eq=False)
class WeighedPhysics:
    """A measure's `points`, and the physics there with every row multiplied by `unit` (M, ny, ny).

    The unit is the square root of a point's weight times the matrix of the output weights.
    """

    measure: Measure
    points: Points
    unit: Float[np.ndarray, "M ny ny"]
    projection: Projection
    excitation: Excitation
    noise: RowFilter | None = None
    """The filter of a noise model, where the points are the training rows in their order."""

    def times(self, values: Float[np.ndarray, "M ny ..."]) -> Float[np.ndarray, "M ny ..."]:
        """Return values at the points in the inner product of the measure."""
        return times(self.unit, values if self.noise is None else self.noise.rows(values))


def weigh(
    measure: Measure,
    support: Support,
    baseline: Baseline,
    outputs: tuple[str, ...],
    weight: Matrix,
    noise: NoiseModel | None = None,
) -> WeighedPhysics:
    """Return the physics over a measure's points.

    Args:
        weight: the matrix of the output weights, (ny, ny).
        noise: filters the training rows; points of other measures have no order in time.

    Raises:
        InputError: a measure that does not fit the data, or on whose points the physics is not
            finite.
    """
    points = measure.points(support)
    with np.errstate(all="ignore"):
        phi = np.asarray(baseline.phi(points.x, support.layout, outputs, np))
    if not np.isfinite(phi).all():
        point, _, column = np.argwhere(~np.isfinite(phi))[0]
        at = ", ".join(
            f"{lag} = {value:.4g}"
            for lag, value in zip(support.layout, points.x[point], strict=True)
        )
        raise InputError(
            f"the physics is not finite on all points of the {measure.name} measure: the "
            f"regressor of {baseline.names[column]} is not at {at}. Take the training measure, "
            "or a uniform one over a box where it is."
        )
    unit = np.sqrt(points.weight)[:, None, None] * weight
    along = None
    if noise is not None and measure == Training():
        first = largest_lag(support.layout)
        along = RowFilter(noise, tuple(len(e) - first for e in support.record.experiments))
        phi = along.rows(phi)
    projection = Projection.factor(times(unit, phi))
    return WeighedPhysics(
        measure, points, unit, projection, excitation(projection.r, baseline.names), along
    )


def weigh_problem(measure: Measure, problem: Problem) -> WeighedPhysics:
    """Return the physics over a measure's points for a posed problem.

    Under the training measure it takes the factor that the problem has.
    """
    if measure != Training():
        return weigh(
            measure, Support.of(problem), problem.baseline, problem.outputs, problem.weight.matrix
        )
    # under a noise model the factor is that of the filtered rows
    rows, own = len(problem.rows), problem.projection
    even = np.full(rows, 1 / rows)
    size = np.sqrt(even[0])
    projection = replace(own, r=own.r * size, phi=own.phi * size)
    unit = np.sqrt(even)[:, None, None] * problem.weight.matrix
    return WeighedPhysics(
        measure, Points(problem.rows.x, even), unit, projection, problem.excitation, problem.noise
    )
