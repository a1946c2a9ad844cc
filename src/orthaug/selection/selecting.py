"""The verb `select`: orders and delay, a test for nonlinearity, and terms or a network."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from itertools import islice
from typing import TYPE_CHECKING, Any

import numpy as np

from orthaug._base.checks import check_count, check_number, check_type
from orthaug._base.errors import InputError, Warning
from orthaug.data.expressions import Lag
from orthaug.data.record import Record
from orthaug.data.regressors import Lags, in_order
from orthaug.data.terms import CONSTANT
from orthaug.fitting.criteria import Criterion, Simulation
from orthaug.fitting.estimation import estimate
from orthaug.fitting.held_out import blocked, mean_square, squared_errors
from orthaug.fitting.solvers.levenberg_marquardt import LevenbergMarquardt
from orthaug.models.learners import MLP, Learner
from orthaug.models.rows import Engine, InMemory
from orthaug.models.tasks import runs_on
from orthaug.models.terms import Terms
from orthaug.physics.baseline import Baseline
from orthaug.physics.problem import Problem, pose, regressor_of
from orthaug.selection.candidates import candidates
from orthaug.selection.forward import COLLINEAR
from orthaug.selection.kept_physics import PhysicsComparison, kept_physics
from orthaug.selection.nonlinearity import Nonlinearity, nonlinearity
from orthaug.selection.orders import Delay, Orders, OrderSearch, search_orders
from orthaug.selection.term_path import OnModel, PathModel, RankedModel, Search, TermPath, climb
from orthaug.selection.term_runs import Point, TermRuns

if TYPE_CHECKING:
    import pandas as pd

    from orthaug.fitting.estimates import Estimate

_ITERATIONS = 40  # of a network on a fold


@dataclass(frozen=True, eq=False)
class LearnerSearch(Search):
    """Networks, physics alone first."""

    learners: tuple[MLP | None, ...]

    @property
    def chosen(self) -> MLP | None:
        """Network of the choice; None for physics alone."""
        return self.learners[self.place]


def search_learners(
    problem: Problem,
    lags: Lags,
    tested: Nonlinearity | None,
    learner: MLP,
    widths: Sequence[int],
    criterion: Criterion,
    blocks: int,
    report: OnModel,
    runner: Any,
) -> LearnerSearch:
    """Judge every width on all lags, and on those whose functions matter by themselves.

    Raises:
        InputError: too few rows for so many blocks.
    """
    record, baseline = problem.record, problem.baseline
    seen: list[tuple[str, ...] | None] = [learner.inputs]
    if tested is not None and tested.matter and learner.inputs is None:
        seen.append(tested.matter)
    tried: list[MLP | None] = [None]
    tried += [
        replace(learner, hidden=(width,), inputs=inputs) for inputs in seen for width in widths
    ]
    folds = blocked(record, blocks, max(problem.first_row, _largest(lags)))
    names = (
        tuple(channel.name for channel in record.outputs),
        tuple(channel.name for channel in record.inputs),
    )
    given, rungs = (baseline, lags, criterion, folds), []
    found = runner.map(_on_fold, given, [(one, i) for one in tried for i in range(len(folds))])
    for one in tried:
        held, seconds = zip(*islice(found, len(folds)), strict=True)
        nz = (
            0 if one is None else len(one.inputs if one.inputs is not None else lags.layout(*names))
        )
        size = 0 if one is None else one.weights(nz, 1)
        words = (
            ()
            if one is None
            else (f"{one.hidden[0]} neurons of {', '.join(one.inputs or ('all lags',))}",)
        )
        rungs.append(
            PathModel(
                Point((), np.zeros(0), np.zeros(0)), words, np.array(held), sum(seconds), size
            )
        )
        try:
            report(rungs[-1])
        except KeyboardInterrupt:
            break
    return LearnerSearch(tuple(rungs), tuple(tried[: len(rungs)]))


def _largest(lags: Lags) -> int:
    nb, nk = (np.atleast_1d(part) for part in (lags.nb, lags.nk))
    return int(max(np.max(lags.na, initial=0), np.max(nb + nk - 1, initial=0)))


def _on_fold(
    given: Any, item: tuple[MLP | None, int], report: Callable[..., None]
) -> tuple[float, float]:
    """Return the mean squared error of free runs on a block that was held out, and seconds.

    The error is infinite without a model.
    """
    began, (learner, number), (baseline, lags, criterion, folds) = time.monotonic(), item, given
    kept, held = folds[number]
    options = {
        "solver": LevenbergMarquardt(_ITERATIONS),
        "blocks": 0,
        "fallback": False,
        "criterion": criterion,
    }
    if learner is not None:
        options |= {"lags": lags, "regularization": "evidence"}
    error = np.inf
    with suppress(InputError):  # the block took away what the physics needs
        fit = estimate(kept, baseline, learner=learner, **options)
        error = (
            mean_square(squared_errors(fit.model.simulate(held), 1.0)) if fit.status.ok else np.inf
        )
    return error, time.monotonic() - began


MOST = 60
"""Terms on the path forward."""
LARGEST = (4, 5)
"""na and nb up to which orders are searched where nothing is said."""
WIDTHS = (4, 8, 16)
"""Hidden neurons that are tried where nothing is said."""
_CONDITIONAL = (
    "intervals of a fit on these data are conditional on the choice, which was made on them; "
    "with `halves` one half of the data chooses and the other is fitted."
)
OnStage = Callable[[str, Any], None]
"""Called with the stage and each model that was judged; it may raise KeyboardInterrupt to keep what
there is.
"""


def _unheard(stage: str, rung: Any) -> None:
    """Ignore a model; used where nobody listens."""


@dataclass(frozen=True, eq=False)
class Selection:
    """Result of `select`.

    Print `selection.summary()`; take `selection.table`; go on with `selection.estimate()`.
    """

    record: Record = field(repr=False)
    """What `estimate` fits: the record, or the half that the choice was not made on."""
    baseline: Baseline
    criterion: Criterion
    delays: tuple[Delay, ...]
    orders: OrderSearch
    nonlinearity: Nonlinearity | None
    terms: TermPath | None
    learners: LearnerSearch | None
    notes: tuple[Warning, ...]
    stopped: bool = False
    """Whether the search was stopped before its end; what it had found by then was chosen from."""
    physics: PhysicsComparison | None = None
    """θ of physics alone beside θ with the chosen terms; None where no terms were searched, or
    there is no physics.
    """
    reach: Orders | None = None
    """The orders that were chosen, with lags of inputs that act by a nonlinear function alone; None
    for no such.
    """

    @property
    def lags(self) -> Lags:
        """Chosen orders, and lags of inputs that have only a nonlinear effect."""
        chosen = self.reach or self.orders.chosen
        return Lags(chosen.na, chosen.nb, chosen.nk)

    @cached_property
    def learner(self) -> Learner | None:
        """The learner that was chosen, written out; None where nothing helps."""
        if self.learners is not None:
            return self.learners.chosen
        if self.terms is not None:
            chosen, texts = self.terms.chosen.point.chosen, self.terms.runs.library.texts
            return Terms(tuple(texts[i] for i in chosen)) if chosen else None
        linear = _beside(self.orders, self.record, self.baseline)
        return Terms(tuple(linear)) if linear else None

    @cached_property
    def shares(self) -> dict[str, float]:
        """Share of random halves of the data on which each chosen term is chosen again."""
        return {} if self.terms is None else self.terms.shares()

    @property
    def options(self) -> dict[str, Any]:
        """Arguments for `estimate`, beside record and baseline."""
        judged = (
            {"regularization": "none", "fallback": False} if isinstance(self.learner, Terms) else {}
        )
        lags = None if isinstance(self.learner, Terms | None) else self.lags
        return {"learner": self.learner, "lags": lags, "criterion": self.criterion} | judged

    def estimate(self, **options: Any) -> Estimate:
        """Return the fit of the choice; `options` of `estimate` beside it."""
        return estimate(self.record, self.baseline, **(self.options | options))

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
        stages: list[tuple[str, Sequence[RankedModel]]] = [("orders", self.orders.judged())]
        if self.terms is not None:
            stages.append(("terms", self.terms.judged()))
        if self.learners is not None:
            stages.append(("learner", self.learners.judged()))
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
        lines += (
            [f"physics     {shift}" for shift in self.physics.shifts]
            if self.physics and self.shares
            else []
        )
        if self.shares:
            width = max(len(term) for term in self.shares)
            lines += ["", f"{'term':<{width}}  chosen over halves of the data"]
            lines += [
                f"{term:<{width}}  {100 * share:3.0f} %" for term, share in self.shares.items()
            ]
        return "\n".join(
            [*lines, *(["", *(f"note: {note}" for note in self.notes)] if self.notes else [])]
        )


def select(
    record: Record,
    baseline: Baseline | None = None,
    *,
    learner: Learner | None = Terms(degree=3),  # noqa: B008  (frozen)
    lags: Lags | None = None,
    criterion: Criterion | None = None,
    widths: Sequence[int] = WIDTHS,
    most: int = MOST,
    blocks: int = 5,
    halves: bool = False,
    progress: OnStage = _unheard,
    engine: Engine | None = None,
    collinear: float = COLLINEAR,
) -> Selection:
    """Choose orders and delay, and terms or a network, by free runs on held-out blocks of the data.

    Terms are picked by what they lower the error by beside the physics, which is projected out
    (forward orthogonal regression on the sensitivities of the free run). The choice is the smallest
    model within one standard error of the best, or within 2 % of its error.

    Args:
        record: measured inputs and one output.
        baseline: the physics, which is always in the model; None for none.
        learner: `Terms(…)`, whose library is chosen from; `MLP(…)`, whose width and inputs are
            chosen; None to choose linear lags only.
        lags: the largest orders, and the smallest delay; by default na = 4, nb = 5 from the first
            lag of an input that the physics reads, or from 1.
        criterion: what models are trained on; None for the free run.
        widths: hidden neurons that are tried.
        most: terms at most.
        blocks: held out in turn.
        halves: choose on the first half of the record, and keep the other for the fit
            (`Selection.estimate`), whose intervals are then not conditional on the choice.
        progress: called with the stage and each model that was judged.
        engine: `Dask(client)` has the workers of a cluster judge the models; None for this
            machine's cores.
        collinear: share of a term's deviation that physics and the terms before it must leave: a
            term of which less is left lies within their span and is not taken, for it would take
            over a part of the physics. 0 takes all.

    Raises:
        InputError: several outputs, too few rows, terms that are none.
    """
    check_type(record, Record, "record", "a Record")
    check_type(learner, Terms | MLP | None, "learner", "Terms(…), MLP(…) or None")
    most, blocks = check_count(most, "most", least=0), check_count(blocks, "blocks", least=2)
    collinear = check_number(collinear, "collinear")
    if len(record.outputs) != 1:
        raise InputError(
            f"structure is chosen for one output; the record has {len(record.outputs)}: choose "
            "for each."
        )
    baseline = Baseline(()) if baseline is None else baseline
    if baseline.function is not None:
        raise InputError(
            "structure is chosen beside physics that are terms; of a Python function nothing "
            "is known."
        )
    criterion = Simulation() if criterion is None else criterion
    record, kept = record.split(0.5) if halves else (record, record)
    problem, heard, runner = (
        pose(record, baseline),
        _Listener(progress),
        runs_on(engine or InMemory()),
    )
    largest, least = _reach(problem, lags)
    orders = search_orders(problem, criterion, largest, least, blocks, heard.of("orders"), runner)
    names = [channel.name for channel in record.inputs]
    delays = tuple(
        Delay.of(record, i, largest.nk[i] + largest.nb[i], orders.chosen) for i in range(len(names))
    )
    layout = partial(_layout, problem.outputs, names)
    asked = _with_every_input(orders.chosen, largest)
    tested = nonlinearity(problem, [str(lag) for lag in layout(asked)]) if layout(asked) else None
    reach = _reached(orders.chosen, asked, tested, names)
    path = found = physics = None
    notes: list[Warning] = []
    if isinstance(learner, Terms) and not heard.stopped:
        runs, notes = _terms(problem, learner, largest, criterion, collinear)
        near, linear = [baseline.lags, layout(reach)], _beside(orders, record, baseline)
        at_most = min(most, len(problem.rows) // 10)
        path = climb(runs, blocks, at_most, heard.of("terms"), runner, near, linear)
        if not path.chosen.point.chosen:
            notes.append(
                Warning(
                    "nothing_helps",
                    "no term lowers the error on blocks without which it was picked.",
                )
            )
        physics = (
            kept_physics(runs, path.rungs[0].point, path.chosen.point) if baseline.names else None
        )
        notes += physics.notes if physics else []
    elif isinstance(learner, MLP) and not heard.stopped:
        report = heard.of("learner")
        lags = Lags(reach.na, reach.nb, reach.nk)
        found = search_learners(
            problem, lags, tested, learner, widths, criterion, blocks, report, runner
        )
    if heard.stopped:
        notes.append(
            Warning(
                "stopped", "the search was stopped; the choice is among the models judged by then."
            )
        )
    if not halves:
        notes.append(Warning("conditional_on_selection", _CONDITIONAL))
    return Selection(
        kept,
        baseline,
        criterion,
        delays,
        orders,
        tested,
        path,
        found,
        tuple(notes),
        heard.stopped,
        physics,
        reach,
    )


class _Listener:
    """Hands on what was judged, and remembers whether it was asked to stop."""

    def __init__(self, progress: OnStage) -> None:
        self.progress, self.stopped = progress, False

    def of(self, stage: str) -> Callable[[Any], None]:
        def report(rung: Any) -> None:
            try:
                self.progress(stage, rung)
            except KeyboardInterrupt:
                self.stopped = True
                raise

        return report


def _layout(outputs: Sequence[str], inputs: Sequence[str], orders: Orders) -> tuple[Lag, ...]:
    return Lags(orders.na, orders.nb, orders.nk).layout(outputs, inputs)


def _beside(orders: OrderSearch, record: Record, baseline: Baseline) -> list[str]:
    """Return the linear lags of the choice, and its constant, that the physics does not have."""
    outputs, inputs = (
        [channel.name for channel in group] for group in (record.outputs, record.inputs)
    )
    own = {term.regressor for term in baseline.terms}
    linear = [str(lag) for lag in _layout(outputs, inputs, orders.chosen)]
    return [text for text in [*linear, *([CONSTANT] * orders.constant)] if text not in own]


def _with_every_input(chosen: Orders, largest: Orders) -> Orders:
    """Return the chosen orders, and of inputs that they keep no lag of all that are allowed.

    An even function of an input has no linear correlation with it, so no linear lag of the input
    helps.
    """
    nb = tuple(n or most for n, most in zip(chosen.nb, largest.nb, strict=True))
    nk = tuple(
        k if n else first for n, k, first in zip(chosen.nb, chosen.nk, largest.nk, strict=True)
    )
    return replace(chosen, nb=nb, nk=nk)


def _reached(
    chosen: Orders, asked: Orders, tested: Nonlinearity | None, names: Sequence[str]
) -> Orders:
    """Return the chosen orders with the inputs that have only a nonlinear effect."""
    nb, nk = list(chosen.nb), list(chosen.nk)
    for i, name in enumerate(names):
        if chosen.nb[i] or tested is None or not tested.found:
            continue
        own = [
            k
            for k in range(asked.nk[i], asked.nk[i] + asked.nb[i])
            if str(Lag(name, k)) in tested.matter
        ]
        if own or not tested.matter:
            nk[i] = min(own, default=asked.nk[i])
            nb[i] = max(own) - nk[i] + 1 if own else asked.nb[i]
    return replace(chosen, nb=tuple(nb), nk=tuple(nk))


def _terms(
    problem: Problem, learner: Terms, largest: Orders, criterion: Criterion, collinear: float
) -> tuple[TermRuns, list[Warning]]:
    """Return the prepared library of terms, and its warnings."""
    outputs, inputs = problem.outputs, tuple(channel.name for channel in problem.record.inputs)
    lags = Lags(largest.na, largest.nb, largest.nk).layout(outputs, inputs)
    known = regressor_of(problem.baseline, None, None, outputs, inputs)[0]
    library = learner.library([str(lag) for lag in in_order({*lags, *known}, outputs, inputs)])
    rows = len(problem.rows)
    able = candidates(problem, library)
    notes = list(able.notes)
    if len(library) > rows:
        text = (
            f"there are {len(library)} candidate terms and {rows} rows; at most a tenth as "
            "many terms are chosen."
        )
        notes.append(Warning("more_terms_than_rows", text))
    return TermRuns.of(problem, able.library, criterion, None, collinear), notes


def _reach(problem: Problem, lags: Lags | None) -> tuple[Orders, Orders]:
    """Return the largest orders that are looked at, and those that the physics reads already."""
    output, inputs = problem.outputs[0], [channel.name for channel in problem.record.inputs]
    read: dict[str, list[int]] = {name: [] for name in (output, *inputs)}
    for lag in problem.baseline.lags:
        read[lag.channel].append(lag.lag)
    least = Orders(
        max(read[output], default=0),
        tuple(max(read[name]) - min(read[name]) + 1 if read[name] else 0 for name in inputs),
        tuple(min(read[name], default=0) for name in inputs),
    )
    if lags is None:
        nk = tuple(min(read[name], default=1) for name in inputs)
        largest = Orders(max(LARGEST[0], least.na), tuple(max(LARGEST[1], n) for n in least.nb), nk)
    else:
        places = lags.layout((output,), inputs)
        own = {
            name: [lag.lag for lag in places if lag.channel == name] for name in (output, *inputs)
        }
        own = {name: [*found, *read[name]] for name, found in own.items()}
        nk = tuple(min(own[name], default=1) for name in inputs)
        nb = tuple(
            max(own[name], default=0) - n + 1 if own[name] else 0
            for name, n in zip(inputs, nk, strict=True)
        )
        largest = Orders(max(own[output], default=0), nb, nk)
    unread = tuple(
        k if not n else m for k, n, m in zip(largest.nk, least.nb, least.nk, strict=True)
    )
    return largest, replace(least, nk=unread)
