"""A Dask cluster of SLURM jobs for `orthaug fit`: python slurm.py 64 spec.toml out

It needs dask-jobqueue. Each job is one worker with one core; the files of the spec lie where all of them can read.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

SINGLE_THREADED = [
    "export OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1",
    'export XLA_FLAGS="--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"',
]
MEMORY, WALLTIME = "16GB", "04:00:00"


def with_engine(spec: Path, scheduler: str) -> Path:
    """The spec with its engine at a scheduler, beside it."""
    path = spec.with_name(f"{spec.stem}-cluster.toml")
    engine = f'\n[engine]\nkind = "dask"\nscheduler = "{scheduler}"\npartition_rows = 5000000\n'
    path.write_text(spec.read_text(encoding="utf-8") + engine, encoding="utf-8")
    return path


def main(workers: int, spec: Path, out: Path) -> int:
    from dask_jobqueue import SLURMCluster  # pyright: ignore[reportMissingImports]

    job = {
        "cores": 1,
        "processes": 1,
        "memory": MEMORY,
        "walltime": WALLTIME,
        "job_script_prologue": SINGLE_THREADED,
    }
    with SLURMCluster(**job) as cluster:
        cluster.scale(jobs=workers)
        cluster.wait_for_workers(workers)
        path = with_engine(spec, cluster.scheduler_address)
        return subprocess.run(
            ["orthaug", "fit", str(path), "--out", str(out), "--resume"], check=False
        ).returncode


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1]), Path(sys.argv[2]), Path(sys.argv[3])))
