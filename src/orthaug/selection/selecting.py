"""The verb `select`: orders and delay, a test for nonlinearity, and terms or a network."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import islice
from typing import TYPE_CHECKING, Any

import numpy as np

from orthaug._base.checks import check_count, check_number, check_type
from orthaug._base.errors import InputError, Warning
from orthaug._base.lines import plural
from orthaug.data.expressions import Lag
from orthaug.data.record import Record
from orthaug.data.regressors import Lags, in_order
from orthaug.fitting.criteria import Criterion, Simulation
from orthaug.fitting.estimation import estimate
from orthaug.fitting.held_out import held_out_blocks, mean_square, squared_errors
from orthaug.fitting.solvers.levenberg_marquardt import LevenbergMarquardt
from orthaug.inference.chosen_terms import NONE, Intervals
from orthaug.models.learners import MLP, Learner
from orthaug.models.rows import Engine, InMemory
from orthaug.models.tasks import runs_on
from orthaug.models.terms import Terms
from orthaug.physics.baseline import Baseline, regressor_of
from orthaug.physics.problem import Problem, pose
from orthaug.selection.candidates import candidates
from orthaug.selection.choice import LearnerSearch, Selection
from orthaug.selection.false_discoveries import LEVEL, Control
from orthaug.selection.forward import COLLINEAR
from orthaug.selection.kept_physics import PhysicsComparison, kept_physics
from orthaug.selection.nonlinearity import Nonlinearity, nonlinearity
from orthaug.selection.orders import Delay, Orders, OrderSearch, search_orders
from orthaug.selection.parts import AS_DECLARED, CONDITIONAL, Parts, of_parts, split_record
from orthaug.selection.term_path import (
    OnModel,
    PathModel,
    TermPath,
    climb,
    judge_all,
)
from orthaug.selection.term_runs import Point, TermRuns

if TYPE_CHECKING:
    pass

_ITERATIONS = 40  # of a network on a fold
_MUCH_BETTER = 0.5  # times the error of physics alone: terms that reach it are named, though unsure
_NAMED = 3  # of them


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
    folds = held_out_blocks(record, blocks, max(problem.first_row, _largest_order(lags)))
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
            else (f"{plural(one.hidden[0], 'neuron')} of {', '.join(one.inputs or ('all lags',))}",)
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


def _largest_order(lags: Lags) -> int:
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
_RIVALS = (
    "may be a substitute: {}. Beside the other term, the chosen term is not significant on the "
    "rows that are fitted. Its coefficient and interval are those of a model without the "
    "other; more varied inputs distinguish them."
)
_NOT_CONFIRMED = (
    "not confirmed on the rows that were not used for the choice: {}. The q-value there is "
    "above {:g} %: the term does nothing, or too little for so many rows. Its interval holds "
    "either way."
)
OnStage = Callable[[str, Any], None]
"""Called with the stage and each model that was judged; it may raise KeyboardInterrupt to keep what
there is.
"""


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
    halves: bool | Parts | None = None,
    fitted: Record | None = None,
    progress: OnStage | None = None,
    engine: Engine | None = None,
    collinear: float = COLLINEAR,
    level: float = LEVEL,
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
        halves: choose on the first half of the record, or of its experiments, and keep the other
            for the fit (`Selection.estimate`), whose intervals then hold as if the terms had been
            declared. None does so where either half has 200 usable rows, and where no network is
            chosen; `Parts` are halves that were cut already. Without halves all rows choose and are
            fitted, and there are no intervals after a choice of terms.
        fitted: other data for the fit, instead of halves: `record` chooses, and these have no say.
        progress: called with the stage and each model that was judged.
        engine: `Dask(client)` has the workers of a cluster judge the models; None for this
            machine's cores.
        collinear: share of a term's deviation that physics and the terms before it must leave: a
            term of which less is left lies within their span and is not taken, for it would take
            over a part of the physics. 0 takes all.
        level: the expected share of spurious terms among the chosen ones that is allowed; 1 takes
            any.

    Raises:
        InputError: several outputs, too few rows, terms that are none.
    """
    check_type(record, Record, "record", "a Record")
    check_type(learner, Terms | MLP | None, "learner", "Terms(…), MLP(…) or None")
    most, blocks = check_count(most, "most", least=0), check_count(blocks, "blocks", least=2)
    collinear = check_number(collinear, "collinear")
    if len(record.outputs) != 1:
        raise InputError(
            f"a structure is chosen for one output; the record has {len(record.outputs)}: "
            "choose for each."
        )
    baseline = Baseline(()) if baseline is None else baseline
    if baseline.function is not None:
        raise InputError(
            "a structure is chosen beside physics made of terms; this physics is a Python "
            "function. Write it as terms."
        )
    criterion = Simulation() if criterion is None else criterion
    if check_number(level, "level", positive=True) > 1:
        raise InputError(f"`level` is a share of the chosen terms, 1 or less; got {level:g}.")
    whole, heard, runner = record, _Listener(progress), runs_on(engine or InMemory())
    problem = pose(record, baseline)
    largest, least = _reach(problem, lags)
    parts = _parts(record, fitted, baseline, largest, halves, network=isinstance(learner, MLP))
    if parts.chooses is not record:
        record = parts.chooses
        problem = pose(record, baseline)
    orders = search_orders(problem, criterion, largest, least, blocks, heard.of("orders"), runner)
    names = [channel.name for channel in record.inputs]
    delays = tuple(
        Delay.of(record, i, largest.nk[i] + largest.nb[i], orders.chosen) for i in range(len(names))
    )
    even = [delay.correlation is None and delay.square is not None for delay in delays]
    asked = _with_every_input(orders.chosen, largest, even)
    layout = [str(lag) for lag in asked.lags.layout(problem.outputs, names)]
    tested = nonlinearity(problem, layout) if layout else None
    reach = _orders_with_inputs(orders.chosen, asked, tested, names, even)
    search = _Search(problem, criterion, largest, blocks, collinear, level, heard, runner)
    path, found, physics, notes = search.beyond(learner, orders, reach, tested, widths, most)
    if heard.stopped:
        notes.append(
            Warning(
                "stopped", "the search was stopped; the choice is among the models judged by then."
            )
        )
    chosen = (
        parts.fitted,
        baseline,
        criterion,
        delays,
        orders,
        tested,
        path,
        found,
        tuple(notes),
        heard.stopped,
    )
    selection = Selection(*chosen, physics, reach, parts.intervals, level)
    return _add_notes(selection, whole if fitted is None else fitted)


