"""Bias of a motion's parameters by terms that its equations may lack, and the evidence for them.

The free run answers for what the fit determines: a term moves these parameters by its normal
equations (`free_run_equations`). Along the directions that the learner could imitate the nearest
physics decides, so that there a term moves p̂ by what the measure makes of it (`bias`), with the
slopes ∂f/∂q of the learned equations over the measure's points for Φ.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from orthaug._base.checks import Matrix, Vector, check_type
from orthaug.analysis.absorbed import complementary_parameters
from orthaug.analysis.bias import (
    ResidualStep,
    SuspectedBias,
    TermResponse,
    bias_table,
    has_term,
    seen_table,
)
from orthaug.analysis.bias_hull import MOST_PHYSICS
from orthaug.analysis.catalogue import RIVALS, Catalogue, soften_jumps
from orthaug.analysis.causes import AS_CLOSE, CLOSE, MOST_POINTS, SURE_SHARE, Considered
from orthaug.analysis.free_run_equations import FreeRunPoint, TermEquations, respond_to
from orthaug.analysis.learned_part import learned_reach
from orthaug.analysis.rival_forms import Forms
from orthaug.analysis.robustness import block_of
from orthaug.analysis.suspects import MotionSuspect, check_motion_suspects
from orthaug.fitting.field_points import field_under
from orthaug.fitting.motion_estimate import MotionEstimate
from orthaug.fitting.motion_task import MotionTask
from orthaug.fitting.structures import Structure
from orthaug.inference.covariance import reach
from orthaug.inference.linearization import Linearization
from orthaug.inference.splitting import (
    Field,
    MotionSplit,
    learned_places,
    shared_of_motion,
    slopes_at,
)
from orthaug.models.motion_field import parts_at
from orthaug.physics.motion import Motion
from orthaug.physics.projection import Projection
from orthaug.physics.shared import SharedDirections, moves
from orthaug.physics.suspected_motion import equations_of, factor_of

_SAME = 1e-6  # of its size: what a term may change over a move that the learner does not see
# Of the learned equations: a learner that is smaller, and biases nothing, found nothing
_NOTHING = 0.01
_ALMOST_GONE = 1e-6  # of a coefficient: what only shapes its term has no effect then
_UNMOVED = 0.1  # standard errors of every parameter


@dataclass(frozen=True, eq=False)
class MotionTerms:
    """Terms that a motion may lack, by its free run and the points of p̂'s split (`TermPhysics`).

    Args:
        q: coordinates of p̂; those in `shared` directions come from the nearest physics.
        field: the measure's points.
        learned: the learner (M, nl) there beside p̂; None before a fit, and without one.
        unknown: parameters that no output determines: a term does anything to them.
    """

    place: FreeRunPoint
    q: Vector
    shared: SharedDirections
    field: Field
    learned: Matrix | None = None
    unknown: tuple[str, ...] = ()
    slope: Matrix | None = None
    """How p̂ follows (c, w) of a fit (np, np + nw); None where that is not known."""
    fit: MotionEstimate | None = None

    physical = map = None

    @property
    def motion(self) -> Motion:
        return self.place.segmented.problem.motion

    @property
    def learns(self) -> bool:
        """True if there is a learner."""
        return self.place.segmented.bound.learns

    @property
    def names(self) -> tuple[str, ...]:
        return self.motion.names

    @property
    def value(self) -> Vector:
        return self.motion.coordinates.physical(self.q)

    @property
    def slopes(self) -> Vector:
        slopes = self.motion.coordinates.slopes(self.q)
        return np.where(np.isin(self.names, self.unknown), np.nan, slopes)

    @property
    def bounds(self) -> Matrix:
        return np.array([[p.min, p.max] for p in self.motion.parameters])

    @property
    def memory(self) -> tuple[str, ...]:
        return self.motion.memory

    @property
    def certifies(self) -> bool:
        return len(self.field.x) <= MOST_POINTS

    @property
    def linearization(self) -> Linearization:
        return self._linearization

    @cached_property
    def _linearization(self) -> Linearization:
        form, field = self.place.segmented.dynamics.physics_only, self.field
        slopes = np.asarray(slopes_at(form, self.q, field.x, field.u))
        rows = self.weigh(np.moveaxis(slopes[:, learned_places(self.motion)], 2, 0))
        learner = None if self.learned is None else self.weigh(self.learned)
        return Linearization(Projection.factor(rows.transpose(1, 2, 0)), self.shared.basis, learner)

    def weigh(self, rows: np.ndarray) -> np.ndarray:
        """Return rows (M, nl) times the root of their weights over their sizes.

        What drives the learner's own states counts as nothing: the physics has no part in it.
        """
        motion = self.motion
        memory = [i for i, state in enumerate(motion.states) if state.memory]
        own = ~np.isin(learned_places(motion), memory)
        return rows * own * np.sqrt(self.field.weight)[:, None] / self.field.size

    def usual(self) -> list[MotionSuspect]:
        """Return the usual suspects that the physics does not have, with widths from the run."""
        motion = self.motion
        x, u = self._run
        found = Catalogue.of_motion(motion, motion.initial, x, u, self._seen).usual()
        if not len(x):
            return list(found)
        x, u = spread(x), spread(u)
        slopes = self._slopes(self.q, x, u)
        if not np.isfinite(slopes).all():
            return list(found)
        jacobian, equations = Projection.factor(slopes), range(slopes.shape[1])

        def known(suspect: MotionSuspect) -> bool:
            values = suspect.values(motion, self.value, x, u)[:, None]
            return has_term(jacobian, values * np.isin(equations, suspect.place(motion)))

        return [suspect for suspect in found if not known(suspect)]

    @cached_property
    def _run(self) -> tuple[Matrix, Matrix]:
        """States (M, nx) and inputs (M, nu) of the free run, where they are finite."""
        place = self.place
        segmented = place.segmented if len(place.w) else place.segmented.physics_only
        x, u = segmented.trajectory(place.c, place.w, place.states)
        there = np.isfinite(x).all(axis=1)
        return x[there], u[there]

    def _slopes(self, q: Vector, x: Matrix, u: Matrix) -> Float[np.ndarray, "m r np"]:
        """Return ∂(f, h)/∂q of the physics at points."""
        return np.asarray(slopes_at(self.place.segmented.dynamics.physics_only, q, x, u))

    def forms(self, selected: int) -> Forms[MotionSuspect] | None:
        """Return other forms of the term of a parameter, on all states and inputs.

        None where it acts in several equations.
        """
        motion, x, u = self.motion, *map(spread, self._run)
        if motion.functions is not None or not len(x):
            return None
        slopes = self._slopes(self.q, x, u)
        acts = np.flatnonzero(np.any(slopes[:, :, selected], axis=0))
        if len(acts) != 1:
            return None
        place = equations_of(motion)[acts[0]]
        named = (*motion.names_of_states, *motion.inputs)
        read = [name for name in named if name in motion.visible]
        features = [*map(str, motion.differences), *read]
        catalogue = Catalogue.of_motion(motion, self.value, x, u, features)
        catalogue = replace(catalogue, places=(place,))
        every = (*catalogue.usual(), *catalogue.products_of(read), *catalogue.families(RIVALS))
        values = np.stack([form.values(motion, self.value, x, u) for form in every], axis=1)
        factor = self._factor(selected)
        if factor is not None:
            by = MotionSuspect("factor", factor, place).values(motion, self.value, x, u)
            values = by[:, None] * values
        others = ~self.shapes(selected)
        others[selected] = False
        here = slopes[:, acts[0]]
        return Forms(every, values, here[:, others], here[:, selected], linear=False)

    def with_forms(self, selected: int, forms: Sequence[MotionSuspect]) -> TermEquations:
        """Return the normal equations of the free run with further forms of a term."""
        factor = self._factor(selected)
        if factor is not None:
            forms = [replace(f, expression=f"({factor})*({f.expression})") for f in forms]
        return respond_to(self.place, tuple(form.term(self.motion) for form in forms))

    def _factor(self, selected: int) -> str | None:
        """Return what multiplies a term in its equation: 1/L of `(u - s*x**3)/L`.

        None where it stands by itself.
        """
        name = self.names[selected]
        for expression in self.motion.equations.values():
            found = factor_of(expression.text, name)
            if found is not None:
                return found
        return None

    def shapes(self, selected: int) -> Bool[np.ndarray, "np"]:
        """Return a mask of the parameters that have no effect where that one is nearly 0."""
        x, u = map(spread, self._run)
        p = self.value.copy()
        p[selected] *= _ALMOST_GONE
        gone = self.motion.coordinates.of(p)
        size, left = (np.linalg.norm(self._slopes(q, x, u), axis=(0, 1)) for q in (self.q, gone))
        found = left <= np.sqrt(_ALMOST_GONE) * size
        found[selected] = False
        return found

    @cached_property
    def catalogue(self) -> Catalogue:
        """The terms that no one named, with widths from the points of the measure."""
        field = self.field
        return Catalogue.of_motion(self.motion, self.value, field.x, field.u, self._seen)

    @property
    def _seen(self) -> list[str]:
        return [entry.text for entry in self.place.segmented.problem.features]

    def equation(self, suspect: MotionSuspect) -> str:
        return equations_of(self.motion)[suspect.place(self.motion)]

    def values(self, suspect: MotionSuspect) -> Matrix:
        """Return the term in the learned equations, 0 where it acts elsewhere or has no value."""
        learned, place = learned_places(self.motion), suspect.place(self.motion)
        rows = np.zeros((len(self.field.x), len(learned)))
        if place in learned and suspect.memory is None:
            found = suspect.values(self.motion, self.value, self.field.x, self.field.u)
            rows[:, learned.index(place)] = found
        return self.weigh(np.where(np.isfinite(rows), rows, 0.0))

    def respond(self, suspects: Sequence[MotionSuspect], *, run: bool) -> list[TermResponse] | None:
        """Return the responses by the linearised free run, or by the measure alone."""
        if not run:
            held, nothing = map(self.values, suspects), np.zeros(len(self.q))
            return [
                TermResponse(nothing, one, True, effect=(None, float(np.linalg.norm(one))))
                for one in held
            ]
        response = respond_to(self.place, tuple(suspect.term(self.motion) for suspect in suspects))
        if not np.isfinite(response.information).all() or not np.isfinite(response.gradient).all():
            return None
        seen = self.sees(suspects)
        residuals: list[ResidualStep | None] = [None] * len(suspects)
        # What the learner sees it has taken from the residual
        if self.fit is not None and not all(seen):
            steps = block_of(self.fit) if self.fit.plain_covariance is not None else None
            residuals = residual_steps(response, self.fit.effective_weights, steps)
        rows = enumerate(zip(suspects, seen, residuals, strict=True))
        return [self._response(response, k, *row) for k, row in rows]

    def _response(
        self,
        response: TermEquations,
        k: int,
        suspect: MotionSuspect,
        seen: bool | None,
        residual: ResidualStep | None,
    ) -> TermResponse:
        effect = response.cosine(k), response.size(k)
        trained, basis = bool(len(self.place.w)), self.shared.basis
        apart = np.zeros(len(self.q), dtype=bool)
        if not trained:  # a learner that is not may hold all along shared directions
            apart = ~np.isin(np.arange(len(self.q)), complementary_parameters(basis))
        moved, dw = response.moved(k, apart)
        if not self.learns:
            return TermResponse(moved, None, None, effect=effect, residual=residual)
        delta = self.values(suspect)
        certified = delta if basis.shape[1] and self.certifies and np.any(delta) else None
        if seen:
            return TermResponse(np.zeros(len(moved)), delta, True, certified, effect=effect)
        held = self.weigh(response.held(dw, self.field.x, self.field.u))
        by_split = None
        if trained and self.slope is not None:
            by_split = self.slope @ np.concatenate([moved, dw])
        return TermResponse(moved, held, False, certified, by_split, effect, residual)

    def expected_shifts(self, bias: Vector) -> None:
        return None

    def considered(
        self, declared: Sequence[MotionSuspect], named: Sequence[SuspectedBias] | None = None
    ) -> Iterator[Considered]:
        """Yield the declared suspects, then the usual ones that the learner sees beside them.

        Families and smooth forms of friction are tried both times: a motion's term is declared for
        its size, which another form would change, so that nine tenths are enough for it only then.
        """
        if named is None:
            named = bias_table(self, declared)
        soft, families = self.softened(declared), self.families()
        close = (AS_CLOSE, CLOSE)
        options: dict[str, Any] = {"close": close, "joint": True, "seen_only": True}
        options["families"] = families
        if named:
            yield Considered(named, soft, enough=SURE_SHARE, **options)
        usual, softer = self.usual_biases()
        yield Considered((*named, *usual), (*soft, *softer), **options)

    def softened(self, suspects: Sequence[MotionSuspect]) -> list[SuspectedBias]:
        """Return the biases by smooth forms of the friction among the suspects.

        Widths follow the size of the variable. Nothing without a learner: it alone shows the shape
        of what is missing.
        """
        if self.learned is None:
            return []
        smooth = soften_jumps(suspects, self.motion, self.value, self.field.x, self.field.u)
        return bias_table(self, smooth)

    def usual_biases(self) -> tuple[list[SuspectedBias], list[SuspectedBias]]:
        """Return the biases by usual terms that nobody declared, and by their smooth forms.

        Only terms that the learner sees count: others are no likely cause. There is none where the
        learner could imitate no change of a parameter.
        """
        if self.learned is None or not self.shared.basis.shape[1]:
            return [], []
        usual = self.usual()
        seen = [one for one, sees in zip(usual, self.sees(usual), strict=True) if sees]
        smooth = soften_jumps(seen, self.motion, self.value, self.field.x, self.field.u)
        table = bias_table(self, (*seen, *smooth))  # one program for all
        return table[: len(seen)], table[len(seen) :]

    def families(self) -> list[SuspectedBias]:
        """Return the biases by every member of a family that the learner sees.

        Nothing where it could imitate no parameter.
        """
        if self.learned is None or not self.shared.basis.shape[1]:
            return []
        table = seen_table(self, self.catalogue.families())
        return [entry for entry in table if (entry.physics_cosine or 0.0) <= MOST_PHYSICS]

    def parts(self) -> list[tuple[str | None, MotionTerms]]:
        """Return the learner as one part: its equations share parameters (`Considered.joint`)."""
        return [(None, self)]

    def is_negligible(self, bias: Vector) -> bool:
        """Return whether the learner is tiny, and biases by little more than nothing."""
        fit = self.fit
        if fit is None or self.learned is None or (fit.split_by.share or 0.0) >= _NOTHING:
            return False
        return not np.any(np.abs(bias) > _UNMOVED * fit.known_std)

    def noise_share(self) -> float:
        """Return ν, the share of noise in the learner, by the band of the learned curve."""
        fit, own = self.fit, np.asarray(self.linearization.unshared_learner)
        half = None if fit is None else learned_reach(fit, self.field.x, self.field.u)
        if fit is None or half is None or not np.isfinite(half).all():
            return 0.0
        noise = np.sum(self.weigh(half / reach(fit.freedom)) ** 2)
        return float(noise / max(np.sum(own**2), np.finfo(float).tiny))

    def remedies(self, cause: SuspectedBias, biased: Sequence[str]) -> list[str]:
        """Return no remedies: other inputs or measures would need another free run."""
        return []

    def sees(self, suspects: Sequence[MotionSuspect]) -> list[bool | None]:
        """Return whether each acts where the learner does, and is a function of its inputs."""
        return [self._sees(suspect) if self.learns else None for suspect in suspects]

    def _sees(self, suspect: MotionSuspect) -> bool:
        hidden = suspect.memory is not None  # a function of the past is none of one sample
        if hidden or suspect.place(self.motion) not in learned_places(self.motion):
            return False
        start, end = self._moves
        p, nx = self.value, len(self.motion.states)
        pairs = np.stack(
            [suspect.values(self.motion, p, x[:, :nx], x[:, nx:]) for x in (start, end)]
        )
        there: Any = np.isfinite(pairs).all(axis=0)
        pairs = pairs[:, there]
        size = np.sqrt(np.mean(pairs**2)) if pairs.size else 0.0
        return bool(np.abs(pairs[1] - pairs[0]).max(initial=0.0) <= _SAME * size)

    @cached_property
    def _moves(self) -> tuple[Matrix, Matrix]:
        """Pairs of points that the learner does not distinguish."""
        points = np.concatenate([self.field.x, self.field.u], axis=1)
        return moves(self.place.segmented.dynamics.features_of, points)


def spread(rows: np.ndarray) -> np.ndarray:
    """Return rows at even distances, `MOST_POINTS` at most."""
    if len(rows) <= MOST_POINTS:
        return rows
    return rows[np.unique(np.linspace(0, len(rows) - 1, MOST_POINTS).astype(int))]


def residual_steps(
    response: TermEquations, used: float, steps: int | None
) -> list[ResidualStep | None]:
    """Return the effect of every term on the residual, with standard errors.

    They hold for coloured errors where `steps` is given.

    Args:
        used: weights that the fit used.
    """
    whole, noise = response.squares()
    free = max(response.place.segmented.residuals - response.parameters - used, 1.0)
    middle = (
        None if steps is None else response.scores().middle(steps, response.parameters + used)[0]
    )
    found: list[ResidualStep | None] = []
    for k in range(response.terms):
        step = response.step(k)
        if step is None or not whole > 0:
            found.append(None)
            continue
        coefficient, fall, row = step
        variance = (
            whole / free * float(row @ response.information @ row)
            if middle is None
            else row @ middle @ row
        )
        std = float(np.sqrt(variance)) if variance > 0 else None
        shares = min(fall / whole, 1.0), float(np.clip((whole - noise - fall) / whole, 0.0, 1.0))
        found.append(
            ResidualStep(coefficient, std, None if std is None else coefficient / std, *shares)
        )
    return found


def suspected_bias(fit: MotionEstimate, suspects: Sequence[MotionSuspect]) -> list[SuspectedBias]:
    """Return the bias of a fitted motion's parameters by terms that its equations may lack.

    Raises:
        InputError: suspects that the motion cannot have, or a fit of difference equations.
    """
    check_type(
        fit,
        MotionEstimate,
        "fit",
        "a fit of equations of motion (for difference equations use `bias_budget`)",
    )
    check_motion_suspects(suspects, fit.problem)
    terms = linearize_fit(fit)
    return [] if terms is None else bias_table(terms, suspects)


def linearize_fit(fit: MotionEstimate) -> MotionTerms | None:
    """Return the linearization of a fitted motion under the measure that it was split under.

    None where it has no normal equations, or where the gain of a predictor would move with them.
    """
    place = FreeRunPoint.of(fit)
    if not fit.status.ok or place is None or fit.model.coloured:
        return None
    field, learned = fit.split_by.field, None
    if fit.learns:
        learned = parts_at(fit.model.form, fit.model.numbers, field.x, field.u)[1]
        learned = np.where(np.isfinite(learned), learned, 0.0)
    unknown = (*fit.unidentified, *fit.at_bound)
    own = (place, fit.theta, fit.shared, field, learned, unknown, fit.split_by.slope)
    return MotionTerms(*own, fit)


def linearize_physics(task: MotionTask, structure: Structure) -> MotionTerms | None:
    """Return the linearization of physics without a learner, for a learner of the task's features.

    None where it has no run.
    """
    if task.physics is None:
        return None
    segmented, point = task.plan, task.physics.end.point
    form, names = segmented.dynamics, segmented.problem.motion.names
    weights = np.zeros(0)
    place = FreeRunPoint(
        segmented, point.theta, weights, point.states, task.physics.objective.weight
    )
    none = MotionSplit.empty("training", form, point.theta)
    if not segmented.bound.learns:
        return MotionTerms(place, point.theta, none.shared, none.field)
    field = field_under(
        structure.measure,
        segmented.physics_only,
        segmented.physics_only.numbers(point.theta, weights),
        point.states,
    )[0]
    if structure.shared == "all":
        return MotionTerms(place, point.theta, SharedDirections(names, np.eye(len(names))), field)
    return MotionTerms(
        place, point.theta, shared_of_motion(form, point.theta, field.x, field.u), field
    )
