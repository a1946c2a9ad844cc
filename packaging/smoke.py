"""What must work wherever orthaug is installed: the demo, a fit, a saved model, its code in C. Needs no test framework.

Run: python packaging/smoke.py [WHEEL]    with the Python that orthaug is installed for; `make smoke` makes such a one
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

WHEEL_LIMIT = 1_000_000  # bytes
IMPORT_LIMIT = 0.1  # s, the best of three processes
IMPORT = "import time; t = time.perf_counter(); import orthaug; print(time.perf_counter() - t)"


def main() -> None:
    for wheel in sys.argv[1:]:
        size = Path(wheel).stat().st_size
        _check(size <= WHEEL_LIMIT, f"the wheel has {size} bytes, at most {WHEEL_LIMIT}")
    seconds = min(float(_output("-c", IMPORT)) for _ in range(3))
    _check(
        seconds <= IMPORT_LIMIT, f"import orthaug takes {seconds:.3f} s, at most {IMPORT_LIMIT} s"
    )
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        try:
            _commands()
            _library()
        finally:
            os.chdir(os.path.dirname(folder))


def _commands() -> None:
    """Demo, fit, prediction and export from the command line."""
    import orthaug

    _check(
        _orthaug("--version").split() == ["orthaug", orthaug.__version__],
        f"version {orthaug.__version__}",
    )
    _orthaug("demo", "--out", "demo")
    _check(
        Path("demo/report.html").is_file() and Path("demo/figures").is_dir(),
        "orthaug demo writes a result",
    )
    spec = (
        Path("demo/spec.toml")
        .read_text(encoding="utf-8")
        .replace("iterations = 100", "iterations = 5")
    )
    for name in ("train", "test"):
        spec = spec.replace(f'"{name}.csv"', f'"demo/{name}.csv"')
    Path("short.toml").write_text(spec, encoding="utf-8")
    _orthaug("fit", "short.toml", "--out", "short")
    _check(Path("short/result.json").is_file(), "orthaug fit writes a result")
    lines = _orthaug("predict", "short", "demo/test.csv").splitlines()
    _check(
        len(lines) == 1 + len(Path("demo/test.csv").read_text(encoding="utf-8").splitlines()[1:]),
        "orthaug predict",
    )
    _orthaug("export", "short", "--to", "c", "--out", "code")
    _check(
        "model_step" in Path("code/model.c").read_text(encoding="utf-8"), "orthaug export --to c"
    )


def _library() -> None:
    """A fit in Python, saved, loaded again and exported."""
    import numpy as np

    import orthaug as oa

    u = np.random.default_rng(0).standard_normal(300)
    y = np.zeros(300)
    for k in range(1, 300):
        y[k] = 0.5 * y[k - 1] + u[k - 1] + 0.1 * u[k - 1] ** 3
    record = oa.Record.from_arrays(y=y, u=u, sampling_time=0.1)
    baseline = oa.Baseline.from_terms([oa.Term("a", "y[k-1]"), oa.Term("b", "u[k-1]")])
    fit = oa.estimate(record, baseline, learner=oa.MLP(hidden=(4,)))
    _check(fit.status.ok and fit.parameters.shape[0] == 2, "oa.estimate")
    oa.save(fit.model, "saved")
    again = oa.load("saved").predict(record).trajectories[0].model
    _check(
        bool(
            np.array_equal(again, fit.model.predict(record).trajectories[0].model, equal_nan=True)
        ),
        "oa.load",
    )
    oa.export(fit.model, "code-from-python", to="c")
    _check(Path("code-from-python/model.c").is_file(), "oa.export")


def _orthaug(*arguments: str) -> str:
    began = time.perf_counter()
    output = _output("-m", "orthaug", *arguments)
    print(f"orthaug {' '.join(arguments)}: {time.perf_counter() - began:.1f} s", flush=True)
    return output


def _output(*arguments: str) -> str:
    """What Python writes to standard output; whatever stands on the path, there is no compiler on it."""
    surroundings = {**os.environ, "PATH": "", "PYTHONUTF8": "1"}
    surroundings.pop("PYTHONPATH", None)
    command = [sys.executable, *arguments]
    done = subprocess.run(
        command, env=surroundings, capture_output=True, encoding="utf-8", timeout=600, check=False
    )
    _check(done.returncode == 0, f"{' '.join(arguments)}\n{done.stderr}", quiet=True)
    return done.stdout


def _check(good: bool, what: str, *, quiet: bool = False) -> None:
    if not good:
        sys.exit(f"failed: {what}")
    if not quiet:
        print(f"ok: {what}", flush=True)


if __name__ == "__main__":
    main()