@dataclass(frozen=True, eq=False)
class _Search:
    """Settings of the search on the rows that choose, beyond linear lags."""

    problem: Problem
    criterion: Criterion
    largest: Orders
    blocks: int
    collinear: float
    level: float
    heard: _Listener
    runner: Any

    def beyond(
        self,
        learner: Learner | None,
        orders: OrderSearch,
        reach: Orders,
        tested: Nonlinearity | None,
        widths: Sequence[int],
        most: int,
    ) -> tuple[TermPath | None, LearnerSearch | None, PhysicsComparison | None, list[Warning]]:
        """Search terms or networks, whichever the learner is.

        Nothing where the search was stopped before.
        """
        problem, criterion, lags = self.problem, self.criterion, reach.lags
        if isinstance(learner, MLP) and not self.heard.stopped:
            listener = self.heard.of("learner")
            settings = (learner, widths, criterion, self.blocks, listener, self.runner)
            return None, search_learners(problem, lags, tested, *settings), None, []
        if not isinstance(learner, Terms) or self.heard.stopped:
            return None, None, None, []
        baseline, names = problem.baseline, [channel.name for channel in problem.record.inputs]
        runs, notes, considered = _terms(problem, learner, self.largest, criterion, self.collinear)
        near = [baseline.lags, reach.lags.layout(problem.outputs, names)]
        linear, at_most = (
            orders.linear_texts(problem.record, baseline),
            min(most, len(problem.rows) // 10),
        )
        control = Control(self.level, considered) if self.level < 1 else None
        path = climb(
            runs, self.blocks, at_most, self.heard.of("terms"), self.runner, near, linear, control
        )
        if not path.chosen.point.chosen:
            notes.append(_unconfirmed(path))
        physics = (
            kept_physics(runs, path.rungs[0].point, path.chosen.point) if baseline.names else None
        )
        return path, None, physics, notes + (physics.notes if physics else [])


def _unconfirmed(path: TermPath) -> Warning:
    """Return a note that no terms are chosen, with what those picked on all rows reach."""
    text = "no term surely lowers the error on blocks without which it was picked."
    alone = path.rungs[0].score
    best = next(one.rung for one in judge_all(path.rungs) if one.chosen)
    if best.size and best.score < _MUCH_BETTER * alone:
        texts = path.runs.library.texts
        names = ", ".join(texts[i] for i in best.point.chosen[:_NAMED])
        more = " and more" if len(best.point.chosen) > _NAMED else ""
        text += (
            f" Picked on all rows, {names}{more} would lower it from {alone:.3g} to "
            f"{best.score:.3g}, but without a block others are picked. Where these make sense, "
            "declare them as terms of the physics."
        )
    return Warning("nothing_helps", text)


def _parts(
    record: Record,
    fitted: Record | None,
    baseline: Baseline,
    largest: Orders,
    halves: bool | Parts | None,
    *,
    network: bool,
) -> Parts:
    """Return the rows that choose and those that are fitted."""
    lags = _lag_count(largest)
    if isinstance(halves, Parts):
        return halves
    if fitted is not None:
        return Parts(
            record, fitted, of_parts(sum(max(len(e) - lags, 0) for e in fitted.experiments))
        )
    if halves:
        return split_record(record, baseline, lags, least=1)
    if network:
        return Parts(record, record, CONDITIONAL)
    if halves is not None:
        return Parts(record, record, Intervals.empty("`halves` is false"))
    try:
        return split_record(record, baseline, lags)
    except InputError as error:
        return Parts(record, record, Intervals.empty(str(error)))


def lagged_rows(problem: Problem, lags: Lags | None) -> int:
    """Return the number of leading rows of an experiment that are lags, for the largest orders."""
    return _lag_count(_reach(problem, lags)[0])


def _lag_count(largest: Orders) -> int:
    return max(
        [largest.na, *(nk + nb - 1 for nk, nb in zip(largest.nk, largest.nb, strict=True) if nb)]
    )


def _add_notes(found: Selection, declared: Record) -> Selection:
    """Return the selection with what is to be said of its intervals.

    Of all rows where nothing was chosen.
    """
    if found.learner is None:
        return replace(found, record=declared, intervals=AS_DECLARED)
    notes = []
    if found.intervals.source in (NONE, CONDITIONAL.source):
        notes.append(Warning("conditional_on_selection", found.intervals.text))
    if isinstance(found.learner, Terms) and not found.shares:
        why = (
            "too few rows chose"
            if found.terms
            else "linear lags are chosen as orders, not out of a library"
        )
        notes.append(
            Warning(
                "shares_unknown", f"how often a term is chosen over halves is not known: {why}."
            )
        )
    if found.rivals:
        listed = "; ".join(
            f"{term} for {' or '.join(others)}" for term, others in found.rivals.items()
        )
        notes.append(Warning("terms_have_rivals", _RIVALS.format(listed)))
    if found.unconfirmed:
        text = _NOT_CONFIRMED.format(", ".join(found.unconfirmed), 100 * found.level)
        notes.append(Warning("terms_not_confirmed", text))
    return replace(found, notes=(*found.notes, *notes))


class _Listener:
    """Hands on what was judged, and remembers whether it was asked to stop."""

    def __init__(self, progress: OnStage | None) -> None:
        self.progress, self.stopped = progress, False

    def of(self, stage: str) -> Callable[[Any], None]:
        def report(rung: PathModel) -> None:
            try:
                if self.progress is not None:
                    self.progress(stage, rung)
            except KeyboardInterrupt:
                self.stopped = True
                raise

        return report


def _with_every_input(chosen: Orders, largest: Orders, even: Sequence[bool]) -> Orders:
    """Return the chosen orders, and of some inputs all lags that are allowed.

    These are inputs without a lag, and those of which the square alone is correlated: of an `even`
    function no linear lag helps but those that the physics reads.
    """
    every = [one or not n for one, n in zip(even, chosen.nb, strict=True)]
    nb = [most if e else n for e, n, most in zip(every, chosen.nb, largest.nb, strict=True)]
    nk = [first if e else k for e, k, first in zip(every, chosen.nk, largest.nk, strict=True)]
    return replace(chosen, nb=tuple(nb), nk=tuple(nk))


def _orders_with_inputs(
    chosen: Orders,
    asked: Orders,
    tested: Nonlinearity | None,
    names: Sequence[str],
    even: Sequence[bool],
) -> Orders:
    """Return the chosen orders with the inputs that have only a nonlinear effect."""
    nb, nk = list(chosen.nb), list(chosen.nk)
    for i, name in enumerate(names):
        if (chosen.nb[i] and not even[i]) or tested is None or not tested.found:
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
) -> tuple[TermRuns, list[Warning], int]:
    """Return the runs of the library of terms, notes, and the number of candidates."""
    outputs, inputs = problem.outputs, tuple(channel.name for channel in problem.record.inputs)
    lags = largest.lags.layout(outputs, inputs)
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
    return TermRuns.of(problem, able.library, criterion, None, collinear), notes, able.considered


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
