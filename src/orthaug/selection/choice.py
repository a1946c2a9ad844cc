"""The choice that `select` makes: what was chosen, what confirms it, and what it is fitted to."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.special

from orthaug._base.checks import Matrix, Vector
from orthaug._base.errors import Warning
from orthaug.analysis.robustness import robust_where_asked
from orthaug.data.record import Record
from orthaug.data.regressors import Lags
from orthaug.fitting.criteria import Criterion
from orthaug.fitting.estimation import estimate
from orthaug.inference.chosen_terms import NONE, SPLIT, Intervals
from orthaug.inference.covariance import reach
from orthaug.models.learners import MLP, Learner
from orthaug.models.terms import Terms
from orthaug.physics.baseline import Baseline
from orthaug.selection.false_discoveries import LEVEL, false_discovery_rates
from orthaug.selection.forward import DEPENDENT
from orthaug.selection.kept_physics import PhysicsComparison, standard_errors
from orthaug.selection.nonlinearity import Nonlinearity
from orthaug.selection.orders import Delay, Orders, OrderSearch
from orthaug.selection.term_path import (
    RankedModel,
    Search,
    TermPath,
    from_both_starts,
)
from orthaug.selection.term_runs import Point, TermRuns

if TYPE_CHECKING:
    import pandas as pd

    from orthaug.fitting.lagged_estimate import LaggedEstimate


_LISTED = 3  # rivals of a term


@dataclass(frozen=True, eq=False)
class LearnerSearch(Search):
    """Networks, physics alone first."""

    learners: tuple[MLP | None, ...]

    @property
    def chosen(self) -> MLP | None:
        """Network of the choice; None for physics alone."""
        return self.learners[self.place]


@dataclass(frozen=True)
class Confirmation:
    """A chosen term on the rows that had no say in the choice.

    `p` is its p-value beside physics and the other terms, and `q` the least rate of false
    discoveries at which it is one among the chosen terms (Benjamini and Hochberg 1995).
    """

    p: float
    q: float


@dataclass(frozen=True, eq=False)
class Selection:
    """Result of `select`.

    Print `selection.summary()`; take `selection.table`; go on with `selection.estimate()`.
    """

    record: Record = field(repr=False)
    """What `estimate` fits: rows that had no say in the choice, where these suffice."""
    baseline: Baseline
    criterion: Criterion
    delays: tuple[Delay, ...]
    orders: OrderSearch
    nonlinearity: Nonlinearity | None
    terms: TermPath | None
    learners: LearnerSearch | None
    notes: tuple[Warning, ...]
    stopped: bool = False
    """True if the search was stopped before its end; what it had found by then was chosen from."""
    physics: PhysicsComparison | None = None
    """θ of physics alone beside θ with the chosen terms; None where no terms were searched, or
    there is no physics.
    """
    reach: Orders | None = None
    """The orders that were chosen, with lags of inputs that act by a nonlinear function alone; None
    for no such.
    """
    intervals: Intervals = Intervals.empty("all rows chose")
    """Where intervals of a fit of the choice come from."""
    level: float = LEVEL
    """The rate of false discoveries that was allowed."""

    def __repr__(self) -> str:
        learner = "" if self.learner is None else f", {self.learner!r}"
        return f"Selection({self.lags!r}{learner}; print `summary()`)"

    @property
    def lags(self) -> Lags:
        """Chosen orders, and lags of inputs that have only a nonlinear effect."""
        return (self.reach or self.orders.chosen).lags

    @cached_property
    def learner(self) -> Learner | None:
        """The learner that was chosen, written out; None where nothing helps."""
        if self.learners is not None:
            return self.learners.chosen
        if self.terms is not None:
            chosen, texts = self.terms.chosen.point.chosen, self.terms.runs.library.texts
            return Terms(tuple(texts[i] for i in chosen)) if chosen else None
        linear = self.orders.linear_texts(self.record, self.baseline)
        return Terms(tuple(linear)) if linear else None

    @cached_property
    def shares(self) -> dict[str, float]:
        """Share of random halves of the rows that chose in which each chosen term is chosen.

        Empty where no terms were chosen from a library; linear lags are chosen as orders, and a
        network as a whole.
        """
        return {} if self.terms is None else self.terms.shares()

    @cached_property
    def confirmed(self) -> dict[str, Confirmation]:
        """Every chosen term on the rows that had no say in the choice.

        Empty where there are no such rows.

        Its standard error is the one that the errors ask for, robust against colour and uneven
        size.
        """
        if self.intervals.source != SPLIT or not isinstance(self.learner, Terms):
            return {}
        fit = self.estimate(blocks=0)
        if not fit.status.ok:
            return {}
        table = robust_where_asked(fit, fit.model.predict(self.record)).terms
        tested = table[table["std"] > 0]
        freedom = max(fit.model.statistics.freedom, 1.0)
        p = 2 * scipy.special.stdtr(
            freedom, -np.abs(np.asarray(tested["coefficient"] / tested["std"], dtype=float))
        )
        q = false_discovery_rates(p)
        return {
            str(term): Confirmation(float(a), float(b))
            for term, a, b in zip(tested.index, p, q, strict=True)
        }

    @property
    def unconfirmed(self) -> tuple[str, ...]:
        """The chosen terms whose q-value on the rows that had no say is above the level."""
        return tuple(term for term, one in self.confirmed.items() if one.q > self.level)

    @property
    def options(self) -> dict[str, Any]:
        """Arguments for `estimate`, beside record and baseline."""
        judged = (
            {"regularization": "none", "fallback": False} if isinstance(self.learner, Terms) else {}
        )
        lags = None if isinstance(self.learner, Terms | None) else self.lags
        return {"learner": self.learner, "lags": lags, "criterion": self.criterion} | judged

    @cached_property
    def rivals(self) -> dict[str, tuple[str, ...]]:
        """Rivals of each chosen term on the rows that `estimate` fits.

        Beside a rival the term is not significant, so these rows do not show which of the two acts.
        """
        if self.terms is None or not isinstance(self.learner, Terms):
            return {}
        runs = self.terms.runs
        if self.intervals.source != SPLIT:
            return rivals(runs, self.terms.chosen.point)
        own = TermRuns.of(
            runs.problem.on(self.record), runs.library, runs.criterion, None, runs.collinear
        )
        return rivals(own, from_both_starts(own, self.terms.chosen.point.chosen))

    def estimate(self, **options: Any) -> LaggedEstimate:
        """Return the fit of the choice to `record`; `options` of `estimate` beside it.

        It has no standard errors and no intervals where the rows that are fitted chose the terms.
        """
        fit = estimate(self.record, self.baseline, **(self.options | options))
        if self.intervals.source != NONE:
            return fit
        return fit.withheld("chosen", Warning("conditional_on_selection", self.intervals.text))

    @property
    def table(self) -> pd.DataFrame:
        """A row for each model that was judged, in order.

        `stage` is orders, terms or learner; `size` the number of lags, terms or weights; `score`
        the RMS error of free runs on held-out blocks in the output's unit, `standard_error` its
        own; `within` whether it is as good as the best of its stage; `seconds` what it took (of
        orders and learners the sum over its fits).
        """
        import pandas as pd

        rows = []
        for stage, judged in self._stages():
            for one in judged:
                rows.append(
                    {
                        "stage": stage,
                        "model": ", ".join(one.rung.change) or "physics alone",
                        "size": one.rung.size,
                        "score": one.rung.score,
                        "standard_error": one.error,
                        "within": one.within,
                        "chosen": one.chosen,
                        "seconds": one.rung.seconds,
                    }
                )
        return pd.DataFrame(rows)

    def _stages(self) -> list[tuple[str, Sequence[RankedModel]]]:
        stages: list[tuple[str, Sequence[RankedModel]]] = [("orders", self.orders.judge())]
        if self.terms is not None:
            stages.append(("terms", self.terms.judge()))
        if self.learners is not None:
            stages.append(("learner", self.learners.judge()))
        return stages

    def summary(self) -> str:
        """Return a page of text."""
        lines = [f"orders      {self.orders.chosen}"]
        lines += [f"delay       {delay}" for delay in self.delays]
        if self.nonlinearity is not None:
            lines.append(f"nonlinear   {self.nonlinearity}")
        lines.append(
            f"learner     {self.learner or 'none: nothing helps on the blocks that were held out'}"
        )
        lines.append(f"intervals   {self.intervals.source}: {self.intervals.text}")
        lines += (
            [f"physics     {shift}" for shift in self.physics.shifts]
            if self.physics and self.shares
            else []
        )
        if self.shares:
            width = max(len(term) for term in self.shares)
            lines += [
                "",
                f"{'term':<{width}}  chosen over halves of the data, p and q on the rows that "
                "were not used for it",
            ]
            for term, share in self.shares.items():
                one = self.confirmed.get(term)
                tested = "" if one is None else f"  {one.p:8.2g}  {one.q:8.2g}"
                lines.append(f"{term:<{width}}  {100 * share:3.0f} %{tested}")
        return "\n".join(
            [*lines, *(["", *(f"note: {note}" for note in self.notes)] if self.notes else [])]
        )


def rivals(runs: TermRuns, point: Point) -> dict[str, tuple[str, ...]]:
    """Return, best first, the candidates beside which a term significant at 5 % is not so.

    The products of lagged signals are like each other. Where the wrong one of two is chosen its
    coefficient is not zero: it is the best in the model without the other, and its interval holds
    that. So of each term all candidates are asked that encompass it, in the sense of Mizon and
    Richard (1986): with one of them in the model the term has nothing left to do.
    """
    nt, texts = len(point.c), runs.library.texts
    equations = runs.equations(point)
    known = [*range(nt), *(nt + i for i in point.chosen)]
    own = equations.of(known)
    stds, freedom = standard_errors(runs, point, own)
    size = np.sqrt(np.maximum(np.diag(equations.hessian), 1e-300))
    hessian, right = equations.hessian / np.outer(size, size), equations.right / size
    variance = (
        max(own.miss(own.solve()), 0.0)
        / max(own.rows - len(known), 1)
        / runs.independent_share(point)
    )
    least = reach(freedom) ** 2 * variance
    found = {}
    for place, i in enumerate(point.chosen):
        std = stds[nt + place]
        if std is None or abs(point.w[place]) < reach(freedom) * std:
            continue
        others = [column for column in known if column != nt + i]
        gram, left = _project_out(hessian, right, others)
        gains, kept = _gains_with_each(gram, left, nt + i)
        able = [k for k in np.flatnonzero(kept < least) if k not in known]
        able.sort(key=lambda k: -gains[k])
        if able:
            found[texts[i]] = tuple(texts[k - nt] for k in able[:_LISTED])
    return found


def _project_out(hessian: Matrix, right: Vector, known: list[int]) -> tuple[Matrix, Vector]:
    """Return the equations with some columns projected out."""
    across = hessian[:, known] @ np.linalg.pinv(
        hessian[np.ix_(known, known)], rcond=1e-12, hermitian=True
    )
    return hessian - across @ hessian[known], right - across @ right[known]


def _gains_with_each(gram: Matrix, right: Vector, column: int) -> tuple[Vector, Vector]:
    """Return the fall of the squared error by each column, and by a given one beside each."""
    size = np.diag(gram)
    able = size > DEPENDENT  # of columns of norm 1
    safe = np.where(able, size, 1.0)
    left = size[column] - gram[column] ** 2 / safe
    error = right[column] - gram[column] * right / safe
    gains = np.where(left > DEPENDENT, error**2 / np.where(left > DEPENDENT, left, 1.0), 0.0)
    return np.where(able, right**2 / safe, 0.0), np.where(able, gains, np.inf)
