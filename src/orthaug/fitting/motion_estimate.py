"""The result of a motion's estimation: physical parameters with intervals, model."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import pairwise
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from jaxtyping import Bool, Float

from orthaug._base.checks import Matrix, Vector, check_type
from orthaug._base.errors import Warning
from orthaug._base.lines import join_words
from orthaug.data.record import Record
from orthaug.fitting.estimates import Estimate
from orthaug.fitting.field_points import field_under, wobble
from orthaug.inference.measures import Measure, Training
from orthaug.inference.nearly_shared import enlarge_covariance
from orthaug.inference.splitting import (
    MotionSplit,
    learned_places,
    slopes_at,
    split_motion,
)
from orthaug.models.model import Model
from orthaug.models.motion_field import parts_at
from orthaug.models.moving import MotionDynamics
from orthaug.models.statistics import JointCovariance, Statistics, column_units
from orthaug.physics import ill_conditioned
from orthaug.physics.excitation import Excitation, of_gram
from orthaug.physics.problem import MotionProblem
from orthaug.physics.projection import Projection
from orthaug.physics.shared import SharedDirections

if TYPE_CHECKING:
    from orthaug.fitting.segmented_motion import SegmentedMotion

# share of a parameter in directions that no output shows, above which it is not identified
_UNSEEN = 1e-3
_VAGUE = 1.0  # standard error of a logarithm above which only the order of magnitude is known
# times wider an interval without the prior of the weights: the prior is 3/4 of the information
_LEANING = 2.0
_ROUNDING = 1e-11  # of the largest eigenvalue of the information with unit columns


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class MotionEstimate(Estimate):
    """An `Estimate` of a motion, whose parameters are those of the nearest physics."""

    model: Model[MotionDynamics]
    problem: MotionProblem = field(repr=False)
    split_by: MotionSplit = field(repr=False)
    segmented: SegmentedMotion = field(repr=False)
    states: Any = field(repr=False)
    """The segments' starts, as estimated."""
    slope: Float[np.ndarray, "k m nx n"] | None = field(repr=False)
    """How they follow the unknowns (k, m, nx, n), less its sign; None where that is not known."""
    alone: Vector = field(repr=False)
    """The coordinates of physics alone, where the nearest physics is searched from."""
    unidentified: tuple[str, ...] = ()
    """Parameters that no output determines beside the learner, or only the prior of its weights."""

    _of_split: ClassVar[tuple[str, ...]] = (
        *Estimate._of_split,
        "ill_conditioned",
        "not_unique",
        "at_a_bound",
        "not_identified",
    )

    @property
    def excitation(self) -> Excitation:
        """Rank and condition of the parameters in the outputs of the fitted motion."""
        names, gram = self.problem.names, self.model.statistics.gram
        count = len(names)
        if gram is None:
            return Excitation(0, count, None, ())
        return of_gram(gram[:count, :count], names)

    @property
    def restarts_at(self) -> list[list[int]] | None:
        """First rows of the segments of an unstable plant, by experiment; None of a stable one."""
        begins = self.segmented.begins
        values = np.asarray(self.problem.values_at(np.asarray(self.theta)), dtype=float)
        whole = all(len(own) == 1 for own in begins)
        if whole or self.model.coloured or not self.problem.steps_to_leave(values):
            return None
        return begins

    @property
    def judged_record(self) -> Record:
        record, begins = self.problem.record, self.restarts_at
        if begins is None:
            return record
        pieces = [
            experiment.rows(first, last)
            for experiment, own in zip(record.experiments, begins, strict=True)
            for first, last in pairwise([*own, len(experiment)])
        ]
        return replace(record, experiments=tuple(pieces))

    @property
    def shared(self) -> SharedDirections:
        """The directions of the parameters' coordinates that the learner could imitate."""
        return self.split_by.shared

    def _more_columns(self) -> dict[str, Any]:
        names = self.problem.motion.names
        return {"shared": [name not in self.shared.untouched for name in names]}

    def split(self, measure: Measure, shared: str = "auto") -> MotionEstimate:
        """Return the same motion with p̂ under another measure over states and inputs.

        Nothing is trained again.

        Args:
            measure: such as `Uniform({"v": (-1, 1)})`, by the names of states and inputs.
            shared: "auto" for the directions that the learner could imitate, "all" for all.

        Raises:
            InputError: a measure that does not fit the motion.
        """
        check_type(measure, Measure, "measure", "a measure such as Uniform()")
        return self.split_by_measure(measure, shared)

    def split_by_measure(
        self, measure: Measure, shared: str, *, statistics: bool = True
    ) -> MotionEstimate:
        """Return the same motion with p̂ under a measure, and its `statistics` or p̂ alone."""
        form, segmented = self.model.form, self.segmented
        whole = self.model.numbers.unsplit
        field, support, warnings = field_under(measure, segmented, whole, self.states)
        moving = None
        if isinstance(measure, Training) and self.slope is not None and statistics:
            moving = partial(
                wobble,
                segmented.dynamics,
                whole.free,  # the run is within the limits, and its slopes take longer with them
                segmented.segments,
                self.states,
                self.slope,
                field.size,
            )
        bounds = self.problem.motion.coordinates.bounds
        options = {"everything": shared == "all", "wobble": moving, "statistics": statistics}
        split = split_motion(measure, form, whole, self.alone, field, bounds, **options)
        return self._with_split(replace(split, support=support, warnings=warnings))

    def _renewed(self) -> MotionEstimate:
        return self._with_split(self.split_by)

    def _with_split(self, split: MotionSplit, warnings: Sequence[Warning] = ()) -> MotionEstimate:
        """Return the estimate with p̂, intervals and warnings of a split."""
        q, names = split.theta, self.problem.names
        held = ~self.coordinates.inside(q) & ~np.isnan(q)
        values = zip(names, self.coordinates.physical(q), held, strict=True)
        at_bound = {name: float(value) for name, value, there in values if there}
        made = replace(self, split_by=split, at_bound=at_bound)
        unseen = made._unidentified_by(self.model.statistics)
        doubts = [*self._ill_conditioned(q), *_doubts(split, at_bound, unseen, self)]
        made = super(MotionEstimate, made)._with_split(split, (*doubts, *warnings))
        return replace(made, unidentified=unseen)

    def _ill_conditioned(self, q: Vector) -> list[Warning]:
        statistics, count = self.model.statistics, len(q)
        if statistics.gram is None or statistics.noise is None:
            return []
        gram = statistics.gram[:count, :count]
        return ill_conditioned.of_motion(self.problem, gram, q, statistics.noise)

    def _covariance_by(self, statistics: Statistics) -> Matrix | None:
        """Return Cov q̂, with NaN for the parameters that lack an interval."""
        covariance = super()._covariance_by(statistics)
        if covariance is None:
            return None
        lacking = {*self.at_bound, *self._unidentified_by(statistics)}
        places = [i for i, name in enumerate(self.problem.names) if name in lacking]
        covariance[places] = covariance[:, places] = np.nan
        return enlarge_covariance(covariance, statistics, self.shared)

    def _unidentified_by(self, statistics: Statistics) -> tuple[str, ...]:
        """Return the parameters that no output determines, or only the prior of the weights."""
        made, slope = self.free_covariance(statistics), self.split_by.slope
        if made is None or slope is None:
            return ()
        joint, moves = made
        std = np.sqrt(np.diag(joint.of(slope[:, moves])))
        wider = _wider_without_prior(joint, slope[:, moves])
        vague = self.coordinates.positive & (std > _VAGUE / wider)
        found = zip(self.problem.names, vague | (wider > _LEANING), strict=True)
        return tuple(name for name, hidden in found if hidden)

    def _moving(self, count: int) -> Bool[np.ndarray, "n"]:
        inside = self.coordinates.inside(np.asarray(self.model.numbers.c))
        return np.concatenate([inside, np.ones(count - len(inside), dtype=bool)])

    def moved_by(self, step: Vector) -> Vector:
        """Return by how much p̂ (np,) moves with a step of (c, w): the learner's split counts."""
        slope = self.split_by.slope
        assert slope is not None, "p̂ is not unique"
        return self.coordinates.slopes(self.theta) * (slope @ step)

    def _rows_of_split(self) -> tuple[Projection, Matrix | None, Matrix, Vector] | None:
        owner, field = self.segmented.recording_of_points(), self.split_by.field
        if not self.split_by.of_rows or len(field.x) % len(owner):
            return None
        motion = self.problem.motion
        slopes = np.asarray(
            slopes_at(self.segmented.dynamics.physics_only, self.theta, field.x, field.u)
        )[:, learned_places(motion)]
        unit = np.sqrt(field.weight)[:, None] / field.size
        values = parts_at(self.model.form, self.model.numbers, field.x, field.u)[1]
        projection = Projection.factor(slopes * unit[..., None])
        return projection, self.shared.basis, values * unit, owner

    def _heading(self) -> list[str]:
        motion, bound, form = self.problem.motion, self.model.form.bound, self.model.form
        seen = ", ".join(str(entry) for entry in form.features)
        learner, split = str(bound), []
        if self.learns:
            learner = (
                f"{bound.learner} of {seen}, {bound.size} weights, "
                f"{self.effective_weights:.1f} effective"
            )
            split = [
                f"shared      {shared_in_words(self.shared, self.unidentified)}",
                f"measure     {self.split_by.name}",
            ]
        steps = f"{form.substeps} substep{'s' * (form.substeps > 1)}"
        lines = [
            f"motion      {', '.join(motion.names_of_states)}; {motion.integrator}, {steps}, "
            f"{motion.hold} hold",
            f"learner     {learner}",
            f"data        {self.problem.record!r}",
            *self.status.lines,
            *split,
        ]
        return lines


