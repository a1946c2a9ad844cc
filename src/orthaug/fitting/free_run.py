"""Training on the free run: θ and the weights together, from a one-step solution (the criterion `Simulation`).

Here θ is an unknown beside the weights (F1 does not hold). Without bounds or penalties the unknown is `c = θ − θ_aux`,
and θ is split off at the end under the measure of the *measured* regressors (F2), which keeps the orthogonal structure
exact. Where θ has bounds, it is the unknown itself and `c = θ − Φ⁺F(w)` follows, so that the split cannot leave them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from orthaug._base.checks import Matrix, Vector
from orthaug._base.errors import InputError
from orthaug._base.jax import jnp
from orthaug.fitting.criteria import Criterion, Simulation
from orthaug.fitting.learned import FreeStatistics, Learned
from orthaug.fitting.one_step import Task
from orthaug.fitting.pasts import Pasts
from orthaug.fitting.segments import Segments, lay_segments, respond, sensitivity
from orthaug.fitting.solvers.levenberg_marquardt import NON_FINITE, LevenbergMarquardt, Progress
from orthaug.fitting.solvers.output_error import Outcome, independent_share, minimise
from orthaug.fitting.structures import Elimination, Structure, eliminate
from orthaug.inference.covariance import noise_covariance, theta_block, whitening
from orthaug.models.learners import Bound, Scaling
from orthaug.models.predictor import Form, Numbers
from orthaug.physics.problem import Problem

_RUNAWAY = 1e6  # mean square in deviations of the output: a free run beyond it has diverged
_LARGEST_ERROR = 1e120
_COLOURED_STEPS = 256  # shorter segments do not show how long the errors remember
_COLOUR_ROWS = 4096  # of each experiment, which show it instead
_SHORTEST = 4  # steps of a segment


@dataclass(frozen=True, eq=False)
class FreeRun:
    """A problem laid out in segments, with the learner of a one-step task or none."""

    problem: Problem
    task: Task | None
    form: Form
    segments: Segments
    whole: Segments
    """What runs are compared over: whole experiments; for a prediction h steps ahead its own segments."""
    colour: Segments | None
    """What the colour of the errors is taken from, where segments are too short to show it."""
    rms: float
    declared: Criterion
    criterion: Simulation
    warm: Vector | None = None
    """c of an earlier model, with whose weights training starts."""

    @classmethod
    def of(cls, problem: Problem, task: Task | None, declared: Criterion, warm: Vector | None = None) -> FreeRun:
        """Lay the problem's record out as a criterion of several steps declares."""
        criterion = declared.flown
        assert criterion is not None, "one step ahead is `Task`'s"
        longest = max(len(e) for e in problem.record.experiments) - problem.rows.start
        if criterion.washout >= longest:
            raise InputError(
                f"nothing is scored: the longest experiment has {longest} usable rows, and the first "
                f"{criterion.washout} of a segment are washout; shorten it, or the horizon."
            )
        bound = None if task is None else task.bound
        form = Form(problem.baseline, problem.features, problem.layout, problem.outputs, bound)
        segments = lay_segments(problem.record, form, criterion.segment, criterion.washout)
        residual = problem.projection.orthogonal_part(problem.whitened_target)
        rms = task.rms if task is not None else max(float(np.sqrt(np.mean(residual**2))), 1e-10)
        whole, colour = segments, None
        if declared.simulates and criterion.segment:
            whole = lay_segments(problem.record, form, 0, criterion.washout)
            if segments.scored.shape[1] < _COLOURED_STEPS <= longest:
                first = tuple(e.rows(0, _COLOUR_ROWS) for e in problem.record.experiments)
                colour = lay_segments(replace(problem.record, experiments=first), form, 0, criterion.washout)
        return cls(problem, task, form, segments, whole, colour, rms, declared, criterion, warm)

    def numbers(self, c: Vector, w: Any, tilt: Any = None) -> Numbers:
        """The model's numbers before the split."""
        return Numbers(c, np.zeros_like(c), np.asarray(w), self.scaling.centre, self.scaling.halfwidth, self.unit, tilt)

    def errors(self, c: Vector, w: Any, past: Any) -> Float[np.ndarray, "k T ny m"]:
        """Errors of every segment from its past, in the outputs' units; 0 where they are not scored."""
        return self._errors(self.numbers(c, w), past, self.segments)

    def _errors(self, numbers: Numbers, past: Any, segments: Segments) -> Float[np.ndarray, "k T ny m"]:
        run = np.asarray(respond(self.form, numbers, segments, jnp.asarray(past)))
        with np.errstate(all="ignore"):
            return np.where(np.asarray(segments.scored)[:, :, None], np.asarray(segments.target) - run, 0.0)

    def run(
        self,
        solver: LevenbergMarquardt,
        w: Any,
        structure: Structure,
        regularization: str | float = "none",
        progress: Progress | None = None,
    ) -> Flight:
        """One run from the weights `w`: a short one-step training, then the free run; the arguments as in `estimate`.

        Training goes on from whichever flies better, the weights after the one-step training or those before it:
        a good one-step predictor may run away.
        """
        objective = Objective.of(self, structure)
        places, begun, seconds = [objective.start(np.asarray(w))], 0, 0.0
        evidence = regularization == "evidence"
        ridge = 1.0 if evidence else 0.0 if regularization == "none" else float(regularization)
        if self.task is not None and self.criterion.start_iterations:
            short = LevenbergMarquardt(self.criterion.start_iterations, solver.tolerance)
            first = self.task.run(short, w, structure, regularization, progress)
            begun, seconds = first.iterations, first.seconds
            places.append(objective.start(np.asarray(first.w)))
            ridge = first.ridge
        if self.warm is not None and not objective.follows:
            places.append(np.concatenate([self.warm, np.asarray(w)]))
        losses = [objective.loss(p) for p in places]
        if not np.isfinite(losses).any() and self.segments.scored.shape[1] > _SHORTEST:
            shorter = self._shorter().run(solver, w, structure, regularization, progress)
            places, losses = [shorter.found.p], [objective.loss(shorter.found.p)]
            begun, seconds = begun + shorter.iterations, seconds + shorter.seconds

        def tell(iteration: int, loss: float) -> None:
            if progress is not None:
                progress(begun + iteration, loss * self.rms**2 / (self.segments.count * len(self.form.outputs)))

        found = objective.minimise(places[int(np.argmin(losses))], solver, ridge, evidence, tell)
        _, c, w = objective.end
        iterations, seconds = begun + found.iterations, seconds + found.seconds
        return Flight(w, c, objective, found, found.code, self.mean_square(c, w), iterations, seconds)

    def _shorter(self) -> FreeRun:
        """The same over segments of a quarter of the length, from which training reaches where longer ones run away."""
        segment = max(_SHORTEST, self.segments.scored.shape[1] // 4)
        shorter = replace(self.criterion, segment=segment, washout=min(self.criterion.washout, segment // 2))
        return FreeRun.of(self.problem, self.task, shorter)

    def loss(self, flight: Flight) -> float:
        """The run's `mean_square`."""
        return flight.mean_square

    def mean_square(self, c: Vector, w: Any, tilt: Any = None) -> float:
        """Mean of squared errors over whole experiments, in deviations of the outputs; NaN where it diverges."""
        numbers = self.numbers(c, w, tilt)
        with np.errstate(all="ignore"):
            errors = self._errors(numbers, self.whole.past, self.whole) * self.problem.weight[:, None]
            found = float(np.sum(errors**2)) / (self.whole.count * len(self.form.outputs))
        return found if found < _RUNAWAY else np.nan

    def learned(self, flight: Flight) -> Learned:
        """What a run left, with the statistics of its errors."""
        return Learned(
            bound=self.form.bound,
            weights=np.asarray(flight.w),
            scaling=self.scaling,
            unit=self.unit,
            values=np.zeros_like(self.problem.target) if self.task is None else self.task.values(flight.w),
            effective=flight.found.effective,
            gram=flight.objective.gram,
            ridge=flight.found.ridge * self.rms**2,
            middle=flight.objective.middle,
            code=flight.code,
            iterations=flight.iterations,
            seconds=flight.seconds,
            coefficients=flight.c,
            free=flight.objective.statistics(flight),
        )

    @property
    def bound(self) -> Bound | None:
        return self.form.bound

    @property
    def scaling(self) -> Scaling:
        return Scaling(np.zeros(0), np.zeros(0)) if self.task is None else self.task.scaling

    @property
    def unit(self) -> Vector:
        return np.zeros(len(self.problem.outputs)) if self.task is None else self.task.unit


class Flight(NamedTuple):
    """A finished run on the free-run criterion."""

    w: Vector
    c: Vector
    objective: Objective
    found: Outcome
    code: int
    mean_square: float
    iterations: int
    seconds: float


@dataclass(eq=False)
class Objective:
    """`‖r‖²` of the free run and of the structure's rows, as a function of p = (θ, w).

    `weight` (ny, ny) multiplies the errors of a step; `follows` says that c follows θ, `c = θ − Φ⁺F(w)`.
    """

    free_run: FreeRun
    elimination: Elimination
    orthogonal: bool
    weight: Matrix
    pasts: Pasts
    errors: Any = None
    """Of the last `loss`, (k, T, ny, m); after `minimise` those of its end."""
    end: tuple[Vector, Vector, Vector] = (np.zeros(0),) * 3
    """(unknown θ, c, w) where `minimise` ended."""
    _flown: tuple[float, Any] = (np.inf, None)
    """Loss and pasts of the last `loss`."""
    _anchor: tuple[float, Vector] | None = None
    """Loss and (c, w) of the last `normal`."""

    @classmethod
    def of(cls, free_run: FreeRun, structure: Structure) -> Objective:
        weight = np.diag(free_run.problem.weight) / free_run.rms
        past = np.asarray(free_run.segments.past)
        free = past.size > 0 and free_run.criterion.estimates_pasts
        elimination = eliminate(structure, free_run.problem)
        return cls(free_run, elimination, structure.projects, weight, Pasts(past, past, free))

    @property
    def follows(self) -> bool:
        return self.orthogonal and self.elimination.bounded and self.free_run.task is not None

    def start(self, w: Vector) -> Vector:
        """p of the one-step θ for the weights w."""
        problem, task = self.free_run.problem, self.free_run.task
        values = np.zeros_like(problem.target) if task is None else task.values(w) * problem.weight
        f = problem.projection.coordinates(values)
        if self.orthogonal:
            theta = self.elimination.theta(0 * f, self.elimination.active(0 * f))
            theta = theta if self.follows else theta - problem.projection.from_coordinates(f)
        else:
            theta = self.elimination.theta(f, self.elimination.active(f))
        return np.concatenate([theta, w])

    def place(self, p: Vector) -> tuple[Vector, Vector, Vector]:
        """(unknown θ, c, w) of p; without bounds on an orthogonal θ the unknown is c itself."""
        nt = len(self.free_run.problem.baseline.names)
        theta, w = p[:nt], p[nt:]
        c = theta - self.free_run.problem.projection.from_coordinates(self._share(w)) if self.follows else theta
        return theta, c, w

    def loss(self, p: Vector) -> float:
        """‖r‖² with the structure's rows; infinite where a free run diverges.

        The pasts follow p to first order; where that does not lower the loss, they stay.
        """
        theta, c, w = self.place(p)
        tried = [self.pasts.values]
        if self._anchor is not None and self.pasts.free:
            tried.insert(0, self.pasts.after(np.concatenate([c, w]) - self._anchor[1]))
        flights = []
        for past in tried:
            errors = self.free_run.errors(c, w, past)
            with np.errstate(all="ignore"):
                total = float(np.sum(np.einsum("oi,ktim->ktom", self.weight, errors) ** 2))
                total += self.pasts.loss(past, self.weight)
            flights.append((total if total < self._largest else np.inf, past, errors))
            if self._anchor is None or total < self._anchor[0]:
                break
        best, past, self.errors = min(flights, key=lambda flight: flight[0])
        self._flown = best, past
        rows = self.elimination.rows
        if len(rows.target):
            miss = rows.target - rows.theta @ theta - rows.learner @ self._share(w)
            best += float(miss @ miss) / self.free_run.rms**2
        return best

    def normal(self, p: Vector) -> tuple[Matrix, Vector]:
        """JᵀJ and Jᵀr at the p of the last `loss`."""
        theta, c, w = self.place(p)
        total, self.pasts.values = self._flown
        self._anchor = total, np.concatenate([c, w])
        hessian, gradient = self._linearise(c, w)
        rows, rms = self.elimination.rows, self.free_run.rms
        if self.follows:
            change = self._change(w)
            hessian, gradient = change.T @ hessian @ change, change.T @ gradient
        if len(rows.target):
            slope = np.column_stack([rows.theta, rows.learner @ self._share_slope(w)]) / rms
            miss = (rows.target - rows.theta @ theta - rows.learner @ self._share(w)) / rms
            hessian, gradient = hessian + slope.T @ slope, gradient + slope.T @ miss
        return hessian, gradient

    def samples(self) -> tuple[float, float]:
        """Number of residuals less the physics' own parameters, and the share of them that is independent."""
        nt, ny = len(self.free_run.problem.baseline.names), len(self.weight)
        errors = self.errors if self.free_run.colour is None else self._long_errors()
        moved = np.moveaxis(errors, 1, -1).swapaxes(1, 2)  # (k, m, ny, T)
        shares = [independent_share(moved[:, :, i].reshape(-1, moved.shape[-1])) for i in range(ny)]
        return self.free_run.segments.count * ny - nt, float(np.mean(shares))

    def _long_errors(self) -> Any:
        """Errors at the last linearisation over stretches that are long enough to show their colour."""
        run, nt = self.free_run, len(self.free_run.problem.baseline.names)
        assert self._anchor is not None and run.colour is not None
        numbers = run.numbers(self._anchor[1][:nt], self._anchor[1][nt:])
        errors = run._errors(numbers, run.colour.past, run.colour)
        return errors if np.abs(errors).max() < _LARGEST_ERROR else self.errors

    @property
    def _largest(self) -> float:
        """A loss beyond which a free run has diverged."""
        problem, count = self.free_run.problem, self.free_run.segments.count
        return _RUNAWAY * count * float(np.sum((self.weight / problem.weight) ** 2))

    def minimise(self, p: Vector, solver: LevenbergMarquardt, ridge: float, evidence: bool, tell: Progress) -> Outcome:
        """From p to the end; several outputs are weighted by their errors' covariance in a second leg."""
        nt, ny = len(self.free_run.problem.baseline.names), len(self.free_run.problem.outputs)
        bounded = not self.orthogonal or self.follows or self.free_run.task is None
        options: dict[str, Any] = {
            "physics": nt,
            "tolerance": solver.tolerance,
            "evidence": evidence,
            "bounds": (self.elimination.lower, self.elimination.upper) if bounded else None,
        }
        first = solver.iterations if ny == 1 else solver.iterations // 2
        found = minimise(self, p, iterations=first, ridge=ridge, progress=tell, **options)
        if ny > 1 and found.code != NON_FINITE:
            self._settle(found.p)
            noise = self._noise(found)
            white = None if noise is None else whitening(noise)
            if noise is not None and white is not None:
                size = np.trace(self.weight @ noise @ self.weight.T) / ny  # so that the ridge keeps its place
                self.weight, self._anchor = np.sqrt(size) * white, None
                done = found.iterations
                again = minimise(
                    self,
                    found.p,
                    iterations=solver.iterations - done,
                    ridge=found.ridge,
                    progress=lambda i, loss: tell(done + i, loss),
                    **options,
                )
                found = again._replace(iterations=done + again.iterations, seconds=found.seconds + again.seconds)
        self._settle(found.p)
        return found

    def _settle(self, p: Vector) -> None:
        """The errors of p itself, where the last trial was another."""
        self.end = self.place(p)
        self.errors = self.free_run.errors(*self.end[1:], self.pasts.values)

    @cached_property
    def information(self) -> Matrix:
        """SᵀS of (c, w) where training ended, rows times `weight`, the pasts eliminated (nθ + nw)²."""
        return self._linearise(*self.end[1:])[0]

    @property
    def gram(self) -> Matrix:
        """The same in whitened outputs."""
        return self.information * self.free_run.rms**2

    def middle(self, noise: Matrix) -> Matrix:
        """ΣψᵀΣ_eψ of the rows of `gram`, which are white where `weight` made them so."""
        change = self.weight / self.free_run.problem.weight  # of errors in whitened outputs
        white = change @ noise @ change.T * self.free_run.rms**2
        return self.gram * float(np.trace(white)) / len(white)

    def statistics(self, flight: Flight) -> FreeStatistics:
        """Noise covariance of the free run and Cov θ̂ from its sensitivities."""
        found = flight.found
        theta, _, w = self.end
        nt = len(theta)
        freedom = self.free_run.segments.count - (nt + found.effective) / len(self.weight)
        noise = self._noise(found)
        sides = (self.elimination.lower, self.elimination.upper)
        at_bound = {i: float(value) for i, value in enumerate(theta) if value in (sides[0][i], sides[1][i])}
        covariance = None
        if noise is not None:
            information = self.information
            if self.orthogonal and self.free_run.task is not None:
                change = self._change(w)
                information = change.T @ information @ change
            white = self.weight @ noise @ self.weight.T
            scale = float(np.trace(white)) / len(white)
            covariance = theta_block(information, found.ridge, nt, tuple(at_bound)) * scale
        return FreeStatistics(noise, covariance, freedom, flight.mean_square, at_bound)

    def _noise(self, found: Outcome) -> Matrix | None:
        ny, count = len(self.weight), self.free_run.segments.count
        used = (len(self.free_run.problem.baseline.names) + found.effective) / ny
        errors = np.moveaxis(self.errors, 2, -1).reshape(-1, ny)
        sane = np.abs(errors).max(initial=0.0) < _LARGEST_ERROR  # whose squares still add up
        return noise_covariance(errors, np.full(ny, count - used)) if sane else None

    def _linearise(self, c: Vector, w: Vector) -> tuple[Matrix, Vector]:
        run, past = self.free_run, jnp.asarray(self.pasts.values)
        found = sensitivity(run.form, run.numbers(c, w), run.segments, past, jnp.asarray(self.weight))
        return self.pasts.eliminate(found, self.weight)

    def _share(self, w: Vector) -> Vector:
        """QᵀF (nθ,) at the measured regressors, in whitened outputs."""
        task, problem = self.free_run.task, self.free_run.problem
        if task is None:
            return np.zeros(len(problem.baseline.names))
        return problem.projection.coordinates(task.values(w) * problem.weight)

    def _share_slope(self, w: Vector) -> Matrix:
        """QᵀJ (nθ, nw) at the measured regressors, in whitened outputs."""
        task, nt = self.free_run.task, len(self.free_run.problem.baseline.names)
        return np.zeros((nt, 0)) if task is None else task.overlap(w)

    def _change(self, w: Vector) -> Matrix:
        """∂(c, w)/∂(θ, w) for `c = θ − Φ⁺F(w)`."""
        slope = self.free_run.problem.projection.from_coordinates(self._share_slope(w))
        nt, nw = slope.shape
        return np.block([[np.eye(nt), -slope], [np.zeros((nw, nt)), np.eye(nw)]])
