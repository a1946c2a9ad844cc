"""The learned part as a function: along the training data, over one input, and over two."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import singledispatch
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float

from orthaug._base.checks import Matrix, Vector
from orthaug._base.lines import with_unit
from orthaug.data.record import Record
from orthaug.fitting.estimates import Estimate
from orthaug.fitting.lagged_estimate import LaggedEstimate
from orthaug.fitting.motion_estimate import MotionEstimate
from orthaug.models.motion_field import labels_of, parts_at

if TYPE_CHECKING:
    from orthaug.models.model import Model
    from orthaug.models.moving import MotionDynamics

_MOST_POINTS = 2000  # of a cloud
_BATCH = 512  # points of a compiled call
_CURVE = 200  # points of a curve
_BEYOND = 0.2  # of the data's range, drawn at each side of it
_BINS = 24  # of means over a feature
_CELLS = 36  # of a surface, in each direction, in which data are looked for
_FINER = 2  # times as many in which the learned part is drawn
_IN_A_CELL = 3  # points of the data on average, where their means are drawn
_TIED = 0.95  # correlation of features from which medians of the others are no possible state
Reach = Callable[[Matrix], Matrix | None]
"""Half the length of 95 % intervals of the learned part (M, nl) at points (M, n); None where there
are none.
"""


@dataclass(frozen=True, eq=False)
class Curve:
    """The learned part over one variable, all others at their medians."""

    along: Vector
    inside: Bool[np.ndarray, "n"]
    """The range of the data."""
    learned: Matrix
    half: Matrix | None
    """Half the length of 95 % intervals."""


@dataclass(frozen=True, eq=False)
class Surface:
    """The learned part over two variables, all others at their medians.

    It is NaN where no data are near.
    """

    across: Vector
    along: Vector
    learned: Float[np.ndarray, "a b nl"]


@dataclass(frozen=True, eq=False)
class LearnedPart:
    """The learned part of a model on training data: its points, and its values at any others.

    Points are (M, n) of the `variables`.

    `seen` (M, nz) are the learner's `features` at the points, `values` (M, nl) the learned part,
    named `names` with their units.
    """

    names: tuple[str, ...]
    features: tuple[str, ...]
    units: tuple[str, ...]
    """Units of the features; empty for expressions."""
    variables: tuple[str, ...]
    points: Matrix
    seen: Matrix
    values: Matrix
    at: Callable[[Matrix], Matrix]
    reach: Reach | None = None

    @classmethod
    def of_motion(
        cls, model: Model[MotionDynamics], record: Record, reach: Reach | None = None
    ) -> LearnedPart:
        """Return the learned part of a motion, along the free run of the first experiment."""
        states, inputs = trajectory_of(model, record)
        chosen = spread_indices(len(states))
        points, size = np.concatenate([states, inputs], axis=1)[chosen], states.shape[1]

        def at(x: Matrix) -> Matrix:
            padded = x[np.minimum(np.arange(-(-len(x) // _BATCH) * _BATCH), len(x) - 1)]
            batches = np.split(padded, len(padded) // _BATCH)
            found = [
                parts_at(model.form, model.numbers, *np.split(b, [size], axis=1))[1]
                for b in batches
            ]
            return np.concatenate(found)[: len(x)]

        with np.errstate(all="ignore"):
            seen = model.form.features_of(points)
        motion, units = model.form.motion, units_of(model)
        features = tuple(str(entry) for entry in model.form.features)
        return cls(
            names=tuple(labels_with_units(model)),
            features=features,
            units=tuple(units.get(name, "") for name in features),
            variables=(*motion.names_of_states, *motion.inputs),
            points=points,
            seen=seen,
            values=at(points),
            at=at,
            reach=reach,
        )

    @classmethod
    def of_lagged(cls, model: Model, record: Record) -> LearnedPart:
        """Return the learned part `f − φ θ_aux` of a lagged model, at all measured regressors."""
        form, record = model.form, model.fitting(record, need_outputs=True)
        rows = np.concatenate(
            [form.regressors(experiment, record) for experiment in record.experiments]
        )
        points = rows[spread_indices(len(rows))]
        of_channel = {channel.name: channel.unit for channel in (*model.outputs, *model.inputs)}
        units = {str(lag): of_channel.get(lag.channel, "") for lag in form.layout}
        features = tuple(str(entry) for entry in form.features.entries)

        def at(x: Matrix) -> Matrix:
            """Return the learned part at any points."""
            rows = np.minimum(np.arange(max(len(x), len(points))), len(x) - 1)
            return np.asarray(model.parts_at(x[rows]).learner)[: len(x)]

        return cls(
            names=tuple(with_unit(c.name, c.unit) for c in model.outputs),
            features=features,
            units=tuple(units.get(name, "") for name in features),
            variables=tuple(str(lag) for lag in form.layout),
            points=points,
            seen=form.features_of(points),
            values=at(points),
            at=at,
        )

    def curve(self, feature: str) -> Curve | None:
        """Return the curve over a variable, a fifth beyond the data; None of an expression."""
        if feature not in self.variables:
            return None
        place = self.variables.index(feature)
        low, high = self.points[:, place].min(), self.points[:, place].max()
        beyond = _BEYOND * (high - low)
        along = np.linspace(low - beyond, high + beyond, _CURVE)
        rows = np.tile(np.median(self.points, axis=0), (_CURVE, 1))
        rows[:, place] = along
        half = None if self.reach is None else self.reach(rows)
        return Curve(along, (along >= low) & (along <= high), self.at(rows), half)

    def leading_pair(self) -> tuple[str, str]:
        """Return the feature that explains most, and of those that are not tied to it the next.

        There are at least two features.
        """
        first, *others = self.rank()
        own = self.seen[:, self.features.index(first)]
        for name in others:
            other = self.seen[:, self.features.index(name)]
            if own.std() > 0 and other.std() > 0 and abs(np.corrcoef(own, other)[0, 1]) <= _TIED:
                return first, name
        return first, others[0]

    def is_tied(self, feature: str, but: str = "") -> bool:
        """Return whether the data move another feature along with it, except the feature `but`.

        Then no data show its effect with the other at rest.
        """
        moving = [
            name
            for name, spread in zip(self.features, self.seen.std(axis=0), strict=True)
            if spread > 0
        ]
        own = self.seen[:, self.features.index(feature)]
        others = [self.seen[:, self.features.index(n)] for n in moving if n not in (feature, but)]
        return feature in moving and any(
            abs(np.corrcoef(own, other)[0, 1]) > _TIED for other in others
        )

    def is_separable(self, across: str, along: str) -> bool:
        """Return whether two features are variables that can be varied with all else at rest."""
        known = across in self.variables and along in self.variables
        return known and not self.is_tied(across, along) and not self.is_tied(along, across)

    def means(self, feature: str) -> tuple[Vector, Matrix]:
        """Return means of feature (k,) and learned part (k, nl) in bins of equally many points."""
        order = np.argsort(self.seen[:, self.features.index(feature)], kind="stable")
        bins = np.array_split(order, min(_BINS, max(len(order) // 8, 1)))
        centres = np.array([self.seen[b, self.features.index(feature)].mean() for b in bins])
        return centres, np.array([self.values[b].mean(axis=0) for b in bins])

    def shares(self) -> Matrix:
        """Return the share of variance that the means over each feature explain, (nz, nl)."""
        total = np.maximum(self.values.var(axis=0), 1e-300)
        return np.array([self.means(feature)[1].var(axis=0) / total for feature in self.features])

    def rank(self) -> Sequence[str]:
        """Return the features, the one that explains most of the learned part first."""
        order = np.argsort(-self.shares().max(axis=1), kind="stable")
        return [self.features[j] for j in order]

    def surface(self, across: str, along: str) -> Surface:
        """Return the surface over two features where there are data near.

        For features that do not vary alone, it is the mean of the data in each cell.
        """
        pair = self.seen[:, [self.features.index(across), self.features.index(along)]]
        low, high = pair.min(axis=0), pair.max(axis=0)
        width = np.maximum(high - low, 1e-300)
        alone = self.is_separable(across, along)
        count = (
            _CELLS if alone else min(max(int(np.sqrt(len(pair) / _IN_A_CELL)), _CELLS // 4), _CELLS)
        )
        cells = np.minimum((count * (pair - low) / width).astype(int), count - 1)
        size = _FINER * count if alone else count
        first, second = (low[k] + width[k] * (np.arange(size) + 0.5) / size for k in (0, 1))
        if alone:
            rows = np.tile(np.median(self.points, axis=0), (size * size, 1))
            rows[:, self.variables.index(across)] = np.repeat(first, size)
            rows[:, self.variables.index(along)] = np.tile(second, size)
            batch = max(len(self.points), _BATCH)  # of as many there is a program
            found = [self.at(rows[start : start + batch]) for start in range(0, len(rows), batch)]
            learned = np.concatenate(found).reshape(size, size, -1)
            near = np.repeat(np.repeat(_cells_near_data(cells), _FINER, axis=0), _FINER, axis=1)
            learned = np.where(near[..., None], learned, np.nan)
        else:
            learned = _mean_in_cells(cells, self.values, count)
        return Surface(first, second, learned)


def learned_of(fit: Estimate, record: Record) -> LearnedPart | None:
    """Return the learned part of a fit along a record, with intervals where it has them.

    None where nothing was learned.
    """
    if not fit.learns:
        return None
    return _part_of(fit, record)


@singledispatch
def _part_of(fit: Estimate, record: Record) -> LearnedPart:
    """Return the learned part of a kind of physics."""
    raise NotImplementedError


@_part_of.register(LaggedEstimate)
def _of_lagged(fit: LaggedEstimate, record: Record) -> LearnedPart:
    return LearnedPart.of_lagged(fit.model, record)


@_part_of.register(MotionEstimate)
def _of_motion(fit: MotionEstimate, record: Record) -> LearnedPart:
    from orthaug.analysis.learned_part import learned_reach

    size = fit.model.form.states
    return LearnedPart.of_motion(
        fit.model, record, lambda points: learned_reach(fit, *np.split(points, [size], axis=1))
    )


def _cells_near_data(cells: np.ndarray) -> Bool[np.ndarray, "a b"]:
    """Return the cells with data, and those beside them."""
    there = np.zeros((_CELLS + 2, _CELLS + 2), dtype=bool)
    for i in (0, 1, 2):
        for j in (0, 1, 2):
            there[cells[:, 0] + i, cells[:, 1] + j] = True
    return there[1:-1, 1:-1]


def _mean_in_cells(cells: np.ndarray, values: Matrix, size: int) -> Float[np.ndarray, "a b nl"]:
    count, total = np.zeros((size, size)), np.zeros((size, size, values.shape[1]))
    np.add.at(count, tuple(cells.T), 1)
    np.add.at(total, tuple(cells.T), values)
    return np.where(count[..., None] > 0, total / np.maximum(count, 1)[..., None], np.nan)


def spread_indices(count: int, most: int = _MOST_POINTS) -> np.ndarray:
    """Return at most so many indices, spread evenly over `count`."""
    return np.linspace(0, count - 1, min(count, most)).astype(int)


def trajectory_of(model: Model[MotionDynamics], record: Record) -> tuple[Matrix, Matrix]:
    """Return states and inputs of the free run of the first experiment, as far as it is finite."""
    record = model.fitting(record, need_outputs=False)
    frame = model.states(record)
    first = record.experiments[0]
    states = frame[list(model.form.motion.names_of_states)].to_numpy()[: len(first)]
    finite = np.isfinite(states).all(axis=1)
    end = len(states) if finite.all() else max(int(np.argmin(finite)), 1)
    rows = model.form.inputs(first, record)[:end]
    return states[:end], model.form.at_samples(model.numbers, states[:end], rows)


def labels_with_units(model: Model[MotionDynamics]) -> list[str]:
    """Return the labels of learned equations and outputs, with their units."""
    units = {channel.name: channel.unit for channel in model.outputs}
    return [with_unit(name, unit or units.get(name)) for name, unit in labels_of(model.form)]


def units_of(model: Model[MotionDynamics]) -> dict[str, str]:
    """Return the units of states and inputs by name."""
    return {s.name: s.unit for s in model.form.motion.states} | {
        c.name: c.unit for c in model.inputs
    }


def curve_limits(curve: Curve, k: int, cloud: Vector) -> tuple[float, float]:
    """Return the limits of the panel of output k: of the cloud, and the curve within the data."""
    both = np.concatenate([curve.learned[curve.inside, k], cloud])
    low, high = float(np.nanmin(both)), float(np.nanmax(both))
    margin = 0.15 * max(high - low, 1e-12)
    return low - margin, high + margin