def _wider_without_prior(joint: JointCovariance, slope: Matrix) -> Vector:
    """Return how many times wider intervals of K (c, w) are without the ridge on w (m,).

    Inf where the data do not determine them.

    Both for white noise: the question is where the information comes from.
    """
    gram = joint.gram
    unit = column_units(gram, joint.nt)
    values, vectors = np.linalg.eigh(gram * np.outer(unit, unit))
    hidden = vectors[:, values <= _ROUNDING * values.max(initial=0.0)]
    own = slope * unit
    share = np.linalg.norm(own @ hidden, axis=1) / np.maximum(np.linalg.norm(own, axis=1), 1e-300)
    white = replace(joint, middle=gram)
    with_prior, by_data = (
        np.sqrt(np.diag(one.of(slope))) for one in (white, replace(white, ridge=0.0))
    )
    wider = by_data / np.where(with_prior > 0, with_prior, 1.0)
    return np.where(share > _UNSEEN, np.inf, np.maximum(wider, 1.0))


def _doubts(
    split: MotionSplit, at_bound: Collection[str], unseen: tuple[str, ...], fit: MotionEstimate
) -> list[Warning]:
    warnings = []
    if split.slope is None:
        text = (
            "the distance between the fitted motion and the physics has no unique minimum near "
            "the estimate, so there are no intervals: several parameters could explain what the "
            "learner found."
        )
        warnings.append(Warning("not_unique", text))
    if at_bound:
        text = (
            f"at a bound: {', '.join(at_bound)}. A parameter at a bound has no interval, and "
            "the other estimates hold for this value of it. Where the data contradict a bound, "
            "the bound or the physics is wrong."
        )
        warnings.append(Warning("at_a_bound", text))
    if unseen:
        text = (
            f"not identified: {', '.join(unseen)}. Other values, with other weights of the "
            "learner, give nearly the same outputs, and only the prior of the weights decides, "
            "so there is no interval. Measure more, fix one of them as a constant, give the "
            "learner fewer inputs, or add it to fewer equations."
        )
        if not fit.learns:
            text = (
                f"not identified: {', '.join(unseen)}. Other values, with others of the other "
                "parameters, give nearly the same outputs, so there is no interval. Give some of "
                "them as constants, or record data that depend more on "
                f"{'it' if len(unseen) == 1 else 'them'}."
            )
        text += "".join(
            f" {p.name} went from {p.initial:.3g} to {value:.3g}, where no output depends on it: "
            "physics without its effect follows the data as well. Leave out its term, or bound it."
            for p, value, lost in zip(
                fit.coordinates.parameters,
                fit.coordinates.physical(split.theta),
                fit.coordinates.lost(split.theta),
                strict=True,
            )
            if lost and p.name in unseen
        )
        warnings.append(Warning("not_identified", text))
    return warnings


def shared_in_words(shared: SharedDirections, unidentified: Sequence[str] = ()) -> str:
    """Return the directions that the learner could imitate, in words.

    Args:
        unidentified: parameters that neither the fit nor the nearest physics determines.
    """
    if not shared.basis.size:
        if unidentified and set(shared.untouched) <= set(unidentified):
            return "nothing, but the data determine no parameter"
        excepted = f" but {join_words(unidentified)}" if unidentified else ""
        return f"nothing: the data determine all parameters{excepted}"
    if shared.all:
        return "all parameters: they are those of the physics nearest to the fitted motion"
    moved = [" with ".join(direction) for direction in shared.directions]
    determined = [name for name in shared.untouched if name not in unidentified]
    return (
        f"{'; '.join(moved)} (by the nearest physics); determined by the fit: "
        f"{', '.join(determined) or 'none'}"
    )
