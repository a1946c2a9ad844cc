"""Models of chosen terms: fitted on one step or on free runs, and simulated on held-out data.

One compiled program serves every choice (`Menu`). On the free run a term is weighed by what it does
to the run, not to one step: noise in measured lags does not count as structure, and what pays only
one step ahead is not picked.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from orthaug._base.checks import Matrix, Vector, positive
from orthaug._base.jax import Array, jax, jnp
from orthaug.data.expressions import Lag, parse
from orthaug.data.record import Experiment, Record
from orthaug.data.regressors import Features, in_order
from orthaug.data.terms import CONSTANT, TermLibrary, products_of
from orthaug.fitting.criteria import Criterion, Simulation
from orthaug.fitting.initial_states import InitialStates, Start
from orthaug.fitting.objective import (
    RUNAWAY,
    FreeRunObjective,
    LinearisedFreeRun,
    TrialPoint,
    errors_of,
)
from orthaug.fitting.segments import Segments, build_segments
from orthaug.fitting.solvers.damped_step import MARQUARDT
from orthaug.fitting.solvers.levenberg_marquardt import LevenbergMarquardt
from orthaug.models.dynamics import Numbers, Parts
from orthaug.models.lagged import LaggedDynamics
from orthaug.models.learners import nothing_learned
from orthaug.physics.problem import Problem
from orthaug.selection.forward import COLLINEAR, Equations

_PLACES = 32  # for terms in a compiled program; choices that need more take a multiple
_NARROW = (8, 16)  # places of programs that are worth being compiled besides, from so many rows on:
# Compiling takes 1 s, and a pass over 65,000 rows 0.012 s with 8 places and 0.04 s with 32
_MANY_ROWS = 20_000
_CHUNK = 4096  # rows
_SETTLED = 0.1  # of the loss: a step that lowers it by more may change the sensitivities
_TOLERANCE = 1e-4  # relative change of the loss: models are compared, not published


@dataclass(frozen=True)
class Menu(LaggedDynamics):
    """A lagged form with the factors as `features`, for `width` terms of up to `order` factors.

    `ŷ_k = φ(x_k)θ + Σ_j w_j t_j(x_k)`, the t_j products of few factors whose numbers come with the
    weights. So every choice of `width` terms runs by the same compiled programs. Of `Numbers`,
    `weights` are a pair: the factors' numbers (width, order) of each term, and its coefficient
    (width,). `halfwidth` are the factors' sizes. It has one output.
    """

    width: int = 0
    order: int = 1

    @property
    def unknowns(self) -> int:
        return len(self.baseline.names) + self.width

    def numbers(
        self, theta: Vector, products: np.ndarray, weights: Vector, sizes: Vector
    ) -> Numbers:
        """Return the model's numbers for coefficients (width,) of terms of scaled factors.

        The factors are divided by their `sizes`.
        """
        pair = (np.asarray(products), np.asarray(weights, dtype=float))
        return Numbers(
            np.asarray(theta), np.zeros(len(theta)), pair, np.zeros(len(sizes)), sizes, np.ones(1)
        )

    def terms(self, numbers: Numbers, x: Array) -> Any:
        """Return t (width,) at one regressor x (nx,)."""
        factors = self.features.evaluate(x, self.layout, jnp) / numbers.halfwidth
        return products_of(factors, numbers.weights[0], jnp)

    def at(self, numbers: Numbers, x: Array) -> Parts:
        return self._with_slopes(numbers, x)[0]

    def _with_slopes(self, numbers: Numbers, x: Array) -> tuple[Parts, Any]:
        """Return the prediction at x in parts, and ∂ŷ/∂(c, w) (1, n): it is linear in both."""
        phi = self.baseline.phi(x, self.layout, self.outputs, jnp)
        known = self.baseline.known(x, self.layout, self.outputs, jnp)
        terms = self.terms(numbers, x)[None, :]
        learned = terms @ numbers.weights[1]
        return Parts(known + phi @ numbers.theta, learned, learned), jnp.concatenate(
            [phi, terms], axis=1
        )

    def _derivatives(self, numbers: Numbers, state: Any, inputs: Any) -> tuple[Any, Any, Any]:
        def predict(state: Any) -> tuple[Any, Any]:
            parts, slope = self._with_slopes(numbers, self.regressor(state, inputs))
            return parts.total[0], (parts.total, slope)

        to_state, (value, slope) = jax.grad(predict, has_aux=True)(state)
        back = jnp.stack([to_state[lag - 1] for lag, _ in self.fed_back] or [jnp.zeros(())])[
            None, :
        ]
        # a kink without a derivative counts as flat
        slope, feedback = (jnp.where(jnp.isfinite(d), d, 0.0) for d in (slope, back))
        return value, slope, feedback


Able = Collection[int] | None
"""Terms that may be chosen, by number; None for all."""


class Point(NamedTuple):
    """A fitted model: the terms by number, c, and w for terms of factors divided by their sizes."""

    chosen: tuple[int, ...]
    c: Vector
    w: Vector
    states: Any = None
    """Of the segments' starts, on the free run."""
    loss: float = np.inf
    """Mean of squared errors in the output's unit."""


