"""A problem whose rows stay in a source: training passes over its partitions.

Three passes: a survey of sizes and ranges, a tree QR of `[Φ Y]`, and a second QR of the rows that
the first one gives. The second makes Q orthonormal to rounding however ill-conditioned Φ is, as
Householder's does in memory. A subsample of the rows stays in memory for everything that only looks
at the data.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

import numpy as np
import scipy.linalg
from jaxtyping import Float

from orthaug._base.checks import Matrix, Vector
from orthaug._base.errors import InputError
from orthaug.data.record import Experiment, Record
from orthaug.data.regressors import Features, Layout, UsableRows, lag_matrix, largest_lag
from orthaug.data.sources import Partition, Source
from orthaug.physics.baseline import Baseline
from orthaug.physics.excitation import excitation, require_rank
from orthaug.physics.moments import Extent, Moments
from orthaug.physics.output_weights import OutputWeights, weigh_outputs
from orthaug.physics.problem import Problem, pose
from orthaug.physics.projection import Projection, powers_of_two
from orthaug.physics.row_checks import check_moving, check_physics, check_sizes, feature_rows

Passes = Callable[[Callable[[Partition], Any], Sequence[Partition]], list[Any]]
"""`[function(partition) for partition in partitions]`, wherever that is done."""


@dataclass(frozen=True, eq=False)
class Form:
    """Rules by which a piece of a source becomes rows; picklable if the baseline is."""

    baseline: Baseline
    features: Features
    layout: Layout
    empty: Record
    """Channels and sampling time; its experiment has no rows."""

    @property
    def outputs(self) -> tuple[str, ...]:
        return tuple(channel.name for channel in self.empty.outputs)

    @property
    def lead(self) -> int:
        """Rows of history that a row needs."""
        return largest_lag(self.layout)

    def pose_pieces(
        self, partition: Partition
    ) -> Iterator[tuple[Experiment, UsableRows, np.ndarray, np.ndarray]]:
        """Return the pieces with their rows, Φ (m, ny, nθ) and sums of the fixed terms (m, ny)."""
        for piece in partition.pieces(self.lead):
            if len(piece) <= self.lead:
                continue
            x = lag_matrix(piece, self.layout, self.empty, self.lead)
            rows = UsableRows(x, piece.outputs[self.lead :], self.layout, self.lead)
            yield piece, rows, *self.baseline.on(x, self.layout, self.outputs)

    def check_features(
        self, piece: Experiment, rows: UsableRows, phi: np.ndarray, known: np.ndarray
    ) -> Matrix:
        """Return the learner's features (m, nz), after a check that all values are finite."""
        alone = replace(self.empty, experiments=(piece,))
        check_physics(phi, known, self.baseline, rows, alone)
        return feature_rows(self.features, rows, self.layout, alone)


class Survey(NamedTuple):
    """Sizes and ranges of the rows."""

    channels: Extent
    """Of outputs, then inputs, over all rows."""
    features: Extent
    columns: Vector
    """Largest entry of each column of Φ (nθ,), in the outputs' units."""
    outputs: Moments
    target: Moments

    def __or__(self, other: Survey) -> Survey:
        columns = np.maximum(self.columns, other.columns)
        return Survey(
            self.channels | other.channels,
            self.features | other.features,
            columns,
            self.outputs | other.outputs,
            self.target | other.target,
        )


@dataclass(frozen=True, eq=False)
class PartitionSurvey:
    """The survey of a partition; everything in it is checked to be finite."""

    form: Form

    def __call__(self, partition: Partition) -> Survey | None:
        found = None
        for piece, rows, phi, known in self.form.pose_pieces(partition):
            z = self.form.check_features(piece, rows, phi, known)
            seen = Survey(
                Extent.of(np.concatenate([piece.outputs, piece.inputs], axis=1)),
                Extent.of(z),
                np.abs(phi).max(axis=(0, 1), initial=0.0),
                Moments.of(rows.y),
                Moments.of(rows.y - known),
            )
            found = seen if found is None else found | seen
        return found


@dataclass(frozen=True, eq=False)
class Factoring:
    """R of `[Φ Y]`, columns scaled, outputs whitened."""

    form: Form
    weight: OutputWeights
    scale: Vector

    def __call__(self, partition: Partition) -> Matrix:
        n = len(self.scale) + 1
        r = np.zeros((0, n))
        for _, rows, phi, known in self.form.pose_pieces(partition):
            columns = self.weight.rows(phi).reshape(-1, n - 1) * self.scale
            target = self.weight.rows(rows.y - known).reshape(-1, 1)
            r = _triangle([r, np.concatenate([columns, target], axis=1)])
        return r


class SecondQR(NamedTuple):
    """Result of the second QR: R of `[Q₁ e₁]`, the moments of e₁, `Σ ‖q_ki‖²` of each output."""

    r: Matrix
    errors: Moments
    freedom: Vector


