"""Independent runs as tasks of a Dask cluster.

Restarts, held-out blocks, candidates of a selection and cases of a study are such runs.

What all runs share is sent once and goes from worker to worker; each run is whole at one place. A
task that a lost worker had is made again elsewhere, so results do not depend on who made them.
"""

from __future__ import annotations

import time
import uuid
from collections import defaultdict, deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from orthaug._base.jax import jax
from orthaug._base.parallel import (
    Given,
    Heard,
    Item,
    Result,
    RunCancelled,
    iterate_results,
    nobody,
    one_blas_thread,
    one_core,
)
from orthaug.models.cluster import Dask, cluster_errors, keep_on_worker, smallest_worker
from orthaug.models.rows import Engine, InMemory, Room

if TYPE_CHECKING:
    from distributed import Future

_MATRICES = 3  # of a run in memory
_WAIT = 0.5  # s between two looks at whether a run is still wanted, and two reports of a run
_ANY_SIZE = {
    "distributed.admin.large-graph-warning-threshold": "1 PB"
}  # rows are sent on purpose, and once


@dataclass(frozen=True)
class Tasks(InMemory):
    """Rows in memory, wherever a run is made; independent runs are tasks of a cluster.

    `client` is a `distributed.Client`.
    """

    client: Any = None
    _sent: dict[int, tuple[object, Future]] = field(default_factory=dict, compare=False, repr=False)

    def __reduce__(self) -> tuple[Callable[..., object], tuple[object, ...]]:
        return InMemory, (self.limit,)  # on a worker

    def map(
        self,
        function: Callable[[Given, Item, Callable[..., None]], Result],
        given: Given,
        items: Sequence[Item],
        heard: Heard = nobody,
    ) -> Iterator[Result]:
        """Yield the results of independent runs, as `Threads.map`.

        The function, its arguments and results are pickled, `given` once while it is the same.
        """
        shared = self._share(given)
        with _heard_on(self.client) as (topic, said):

            def one(numbered: tuple[int, Item], check: Callable[[], None]) -> Result:
                i, item = numbered

                def look() -> None:
                    check()
                    while said[i]:
                        heard(i, *said[i].popleft())

                return ask(
                    self.client,
                    look,
                    _make_run,
                    shared,
                    DoublePrecision((function, item)),
                    topic,
                    i,
                )

            yield from iterate_results(one, list(enumerate(items)), places(self.client))

    def room(self) -> Room:
        """Return the memory of the smallest worker, which makes whole runs."""
        return smallest_worker(self.client, _MATRICES)

    def _share(self, given: object) -> Future:
        """Return the reference by which workers know `given`."""
        from dask import config

        if id(given) not in self._sent:
            self._sent.clear()
            with cluster_errors(), config.set(_ANY_SIZE):
                self._sent[id(given)] = (
                    given,
                    self.client.submit(keep_on_worker, DoublePrecision(given), pure=False),
                )
        return self._sent[id(given)][1]


def runs_on(engine: Engine) -> Engine:
    """Return the engine for several runs over rows in memory: with a cluster they are its tasks."""
    return Tasks(client=engine.client) if isinstance(engine, Dask) else engine


def places(client: Any) -> int:
    """Return the number of tasks that the workers take at a time."""
    return max(sum(client.nthreads().values()), 1)


def ask(
    client: Any,
    check: Callable[[], None],
    function: Callable[..., Result],
    *args: object,
    **named: object,
) -> Result:
    """Return the result of a function that a worker computes.

    `check` is called now and then, and may raise to give it up.
    """
    from distributed import wait

    with cluster_errors():
        future = client.submit(function, *args, pure=False, **named)
        try:
            while not future.done():
                check()
                with suppress(TimeoutError):
                    wait(future, timeout=_WAIT)
            return future.result()
        except BaseException:
            future.cancel()
            raise


@contextmanager
def _heard_on(client: Any) -> Iterator[tuple[str, dict[int, deque[tuple[float, ...]]]]]:
    """Yield a topic on which tasks report, and the reports of each task."""
    topic, said = f"orthaug-{uuid.uuid4().hex}", defaultdict[int, deque[tuple[float, ...]]](deque)

    def hear(event: tuple[object, tuple[int, tuple[float, ...]]]) -> None:
        i, what = event[1]
        said[i].append(what)

    with cluster_errors():
        client.subscribe_topic(topic, hear)
    try:
        yield topic, said
    finally:
        client.unsubscribe_topic(topic)


@dataclass(frozen=True, eq=False)
class DoublePrecision:
    """A value that reaches a worker in double precision.

    JAX would cut its arrays where double precision is not turned on yet.
    """

    value: Any

    def __reduce__(self) -> tuple[Callable[..., object], tuple[object, ...]]:
        return _seal, (_Double(), self.value)  # made in this order there


class _Double:
    """Switch that turns on double precision where it arrives."""

    def __reduce__(self) -> tuple[Callable[..., object], tuple[object, ...]]:
        return _in_double, ()


def _in_double() -> None:
    _ = jax.config  # what turns it on


def _seal(_: None, value: object) -> DoublePrecision:
    return DoublePrecision(value)


def _make_run(shared: DoublePrecision, asked: DoublePrecision, topic: str, number: int) -> Any:
    """Make a run on a worker.

    Its reports go to the client from time to time.
    """
    from dask.context import thread_state
    from distributed import get_worker

    worker, key, last = get_worker(), thread_state.key, time.monotonic()

    def report(*what: float) -> None:
        nonlocal last
        if time.monotonic() - last < _WAIT:
            return
        last = time.monotonic()
        task = worker.state.tasks.get(key)
        if task is None or task.state == "cancelled":
            raise RunCancelled
        worker.log_event(topic, (number, tuple(float(value) for value in what)))

    with one_blas_thread(), one_core():
        function, item = asked.value
        return function(shared.value, item, report)
