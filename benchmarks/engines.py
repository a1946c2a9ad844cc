"""Engines: time against rows, memory of a stream, streams and clusters against rows in memory, a plan of 10¹⁰ rows.

Run: python benchmarks/engines.py [most rows, 2e7]     writes up to 0.4 GB into a temporary folder; a quarter of an hour
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from machine import describe
from scipy.signal import lfilter

import orthaug as oa
from orthaug._base.jax import jax
from orthaug._base.parallel import one_blas_thread
from orthaug.data.sources import RecordSource, witness
from orthaug.fitting.normal_equations import Blocks
from orthaug.fitting.one_step import OneStepTask
from orthaug.models.cluster import Dask, connect
from orthaug.models.rows import InMemory, Overlap
from orthaug.models.streaming import Stream
from orthaug.physics.streamed import StreamedProblem, pose_streamed

ROUNDS = 5
GROUP, BLOCK = 250_000, 1_000_000
BASELINE = oa.Baseline.from_terms(
    [oa.Term("a", "y[k-1]"), oa.Term("b", "y[k-2]"), oa.Term("c", "u[k-1]")]
)
LAGS, LEARNER = oa.Lags(na=3, nb=3, nk=1), oa.MLP(hidden=(10,))  # 6 regressors, 81 weights

SPEC = """
[data]
sampling_time = 0.1
inputs = ["u"]
outputs = ["y"]
train = {{ files = ["rows.parquet"] }}
[lags]
na = 3
nb = 3
[learner]
hidden = [10]
[training]
iterations = 3
regularization = "none"
[validation]
blocks = 0
[engine]
kind = "stream"
[[baseline.terms]]
parameter = "a"
regressor = "y[k-1]"
[[baseline.terms]]
parameter = "b"
regressor = "y[k-2]"
[[baseline.terms]]
parameter = "c"
regressor = "u[k-1]"
"""


def written(path: Path, rows: int) -> Path:
    """A file of a second-order system with a saturating spring."""
    rng, writer = np.random.default_rng(0), None
    for begin in range(0, rows, BLOCK):
        count = min(BLOCK, rows - begin)
        u = rng.uniform(-1, 1, count)
        y = lfilter([0, 0.1], [1, -1.4, 0.6], u)
        y = y + 0.05 * np.tanh(4 * y) + 1e-3 * rng.normal(size=count)
        table = pa.table({"u": u, "y": y})
        writer = writer or pq.ParquetWriter(path, table.schema)
        writer.write_table(table, row_group_size=GROUP)
    assert writer is not None
    writer.close()
    return path


def opened(path: Path, partition_rows: int = BLOCK) -> Any:
    return oa.open_parquet(
        [path], inputs=["u"], outputs=["y"], sampling_time=0.1, partition_rows=partition_rows
    )


def posed(source: Any, engine: Any) -> StreamedProblem:
    found = pose_streamed(source, witness(source), engine.passes, BASELINE, LAGS)
    assert isinstance(found, StreamedProblem)
    return found


def a_pass(task: OneStepTask) -> Callable[[], Any]:
    """One linearisation: what an iteration costs."""
    w, names = np.asarray(task.bound.init(jax.random.key(0))), task.problem.baseline.names
    blocks, size = Blocks(task.bound), task.bound.size
    nothing = Overlap(np.zeros((len(names), size)), np.zeros(len(names)))
    return lambda: jax.block_until_ready(task.engine.sum(blocks, task.rows, w, nothing))


def fastest(work: Callable[[], Any], rounds: int = ROUNDS) -> float:
    """Seconds of the fastest of some rounds, after one that compiles."""
    work()
    taken = []
    for _ in range(rounds):
        begin = time.perf_counter()
        work()
        taken.append(time.perf_counter() - begin)
    return min(taken)


def read_whole(path: Path) -> None:
    with pq.ParquetFile(path) as file:
        for _ in file.iter_batches(batch_size=65_536):
            pass


def slope(rows: list[int], seconds: list[float]) -> float:
    """Of log time against log rows."""
    return float(np.polyfit(np.log(rows), np.log(seconds), 1)[0])


def against_rows(folder: Path, most: int) -> dict[str, Any]:
    """Seconds of a pass: streamed at all sizes, in memory as far as that is a matter of course."""
    sizes = [n for n in (100_000, 1_000_000, 5_000_000, 20_000_000) if n <= most]
    told: dict[str, list[float]] = {"stream": [], "memory": []}
    for rows in sizes:
        path = written(folder / f"{rows}.parquet", rows)
        rounds = ROUNDS if rows <= 1_000_000 else 2
        problem = posed(opened(path), Stream())
        told["stream"].append(
            fastest(a_pass(OneStepTask.of(problem, LEARNER, engine=Stream())), rounds)
        )
        if rows <= 5_000_000:
            told["memory"].append(
                fastest(a_pass(OneStepTask.of(problem, LEARNER, engine=InMemory())), rounds)
            )
        if rows < most and rows != 1_000_000:
            path.unlink()
    for name, seconds in told.items():
        pairs = ", ".join(f"{n:.0e}: {s:.3g} s" for n, s in zip(sizes, seconds, strict=False))
        print(f"a pass, {name}: {pairs}; slope {slope(sizes[: len(seconds)], seconds):.2f}")
    return told


def stream_over_memory(folder: Path) -> float:
    """A streamed pass over reading the file and the same pass in memory."""
    path = folder / "1000000.parquet"
    problem = posed(opened(path), Stream())
    streamed = a_pass(OneStepTask.of(problem, LEARNER, engine=Stream()))
    in_memory = a_pass(OneStepTask.of(problem, LEARNER, engine=InMemory()))
    ratios = [
        fastest(streamed, 2) / (fastest(lambda: read_whole(path), 2) + fastest(in_memory, 2))
        for _ in range(3)
    ]
    print(f"a streamed pass over reading the file and a pass in memory: {np.median(ratios):.2f}")
    return float(np.median(ratios))


def stream_memory(folder: Path, rows: int) -> float:
    """Peak memory [MB] of `orthaug fit` of a file, the whole command."""
    path = folder / f"{rows}.parquet"
    path = path if path.exists() else written(path, rows)
    path.rename(folder / "rows.parquet")
    (folder / "spec.toml").write_text(SPEC.format(), encoding="utf-8")
    code = (
        "import sys; from orthaug.commands.cli import main\ntry: main()\nexcept SystemExit: "
        "pass\nprint([line for line in open('/proc/self/status') if "
        "line.startswith('VmHWM')][0].split()[1])"
    )
    command = [
        sys.executable,
        "-c",
        code,
        "fit",
        str(folder / "spec.toml"),
        "--out",
        str(folder / f"out{rows}"),
    ]
    begin = time.perf_counter()
    ran = subprocess.run(command, capture_output=True, text=True, check=True)
    peak = int(ran.stdout.split()[-1]) / 1e3
    print(
        f"orthaug fit of {rows:.0e} rows, streamed, 3 iterations: "
        f"{time.perf_counter() - begin:.0f} s, {peak:.0f} MB"
    )
    return peak


def on_a_cluster(folder: Path) -> dict[str, float]:
    """A pass on two workers over the same in memory, on one over one thread, and what an iteration costs beside it."""
    source, found = opened(folder / "1000000.parquet", GROUP), {}
    for workers in (2, 1):
        client = connect(None, workers)
        try:
            engine = Dask(client)
            problem = posed(source, engine)
            on_workers = a_pass(OneStepTask.of(problem, LEARNER, engine=engine))
            here = posed(source, Stream())
            if workers == 2:
                in_memory = fastest(a_pass(OneStepTask.of(here, LEARNER, engine=InMemory())))
                found["two workers over memory"] = fastest(on_workers) / in_memory
                record = witness(source, 2000)
                small = posed(RecordSource(record, 3, 1000), engine)
                found["overhead [ms]"] = 1e3 * fastest(
                    a_pass(OneStepTask.of(small, LEARNER, engine=engine)), 20
                )
            else:
                found["one worker over one thread"] = fastest(on_workers) / single_threaded(folder)
        finally:
            client.close()
            client.cluster.close()
    for name, value in found.items():
        print(f"Dask, {name}: {value:.3g}")
    return found


THREAD = """
import sys; sys.path.insert(0, {here!r})
import engines as e
from pathlib import Path
problem = e.posed(e.opened(Path({path!r})), e.Stream())
print(e.fastest(e.a_pass(e.OneStepTask.of(problem, e.LEARNER, engine=e.InMemory()))))
"""


def single_threaded(folder: Path) -> float:
    """Seconds of a pass in memory on one thread."""
    script = THREAD.format(here=str(Path(__file__).parent), path=str(folder / "1000000.parquet"))
    one = {
        "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1",
        "OMP_NUM_THREADS": "1",
    }
    command = ["taskset", "-c", "0", sys.executable, "-c", script]
    run = subprocess.run(command, capture_output=True, text=True, check=True, env=os.environ | one)
    return float(run.stdout.split()[-1])


class Costs(NamedTuple):
    """Seconds of what an iteration on a cluster is made of."""

    row: float
    """A row, on one core."""
    add: float
    """Two partial sums added."""
    send: float
    """One partial sum between two workers."""
    task: float
    """The scheduler, for a task."""


def costs(folder: Path) -> Costs:
    """Measured here, but for a network of 1 GB/s with 1 ms: workers of one machine have none."""
    row = single_threaded(folder) / 1e6
    # 81 weights, the residual and 3 parameters
    part = np.random.default_rng(0).normal(size=(85, 85))
    add = fastest(lambda: [part + part for _ in range(1000)], 3) / 1000
    client = connect(None, 2)
    try:
        numbers = range(2000)
        task = fastest(lambda: client.gather(client.map(abs, numbers, pure=False)), 3) / len(
            numbers
        )
    finally:
        client.close()
        client.cluster.close()
    return Costs(row, add, 1e-3 + part.nbytes / 1e9, task)


def planned(cost: Costs, rows: float, workers: int, partition: float) -> float:
    """Seconds of an iteration on paper: a worker's rows or the scheduler, whichever is longer, and the tree of sums."""
    partitions = int(np.ceil(rows / partition))
    each = np.ceil(partitions / workers) * partition * cost.row
    levels = int(np.ceil(np.log(max(partitions, 2)) / np.log(8)))
    return max(each, 9 / 8 * partitions * cost.task) + levels * (
        cost.task + 8 * (cost.send + cost.add)
    )


