"""Settings of the whole suite: hypothesis draws the same examples on every run, and nothing is timed."""

from __future__ import annotations

import gc
import os
import platform
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import slow
from hypothesis import HealthCheck, settings

# What several files compile is compiled once: the workers share their programs, as the command line does between runs.
os.environ.setdefault(
    "JAX_COMPILATION_CACHE_DIR", str(Path(__file__).parents[1] / ".pytest_cache" / "programs")
)
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES", "-1")

# Most of a test's time is XLA compiling small programs. The first two leave out what only makes large ones faster: it
# takes half of the time then. The third compiles a program in one piece: pieces are for idle cores, and there are none.
# Unset, it passes as well. The workers share the cores; BLAS and XLA need no threads of their own.
_FLAGS = (
    "xla_cpu_use_fusion_emitters=false",
    "xla_backend_optimization_level=0",
    "xla_cpu_parallel_codegen_split_count=1",
)
# The stored numbers of the golden tests are those of one set of instructions, which all x86 machines have: with longer
# vectors sums are rounded otherwise, and what hangs on the rounding changes.
if platform.machine() in ("x86_64", "AMD64"):
    _FLAGS = (*_FLAGS, "xla_cpu_max_isa=AVX2")
    os.environ.setdefault("OPENBLAS_CORETYPE", "Haswell")
os.environ.setdefault("XLA_FLAGS", " ".join(f"--{flag}" for flag in _FLAGS))
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("NPROC", "1")
# Where in the source each operation was written is not looked up for the compiler.
os.environ.setdefault("JAX_TRACEBACK_IN_LOCATIONS_LIMIT", "0")
# To rewrite the assertions of all tests is half of what collecting them takes: what comes of it is kept on disk,
# whatever the setting outside is, and so is what the processes import that tests start.
os.environ["PYTHONDONTWRITEBYTECODE"] = ""
sys.dont_write_bytecode = False
gc.disable()  # until all tests are collected: what is imported stays

import jax  # noqa: E402  (it reads the settings above when it is imported)

jax.config.update("jax_enable_x64", True)  # for arrays that tests make before the program does

settings.register_profile(
    "orthaug",
    derandomize=True,
    database=None,
    deadline=None,
    max_examples=60,
    suppress_health_check=[HealthCheck.too_slow],
)
settings.load_profile("orthaug")


_MOST_MAPS = 0.18  # of those that Linux grants, of a worker: 12,000 are 2 GB


def pytest_xdist_auto_num_workers() -> int:
    """One more than cores: many tests wait for a process that they have started."""
    return (os.cpu_count() or 1) + 1


