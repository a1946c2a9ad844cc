"""One fit over two processes that JAX joins, as over two hosts: the same θ as in memory, one result folder.

Run: python benchmarks/hosts.py
"""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import pandas as pd
from machine import describe

ROWS = 20_000
SPEC = """
[data]
sampling_time = 0.1
inputs = ["u"]
outputs = ["y"]
train = { files = ["rows.csv"] }
[lags]
na = 2
nb = 2
[learner]
hidden = [4]
[training]
iterations = 40
[[baseline.terms]]
parameter = "a"
regressor = "y[k-1]"
[[baseline.terms]]
parameter = "b"
regressor = "y[k-2]"
[[baseline.terms]]
parameter = "c"
regressor = "u[k-1]"
[engine]
kind = "KIND"
"""
_PROGRAM = [sys.executable, "-c", "from orthaug.commands.entry import main; main()"]


def started(folder: Path, kind: str, **environment: str) -> subprocess.Popen[str]:
    """`orthaug fit` in a process of its own."""
    spec = folder / f"{kind}.toml"
    spec.write_text(SPEC.replace("KIND", kind), encoding="utf-8")
    command = [*_PROGRAM, "fit", str(spec), "--out", str(folder / kind)]
    return subprocess.Popen(
        command, env=os.environ | environment, stdout=subprocess.PIPE, text=True
    )


def free_port() -> int:
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return one.getsockname()[1]


def main() -> None:
    print(describe())
    with tempfile.TemporaryDirectory() as name:
        folder, rng = Path(name), np.random.default_rng(0)
        u, y = rng.uniform(-1, 1, ROWS), np.zeros(ROWS)
        for k in range(2, ROWS):
            y[k] = (
                1.5 * y[k - 1]
                - 0.7 * y[k - 2]
                + 0.1 * u[k - 1]
                - 0.05 * np.tanh(8 * (y[k - 1] - y[k - 2]))
            )
        pd.DataFrame({"u": u, "y": y + 1e-3 * rng.normal(size=ROWS)}).to_csv(
            folder / "rows.csv", index=False
        )
        started(folder, "memory").communicate()
        joined = {"ORTHAUG_COORDINATOR": f"127.0.0.1:{free_port()}", "ORTHAUG_PROCESSES": "2"}
        began = time.perf_counter()
        both = [started(folder, "devices", **joined, ORTHAUG_PROCESS=str(i)) for i in range(2)]
        output = [process.communicate()[0].strip().splitlines()[-1] for process in both]
        seconds = time.perf_counter() - began
        found = [
            json.loads((folder / kind / "result.json").read_text())
            for kind in ("devices", "memory")
        ]
        thetas = [np.array([p["value"] for p in one["parameters"]]) for one in found]
        losses = [one["status"]["loss"] for one in found]
        iterations = [one["status"]["iterations"] for one in found]
    print(f"two processes: {seconds:.0f} s; iterations {iterations[0]}, in memory {iterations[1]}")
    print(
        f"θ apart {np.max(np.abs(thetas[0] / thetas[1] - 1)):.1e}, loss apart "
        f"{abs(losses[0] / losses[1] - 1):.1e}"
    )
    print(f"the second process said: {output[1]}")


if __name__ == "__main__":
    main()