def simulated(
    cost: Costs, rows: float, workers: int, partition: float, spread: float = 0.05
) -> float:
    """The same by events: tasks are given out one after another, workers differ, a sum waits for all its parts."""
    rng, partitions = np.random.default_rng(0), int(np.ceil(rows / partition))
    free, scheduler = np.zeros(workers), 0.0
    done = np.empty(partitions)
    speed = rng.normal(1.0, spread, workers).clip(0.5)
    for i in range(partitions):  # a partition stays where it was laid out
        scheduler += cost.task
        worker = i % workers
        free[worker] = max(free[worker], scheduler) + partition * cost.row * speed[worker]
        done[i] = free[worker]
    while len(done) > 1:
        groups = [done[i : i + 8] for i in range(0, len(done), 8)]
        order = np.argsort([group.max() for group in groups])
        summed = np.empty(len(groups))
        for g in order:
            scheduler = max(scheduler, groups[g].max()) + cost.task
            worker = int(np.argmin(free))
            free[worker] = max(free[worker], scheduler) + len(groups[g]) * (cost.send + cost.add)
            summed[g] = free[worker]
        done = summed
    return float(done[0])


def a_plan(
    cost: Costs, rows: float = 1e10, partition: float = 5e6
) -> list[tuple[int, float, float]]:
    """Seconds of an iteration of 10¹⁰ rows by workers: on paper, and simulated."""
    table = [
        (w, *(f(cost, rows, w, partition) for f in (planned, simulated)))
        for w in (1, 4, 16, 64, 256, 1024)
    ]
    print(f"costs: {cost}")
    for workers, paper, events in table:
        print(
            f"{workers} workers: {paper:.4g} s on paper, {events:.4g} s simulated, "
            f"{table[0][2] / events:.3g} times one"
        )
    return table


def main(most: int) -> None:
    print(describe())
    with tempfile.TemporaryDirectory() as name, one_blas_thread():
        folder = Path(name)
        against_rows(folder, most)
        stream_over_memory(folder)
        on_a_cluster(folder)
        a_plan(costs(folder))
        stream_memory(folder, most)


if __name__ == "__main__":
    main(int(float(sys.argv[1])) if len(sys.argv) > 1 else 20_000_000)