@dataclass(frozen=True, eq=False)
class Basis:
    """Rows of Q: `(Φ scale R₁⁻¹) turn`, with `turn = R₂⁻¹` of the second QR.

    Two products, not one: what rounding does in the first is in the second QR.
    """

    form: Form
    weight: OutputWeights
    inverse: Matrix
    """`scale R₁⁻¹`."""
    turn: Matrix

    def rows(self, phi: np.ndarray) -> Float[np.ndarray, "m ny nt"]:
        columns = np.moveaxis(self.weight.rows(phi), 0, -1)  # as they are in memory
        return np.moveaxis(self.turn.T @ (self.inverse.T @ columns), -1, 0)

    def left(self, target: Matrix, q: np.ndarray, coordinates: Vector) -> Matrix:
        """Return the residual of a target (m, ny) after the rows of Q at these coordinates.

        In whitened outputs.
        """
        return self.weight.rows(target) - (coordinates @ np.moveaxis(q, 0, -1)).T


@dataclass(frozen=True, eq=False)
class PartitionQR:
    """The second QR of a partition, and the residual of the physics."""

    basis: Basis
    coordinates: Vector

    def __call__(self, partition: Partition) -> SecondQR | None:
        basis, found, nt = self.basis, None, len(self.coordinates)
        for _, rows, phi, known in basis.form.pose_pieces(partition):
            q = basis.rows(phi)
            e = basis.left(rows.y - known, q, self.coordinates)
            r = _triangle([np.concatenate([q.reshape(-1, nt), e.reshape(-1, 1)], axis=1)])
            seen = SecondQR(r, Moments.of(e), np.sum(q**2, axis=(0, 2)))
            found = seen if found is None else _join_factors(found, seen)
        return found


def _join_factors(one: SecondQR, other: SecondQR) -> SecondQR:
    return SecondQR(
        _triangle([one.r, other.r]), one.errors | other.errors, one.freedom + other.freedom
    )


def _triangle(blocks: Sequence[Matrix]) -> Matrix:
    """Return R of stacked blocks of rows, its diagonal not negative."""
    r = np.asarray(np.linalg.qr(np.concatenate(blocks), mode="r"))
    return r * np.where(np.diag(r) < 0, -1.0, 1.0)[:, None] if len(r) == r.shape[1] else r


def _merge(parts: Sequence[Any], merge: Callable[[Any, Any], Any]) -> Any:
    """Return the sum of neighbours two by two, and so on.

    This order does not depend on which part was ready first.
    """
    parts = [part for part in parts if part is not None]
    while len(parts) > 1:
        parts = [
            merge(*parts[i : i + 2]) if i + 1 < len(parts) else parts[i]
            for i in range(0, len(parts), 2)
        ]
    return parts[0] if parts else None


@dataclass(frozen=True, eq=False)
class RowBuilder:
    """Rows of a piece for training: scaled features, Q, P⊥Y and the learner's gain, (m, …) each."""

    basis: Basis
    coordinates: Vector
    centre: Vector
    halfwidth: Vector
    rms: float
    gain: Matrix

    def __call__(
        self, partition: Partition
    ) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]]:
        form = self.basis.form
        for _, rows, phi, known in form.pose_pieces(partition):
            q = self.basis.rows(phi)
            e = self.basis.left(rows.y - known, q, self.coordinates) / self.rms
            z = (
                np.asarray(form.features.evaluate(rows.x, form.layout, np))
                if len(self.centre)
                else rows.x[:, :0]
            )
            yield (
                (z - self.centre) / self.halfwidth,
                q,
                e,
                np.broadcast_to(self.gain, (*e.shape, e.shape[1])),
            )


@dataclass(frozen=True, eq=False, kw_only=True)
class StreamedProblem(Problem):
    """A problem of a source.

    `record`, `rows` and the rows of `projection` are those of its subsample.

    `passes` makes passes over the source. `moments` are those of what the physics leaves, in
    whitened outputs.
    """

    source: Source
    passes: Passes
    survey: Survey
    basis: Basis
    solution: tuple[Vector, Vector]
    """θ̂ of physics alone and its coordinates QᵀY."""
    moments: Moments
    freedom: Vector

    streamed: ClassVar[bool] = True

    def __repr__(self) -> str:
        return super().__repr__().replace(f"{len(self.rows)} rows", f"{self.count} rows", 1)

    @property
    def count(self) -> int:
        return self.moments.count

    @property
    def least_squares(self) -> Vector:
        return self.solution[0]

    @property
    def target_coordinates(self) -> Vector:
        return self.solution[1]

    @property
    def freedom_used(self) -> Vector:
        return self.freedom

    @property
    def unexplained_moments(self) -> Moments:
        return self.moments

    @property
    def target_covariance(self) -> Matrix:
        return self.survey.target.covariance

    @property
    def largest_output(self) -> Vector:
        extent = self.survey.channels
        return np.maximum(np.abs(extent.low), np.abs(extent.high))[: len(self.outputs)]

    @cached_property
    def feature_range(self) -> Float[np.ndarray, "2 nz"]:
        extent = self.survey.features
        if self.features != self.basis.form.features:
            form = replace(self.basis.form, features=self.features)
            extent = _survey(form, self.source, self.passes).features
        return np.stack(extent)

    def row_builder(
        self, centre: Vector, halfwidth: Vector, rms: float, gain: Matrix
    ) -> RowBuilder:
        """Return the builder of its rows for training."""
        basis = replace(self.basis, form=replace(self.basis.form, features=self.features))
        return RowBuilder(basis, self.target_coordinates, centre, halfwidth, rms, gain)

    def physics_alone(self) -> Problem:
        alone = super().physics_alone()
        return (
            alone
            if isinstance(alone, StreamedProblem)
            else stream_problem(alone, self.source, self.passes)
        )

    def weigh(self, weight: OutputWeights) -> Problem:
        if weight is self.weight:
            return self
        return _factorise(
            replace(self, weight=weight), self.source, self.passes, self.survey, self.basis.form
        )