@dataclass(frozen=True, eq=False)
class TermRuns:
    """A problem of physics, which may be empty, with a library of terms, for a criterion.

    `sizes` are the largest sizes of the factors.
    """

    problem: Problem
    library: TermLibrary
    criterion: Criterion
    menu: Menu
    sizes: Vector
    layout: Segments | None
    collinear: float = COLLINEAR
    """Share of a term's deviation that physics and the terms before it must leave, so that it is
    taken.
    """

    @classmethod
    def of(
        cls,
        problem: Problem,
        library: TermLibrary,
        criterion: Criterion,
        like: TermRuns | None = None,
        collinear: float = COLLINEAR,
    ) -> TermRuns:
        """Return the runs of a problem, its segments padded to the shapes of another's."""
        factors = Features(tuple(parse(text) for text in library.factors)).sampled(
            problem.record.sampling_time
        )
        names = (
            tuple(c.name for c in problem.record.outputs),
            tuple(c.name for c in problem.record.inputs),
        )
        layout = in_order((*problem.baseline.lags, *factors.lags), *names)
        menu = Menu(
            problem.baseline,
            factors,
            layout,
            names[0],
            nothing_learned(len(names[0])),
            width=_PLACES,
            order=max(library.order, 1),
        )
        sizes = like.sizes if like is not None else None
        first = np.ones(len(library.factors)) if sizes is None else sizes
        runs = cls(problem, library, criterion, menu, first, None, collinear)
        if sizes is None:
            with np.errstate(all="ignore"):
                largest = np.abs(
                    np.concatenate([runs.factors(e) for e in problem.record.experiments], axis=1)
                ).max(axis=1)
            runs = replace(runs, sizes=positive(largest))
        if criterion.one_step:
            return runs
        trial = criterion.free_run
        assert trial is not None
        shape = None if like is None else like.layout
        return replace(
            runs, layout=build_segments(problem.record, menu, trial.steps, trial.washout, shape)
        )

    @property
    def free_run(self) -> Simulation:
        """Free-run objective of the training data, with room for held-out blocks."""
        return self.criterion.free_run or Simulation()

    @cached_property
    def rms(self) -> float:
        """RMS of the one-step least-squares residual, in the output's unit."""
        return max(float(np.sqrt(np.mean(self.problem.unexplained**2))), 1e-10) * float(
            self.problem.deviation[0]
        )

    def places(self, count: int) -> int:
        """Return the number of places of the compiled program that so many terms run in."""
        narrow = _NARROW if self.problem.count >= _MANY_ROWS else ()
        return next((n for n in narrow if count <= n), _PLACES * max(1, -(-count // _PLACES)))

    def factors(self, experiment: Experiment) -> Float[np.ndarray, "nf T"]:
        """Return the factors along an experiment, over their sizes."""
        x = self.menu.regressors(experiment, self.problem.record)
        with np.errstate(all="ignore"):
            return (
                np.asarray(self.menu.features.evaluate(x, self.menu.layout, np)).T
                / self.sizes[:, None]
            )

    def rows(
        self, experiment: Experiment
    ) -> tuple[Float[np.ndarray, "T nx"], Float[np.ndarray, "T 1"]]:
        """Return regressors and outputs along an experiment."""
        return self.menu.regressors(experiment, self.problem.record), experiment.outputs[
            self.menu.first_row :
        ]

    def physics(self, x: Matrix, y: Matrix) -> tuple[Float[np.ndarray, "T nt"], Vector]:
        """Return Φ along some of these rows, and the output less the fixed terms."""
        phi, known = self.problem.baseline.on(x, self.menu.layout, self.menu.outputs)
        return phi[:, 0], (y - known)[:, 0]

    def on(self, record: Record) -> TermRuns:
        """Return the same terms on another record."""
        return TermRuns.of(
            self.problem.on(record), self.library, self.criterion, self, self.collinear
        )

    @cached_property
    def lags(self) -> tuple[frozenset[Lag], ...]:
        """Those that each term reads."""
        own = [parse(text).lags for text in self.library.factors]
        return tuple(
            frozenset(lag for i in product for lag in own[i]) for product in self.library.products
        )

    @cached_property
    def constant(self) -> int | None:
        """The column of a constant among those of physics and terms; None where neither has one."""
        physics, texts = self.problem.baseline, self.library.texts
        several = [term.parameter for term in physics.terms]
        for term, expression in zip(physics.terms, physics.expressions, strict=True):
            if not expression.lags and not term.fixed and several.count(term.parameter) == 1:
                return physics.names.index(term.parameter)
        return len(physics.names) + texts.index(CONSTANT) if CONSTANT in texts else None

    def start(self) -> Point:
        """Return physics alone, fitted one step ahead."""
        return Point(
            (),
            self.problem.least_squares,
            np.zeros(0),
            None if self.layout is None else np.asarray(self.layout.start),
        )

    def fit(self, point: Point, chosen: Sequence[int], iterations: int = 30) -> Point:
        """Return physics and the chosen terms, fitted from a point with some of them."""
        before = dict(zip(point.chosen, point.w, strict=True))
        chosen, w = tuple(chosen), np.array([before.get(i, 0.0) for i in chosen])
        if self.layout is None:
            nt = len(point.c)
            own = self.step_equations.of([*range(nt), *(nt + i for i in chosen)])
            p = own.solve()
            return Point(chosen, p[:nt], p[nt:], None, max(own.miss(p), 0.0) / own.rows)
        objective = _TermSubset.of(self, chosen)
        p = np.concatenate(
            [point.c, w, np.zeros(objective.dynamics.unknowns - len(point.c) - len(w))]
        )
        states = point.states if point.states is not None else np.asarray(self.layout.start)
        trial = _descend(objective, p, Start(states), iterations)
        loss = (
            trial.misfit * self.rms**2 / self.layout.count if np.isfinite(trial.misfit) else np.inf
        )
        return Point(chosen, trial.c, trial.w[: len(chosen)], trial.states, loss)

    def independent_share(self, point: Point) -> float:
        """Return the share of a model's errors that is independent.

        One step ahead all of them count.
        """
        if self.layout is None:
            return 1.0
        objective = _TermSubset.of(self, point.chosen)
        p = np.zeros(objective.physics + objective.dynamics.width)  # type: ignore[attr-defined]
        p[: len(point.c)], p[len(point.c) : len(point.c) + len(point.w)] = point.c, point.w
        return objective.samples(objective.evaluate(p, Start(point.states)))[1]

    def equations(self, point: Point, able: Able = None, scored: Any = None) -> Equations:
        """Return the normal equations of physics and all terms about a point, for p itself.

        Args:
            point: the model about which the free run is linearised.
            able: terms that may be chosen, beside those that are; the columns of others are zero.
            scored: which steps of the segments count, or which range of rows one step ahead; None
            for all.
        """
        nt, terms = len(point.c), len(self.library)
        taken = range(terms) if able is None else sorted({*able, *point.chosen})
        columns = [*range(nt), *(nt + i for i in taken)]
        if self.layout is None:
            own = self.step_equations if scored is None else self._step_equations_of(scored)
            return own if able is None else own.of(columns).among(columns, nt + terms)
        objective = _TermSubset.of(self, tuple(taken), exactly=True)
        if scored is not None:
            objective = replace(objective, segments=self.layout._replace(scored=scored))
        w = np.zeros(terms)
        w[list(point.chosen)] = point.w
        p = np.concatenate([point.c, w[list(taken)]])
        trial = objective.evaluate(p, Start(point.states))
        linear = objective.linearise(trial)
        hessian, right = linear.information, linear.gradient
        bent = hessian @ p
        square = trial.misfit + 2 * p @ right + p @ bent
        own = Equations(hessian, right + bent, float(square), objective.segments.count)
        return own.among(columns, nt + terms)

    def parts(self, point: Point, count: int, able: Able = None) -> list[Equations]:
        """Return the equations about a point over up to `count` successive parts of the data."""
        if self.layout is None:
            rows = self.step_equations.rows
            edges = np.linspace(0, rows, min(count, rows) + 1).astype(int)
            return [
                self.equations(point, able, slice(a, b))
                for a, b in zip(edges[:-1], edges[1:], strict=True)
            ]
        scored = np.asarray(self.layout.scored)
        order = np.cumsum(np.moveaxis(scored, 1, -1).reshape(-1)).reshape(
            *scored.shape[::2], scored.shape[1]
        )
        place = np.moveaxis((order - 1) * count // max(int(scored.sum()), 1), -1, 1)
        return [self.equations(point, able, scored & (place == part)) for part in range(count)]

    @cached_property
    def step_equations(self) -> Equations:
        """The normal equations one step ahead of physics and all terms, in the output's unit."""
        return self._step_equations_of(slice(None))

    def _step_equations_of(self, part: slice) -> Equations:
        """Return these equations over a range of rows, counted over the experiments."""
        found, before = [], 0
        for experiment in self.problem.record.experiments:
            (x, y), factors = self.rows(experiment), self.factors(experiment)
            first, last = ((0 if e is None else e - before) for e in (part.start, part.stop))
            last = len(x) if part.stop is None else min(max(last, 0), len(x))
            for a in range(min(max(first, 0), last), last, _CHUNK):
                rows = slice(a, min(a + _CHUNK, last))
                phi, target = self.physics(x[rows], y[rows])
                with np.errstate(all="ignore"):
                    terms = products_of(factors[:, rows], self.library.numbers, np)
                columns = np.concatenate([phi.T, terms])
                found.append(
                    Equations(
                        columns @ columns.T, columns @ target, float(target @ target), len(target)
                    )
                )
            before += len(x)
        return Equations.sum_of(found)

    def errors(self, point: Point, held: Segments) -> float:
        """Return the mean squared error of free runs over held-out segments from measured starts.

        Infinite if one diverges.
        """
        objective = _TermSubset.of(self, point.chosen)
        w = np.zeros(objective.dynamics.unknowns - objective.physics)
        w[: len(point.w)] = point.w
        numbers = objective.numbers(point.c, w)
        errors = errors_of(objective.dynamics, numbers, held.start, held)
        with np.errstate(all="ignore"):
            mean = float(np.sum(errors**2)) / held.count
        return mean if mean < RUNAWAY * float(self.problem.deviation[0]) ** 2 else np.inf


def _descend(objective: FreeRunObjective, p: Vector, start: Start, iterations: int) -> TrialPoint:
    """Minimise the misfit by Gauss-Newton steps, with Levenberg-Marquardt where one fails.

    About a fitted model the misfit is nearly quadratic. A small step that lowers it by what was
    expected leaves nothing to gain, so no trial is linearised only to confirm that: a linearisation
    costs ten to thirty trials. After a large step the sensitivities are others: those of past
    outputs are zero where the model does nothing yet.
    """
    trial = objective.evaluate(p, start)
    for done in range(iterations if np.isfinite(trial.misfit) else 0):
        linear = objective.linearise(trial)
        if not np.isfinite(linear.hessian).all():
            break
        step = Equations(
            linear.hessian, linear.gradient, trial.misfit, objective.segments.count
        ).solve()
        expected = float(2 * step @ linear.gradient - step @ linear.hessian @ step)
        if expected <= _TOLERANCE**2 * trial.misfit:
            break
        tried = objective.evaluate(trial.p + step, linear.start)
        gained = trial.misfit - tried.misfit
        if not gained > 0:
            solver, start = LevenbergMarquardt(iterations - done, _TOLERANCE), Start(trial.states)
            return solver.descend(objective, trial.p, start, damping=MARQUARDT).point
        before, trial = trial, tried
        if (
            gained <= _SETTLED * before.misfit
            and abs(expected - gained) <= _TOLERANCE * before.misfit
        ):
            break
    return trial


@dataclass(frozen=True, eq=False, kw_only=True)
class _TermSubset(FreeRunObjective):
    """Free run of some terms in a program with more places; unused places stay zero."""

    taken: int

    @classmethod
    def of(cls, runs: TermRuns, chosen: tuple[int, ...], *, exactly: bool = False) -> _TermSubset:
        places = len(chosen) if exactly else runs.places(len(chosen))
        menu, layout = replace(runs.menu, width=places), runs.layout
        products = np.full((places, runs.menu.order), len(runs.library.factors))
        products[: len(chosen)] = runs.library.numbers[list(chosen)]
        nt = len(runs.problem.baseline.names)
        segments: Any = layout
        start: Any = None if layout is None else np.asarray(layout.start)
        return cls(
            dynamics=menu,
            numbers=lambda c, w: menu.numbers(c, products, w, runs.sizes),
            segments=segments,
            initial=InitialStates(
                start, start is not None and start.size > 0 and runs.free_run.estimates_pasts
            ),
            weight=np.eye(1) / runs.rms,
            rms=runs.rms,
            deviation=runs.problem.deviation,
            physics=nt,
            taken=nt + len(chosen),
        )

    def linearise(self, trial: TrialPoint) -> LinearisedFreeRun:
        linear = super().linearise(trial)
        hessian, gradient = linear.hessian.copy(), linear.gradient.copy()
        hessian[self.taken :], hessian[:, self.taken :], gradient[self.taken :] = 0.0, 0.0, 0.0
        return linear._replace(hessian=hessian, gradient=gradient)
