"""What a reader of the documents has already: data files of his own, a record, a fit; small, and keyed."""

from __future__ import annotations

import runpy
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path

import numpy as np
import pandas as pd
from test_cli import run

import orthaug as oa


def measured(rows: int = 300, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Force and position of a mass-spring-damper that hardens; noise in the equation."""
    rng = np.random.default_rng(seed)
    u, y = np.repeat(rng.normal(size=rows // 4), 4), np.zeros(rows)
    for k in range(2, rows):
        y[k] = (
            1.5 * y[k - 1]
            - 0.7 * y[k - 2]
            + 0.1 * u[k - 1]
            - 0.1 * y[k - 1] ** 3
            + 0.001 * rng.normal()
        )
    return u, y


def file(name: str, seed: int) -> None:
    table = np.column_stack(measured(seed=seed))
    np.savetxt(name, table, delimiter=",", header="force,position", comments="", fmt="%.9g")


def friction(_: str) -> None:
    """The records of README, run1.csv and run2.csv, by the script that it names."""
    runpy.run_path(
        str(Path(__file__).resolve().parents[1] / "examples" / "readme.py"), run_name="__main__"
    )


def record() -> oa.Record:
    u, y = measured()
    return oa.Record.from_arrays(u, y, sampling_time=0.01, inputs=["force"], outputs=["position"])


def baseline() -> oa.Baseline:
    terms = {"theta1": "position[k-1]", "theta2": "position[k-2]", "theta3": "force[k-1]"}
    return oa.Baseline.from_terms([oa.Term(*term) for term in terms.items()])


@cache
def fit() -> oa.Estimate:
    return oa.estimate(record(), baseline(), learner=oa.MLP(hidden=(4,)))


def elsewhere(x: np.ndarray) -> np.ndarray:
    """A model that was trained with another tool."""
    return (1.5 * x[:, 0] - 0.7 * x[:, 1] + 0.1 * x[:, 2] - 0.1 * x[:, 0] ** 3)[:, None]


KEPT: dict[Path, bytes] = {}
"""The files of `result`, which is fitted once."""
OPEN: list = []
"""What has to be closed after a page."""
FILES = ("run1.csv", "run2.csv", "steps.csv", "new.csv")


def result(name: str) -> None:
    """A fitted spec, as a folder."""
    give(["run1.csv", "spec.toml"], {})
    if not KEPT:
        assert run("fit", "spec.toml", "--out", name).code == 0
        KEPT.update({path: path.read_bytes() for path in Path(name).rglob("*") if path.is_file()})
    for path, content in KEPT.items():
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)


def runs(name: str) -> None:
    """Parquet files of two experiments."""
    Path(name).mkdir()
    for i in range(2):
        frame().assign(run=i).to_parquet(f"{name}/{i}.parquet")


def frame() -> pd.DataFrame:
    return pd.DataFrame(dict(zip(("force", "position"), measured(), strict=True)))


def dask_frame() -> object:
    from dask.dataframe import from_pandas
    from distributed import Client

    OPEN.append(Client(processes=False, n_workers=1, threads_per_worker=1, dashboard_address=None))
    return from_pandas(frame(), npartitions=2)


def physics() -> oa.PhysicsMap:
    values = {"p1": "theta1", "p2": "theta2", "p3": "theta3"}
    parameters = [oa.PhysicalParameter(name, 0.5) for name in values]
    return oa.PhysicsMap.of(parameters, {theta: name for name, theta in values.items()})


def samples() -> list[tuple[np.ndarray, np.ndarray]]:
    u, y = measured(20)
    return [(u[k : k + 1], y[k : k + 1]) for k in range(len(u))]


BESIDE = {  # pages without comments: of a block, by its first line, what is given or why it is not run
    "README.md": {
        "make demo": "not run: makes an environment of its own; CI runs it",
        "[data]": "given: friction",
    },
    "docs/index.md": {"pip install": "not run: changes the environment that runs this test"},
}
FOLDERS = {"result": result, "runs": runs, "friction": friction}
NAMES: dict[str, Callable[[], object]] = {
    "files": lambda: sorted(str(path) for path in Path("runs").glob("*.parquet")),
    "dask_frame": dask_frame,
    "physics": physics,
    "model": lambda: fit().model,
    "samples": samples,
    "measured": samples,
    "measured_inputs": lambda: [inputs for inputs, _ in samples()],
    "oa": lambda: oa,
    "np": lambda: np,
    "record": record,
    "baseline": baseline,
    "fit": fit,
    "g": lambda: elsewhere,
}


def give(wanted: Sequence[str], names: dict) -> None:
    """Puts files into the working folder and the rest among the names of a page."""
    for one in wanted:
        if one in FILES:
            file(one, FILES.index(one))
        elif one in FOLDERS:
            FOLDERS[one](one)
        elif one == "spec.toml":
            Path(one).write_text(SPEC, encoding="utf-8")
        else:
            names[one] = NAMES[one]()


SPEC = """\
[data]
sampling_time = 0.01
inputs = ["force"]
outputs = ["position"]
train = { files = ["run1.csv"] }
[[baseline.terms]]
parameter = "theta1"
regressor = "position[k-1]"
[[baseline.terms]]
parameter = "theta2"
regressor = "position[k-2]"
[[baseline.terms]]
parameter = "theta3"
regressor = "force[k-1]"
[learner]
hidden = [4]
"""