def _survey(form: Form, source: Source, passes: Passes) -> Survey:
    found = _merge(passes(PartitionSurvey(form), source.partitions), Survey.__or__)
    if found is None:
        raise InputError(
            "no experiment has enough rows for a single prediction: the largest lag is "
            f"{form.lead}, so at least {form.lead + 1} are needed."
        )
    return found


def pose_streamed(
    source: Source,
    record: Record,
    passes: Passes,
    baseline: Baseline,
    *args: Any,
    **options: object,
) -> Problem:
    """Return the problem of a source, with a subsample `record` of it in memory.

    The arguments are those of `pose`.

    Raises:
        InputError: as `pose`, wherever in the source it is; RankError.
    """
    require = options.pop("require_full_rank", True)
    seen = pose(record, baseline, *args, **options, require_full_rank=False)
    found = stream_problem(seen, source, passes)
    if require:
        require_rank(found.excitation, found.count * len(found.outputs))
    return found


def stream_problem(seen: Problem, source: Source, passes: Passes) -> StreamedProblem:
    """Return the problem of a source, from the problem of a subsample of it."""
    empty = replace(seen.record, experiments=(seen.record.experiments[0].rows(0, 0),))
    form = Form(seen.baseline, seen.features, seen.layout, empty)
    survey = _survey(form, source, passes)
    check_moving(survey.channels, empty, seen.layout)
    deviation = np.sqrt(np.diag(survey.outputs.covariance))
    check_sizes(deviation, np.sqrt(np.diag(survey.target.covariance)))
    deviation = np.where(deviation > 0, deviation, 1.0)
    weight = seen.weight
    if weight.kind != "covariance":
        weight = weigh_outputs("none" if weight.kind == "none" else weight.choice, deviation)
    return _factorise(
        replace(seen, deviation=deviation, weight=weight), source, passes, survey, form
    )


def _factorise(
    seen: Problem, source: Source, passes: Passes, survey: Survey, form: Form
) -> StreamedProblem:
    """Return the factor in two passes: R of `[Φ Y]`, then R of the resulting Q."""
    weight, nt = seen.weight, len(seen.baseline.names)
    scale = powers_of_two(survey.columns * np.abs(weight.matrix).max())
    first = _merge(
        passes(Factoring(form, weight, scale), source.partitions), lambda a, b: _triangle([a, b])
    )
    r, coordinates = first[:nt, :nt], first[:nt, nt]
    excited = excitation(r, seen.baseline.names)
    ready = excited.full_rank and len(r) == nt
    if not ready:  # `check` raises; nothing can be solved
        r, coordinates = np.eye(nt), np.zeros(nt)
    inverse = scale[:, None] * scipy.linalg.solve_triangular(r, np.eye(nt)) if nt else r
    basis = Basis(form, weight, inverse, np.eye(nt))
    second = _merge(passes(PartitionQR(basis, coordinates), source.partitions), _join_factors)
    turn, rest = (second.r[:nt, :nt], second.r[:nt, nt]) if ready else (np.eye(nt), np.zeros(nt))
    back = np.linalg.inv(turn)
    basis = replace(basis, turn=back)
    theta = inverse @ (coordinates + back @ rest)
    phi, _ = seen.baseline.on(seen.rows.x, seen.layout, seen.outputs)
    own = {field.name: getattr(seen, field.name) for field in fields(Problem)}
    own |= {
        "projection": Projection(turn @ r, scale, weight.rows(phi), basis.rows(phi)),
        "excitation": excited,
    }
    return StreamedProblem(
        **own,
        source=source,
        passes=passes,
        survey=survey,
        basis=basis,
        solution=(theta, turn @ coordinates + rest),
        moments=second.errors,
        freedom=second.freedom,
    )