# Half a minute or more each: a worker that took one of these files last would be waited for.
_LONGEST = """
golden golden_motion golden_examples app documents engines motion_fit report_browser cli export reproduction motion_cli free_run scikit_learn published
"""


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The longest files first, the others as they come; what takes long is marked."""
    listed = {name: slow.listed(name) for name in ("slow", "long")}
    for item in items:
        fixtures = {(item.path.stem, name) for name in getattr(item, "fixturenames", ())}
        if item.nodeid in listed["long"] or fixtures & slow.LONG_FIXTURES:
            item.add_marker("long")
        elif item.nodeid in listed["slow"] or fixtures & slow.FIXTURES:
            item.add_marker("slow")
    place = {f"test_{name}": i for i, name in enumerate(_LONGEST.split())}
    items.sort(key=lambda item: place.get(item.path.stem, len(place)))


_UNTIL = "ORTHAUG_TESTS_UNTIL"  # set by the first process for the workers: seconds of the clock
_NO_TIME = "no time was left"


def pytest_configure() -> None:
    """With MINUTES in the environment no test begins after so many; what is left out is counted at the end."""
    if minutes := os.environ.get("MINUTES"):
        os.environ.setdefault(_UNTIL, str(time.time() + 60 * float(minutes)))


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup() -> None:
    """Leave out what would begin too late."""
    if time.time() > float(os.environ.get(_UNTIL, "inf")):
        pytest.skip(_NO_TIME)


def pytest_collection_finish() -> None:
    """What was imported and collected stays: looking for garbage in it would take a twentieth of the time."""
    gc.freeze()
    gc.enable()
    gc.set_threshold(100_000, 20, 100)


def pytest_handlecrashitem(crashitem: str, report: pytest.TestReport, sched: Any) -> None:
    """What takes its worker down is run again by another, and counted as a rerun; twice fails.

    pytest-xdist 3.8 gives the files that the worker had ended to others, too: with nothing left to run
    there, these would wait for each other.
    """
    for name, tests in list(sched.workqueue.items()):
        if all(tests.values()):
            del sched.workqueue[name]
    if crashitem not in _CRASHED:
        _CRASHED.add(crashitem)
        report.outcome = "rerun"  # type: ignore[assignment]


_CRASHED: set[str] = set()


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """What the proofs have measured, as the tables of benchmarks/README.md."""
    skipped = terminalreporter.getreports("skipped")
    late = sum(_NO_TIME in str(report.longrepr) for report in skipped)
    if late:
        terminalreporter.write_line(f"{late} tests were left out: {_NO_TIME}.")
    ended = [
        report
        for outcome in ("passed", "failed")
        for report in terminalreporter.getreports(outcome)
    ]
    for report in sorted(ended, key=lambda report: report.nodeid):
        if "proof" in report.keywords and report.when == "call":
            measured = (
                "; ".join(f"{name}: {value}" for name, value in report.user_properties)
                or report.outcome
            )
            terminalreporter.write_line(
                f"| {report.nodeid.rpartition('test_')[2].replace('_', ' ')} | {measured} |"
            )


@pytest.fixture(autouse=True, scope="module")
def _programs_are_let_go() -> Iterator[None]:
    """Let go of a worker's programs: thousands of them take gigabytes, and at last all maps of memory."""
    yield
    from orthaug._base.jax import release_programs

    release_programs(_MOST_MAPS)


@pytest.fixture(autouse=True, scope="session")
def _programs_are_traced_anew() -> Iterator[None]:
    """Tests replace functions and constants: no program is read that another test has traced."""
    from orthaug._base import jax as programs

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(programs, "keep_traced_programs", lambda folder: None)
        yield


@pytest.fixture(autouse=True, scope="session")
def _defects_are_seen() -> Iterator[None]:
    """A user keeps a training behind which an analysis fails; a test fails."""
    from orthaug.analysis import attempt

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(attempt, "DEFECTS", ())
        yield


@pytest.fixture(scope="session")
def data_folder() -> Path:
    """The measured data sets; the test is skipped where they are absent."""
    default = Path(__file__).resolve().parents[2] / "shared" / "data"
    folder = Path(os.environ.get("ORTHAUG_DATA", default))
    if not folder.is_dir():
        pytest.skip(f"no data sets in {folder}; set ORTHAUG_DATA to their folder")
    return folder


@pytest.fixture(scope="session")
def golden_records(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The records of the golden specs, written once."""
    from golden_records import write_data

    folder = tmp_path_factory.mktemp("golden")
    write_data(folder)
    return folder


@pytest.fixture
def golden_folder(golden_records: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of the golden records, as the current one."""
    monkeypatch.chdir(golden_records)
    return golden_records


@pytest.fixture(scope="module")
def without_figures() -> Iterator[None]:
    """Fits that are read as numbers draw nothing; test_cli and test_plots look at figures."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("orthaug.commands.fit._draw", lambda *_: None)
        yield


@pytest.fixture(scope="module")
def without_trials() -> Iterator[None]:
    """Fits whose advice is not looked at try no changed specs; test_advice and golden tests do."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("orthaug.commands.advice._tried", lambda *_: None)
        yield
