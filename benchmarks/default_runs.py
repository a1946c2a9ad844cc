"""How `defaults.py` runs a problem: `orthaug init` and `orthaug fit` as processes, a column a change of the spec.

Every result is kept in a JSON file under problem, column, spec, data and program, so that a run that was ended goes on
where it was. The program under test is the one that Python finds (PYTHONPATH).
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import tomlkit
from collection import Problem

SECONDS = 300.0
COLUMNS = ("physics", "physics-free", "one-step", "simulation", "default", "free", "fade", "hold")
_SINGLE = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "JAX_PLATFORMS": "cpu",
}

Result = dict[str, Any]
"""error (mean test NRMSE, null where a run diverged), diverged, failed, refused, code, seconds, cpu, status, …"""


@cache
def program() -> str:
    """Version and state of the program under test: the tree of its source, and what was changed since."""
    code = "import orthaug; print(orthaug.__version__, orthaug.__file__)"
    answer = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    version, file = answer.stdout.split(maxsplit=1)
    source = Path(file.strip()).parent

    def git(*arguments: str) -> str:
        done = subprocess.run(
            ["git", "-C", str(source), *arguments], capture_output=True, text=True, check=False
        )
        return done.stdout.strip()

    if not git("rev-parse", "HEAD"):
        return version
    changed = git("diff", "HEAD", "--", ".") + git("status", "--porcelain", "--", ".")
    return f"{version} {git('rev-parse', 'HEAD:./')[:12]}" + (
        f"+{_sha(changed)}" if changed else ""
    )


def _sha(text: str | bytes) -> str:
    return hashlib.sha256(text.encode() if isinstance(text, str) else text).hexdigest()[:12]


def variant(text: str, column: str, motion: bool) -> str | None:
    """The spec of a column; None where the column says nothing of such a problem."""
    document = tomlkit.parse(text)
    training = document.setdefault("training", tomlkit.table())
    learner = document["learner"]
    if motion and column in ("one-step", "physics-free"):
        return None
    if column.startswith("physics"):
        document["learner"] = {"kind": "none"}
        for part in ("states", "outputs") if motion else ():
            for equation in document["motion"][part].values():
                if not isinstance(equation, str):
                    equation.pop("learned", None)
    if column in ("free", "fade", "hold"):
        learner["beyond"] = column
    if not motion:
        focus = {"physics": "prediction", "physics-free": "simulation", "one-step": "prediction"}
        if column in focus or column == "simulation":
            training["focus"] = focus.get(column, "simulation")
    if column in ("one-step", "simulation"):
        training["fallback"] = column == "one-step"
    return tomlkit.dumps(document)


def command(arguments: list[str], folder: Path) -> tuple[int, float, float, str]:
    """Run the command line: exit code (124 where the time was up), seconds, seconds of the processor, its messages."""
    began = time.perf_counter()
    with (folder / "messages").open("wb") as messages:
        process = subprocess.Popen(
            [sys.executable, "-m", "orthaug", *arguments],
            cwd=folder,
            env=os.environ | _SINGLE,
            stdout=messages,
            stderr=subprocess.STDOUT,
            stdin=subprocess.DEVNULL,
            start_new_session=True,
        )
        late = False
        while True:
            pid, status, usage = os.wait4(process.pid, os.WNOHANG)
            if pid:
                break
            if not late and time.perf_counter() - began > SECONDS:
                late = True
                os.killpg(process.pid, signal.SIGKILL)
            time.sleep(0.02)
    process.returncode = os.waitstatus_to_exitcode(status)
    text = (folder / "messages").read_text(encoding="utf-8", errors="replace")
    code = 124 if late else process.returncode
    return code, time.perf_counter() - began, usage.ru_utime + usage.ru_stime, text


class Store:
    """Results in a JSON file that several processes may share."""

    def __init__(self, path: Path) -> None:
        self.path = path
        path.parent.mkdir(parents=True, exist_ok=True)

    def read(self) -> dict[str, Any]:
        return json.loads(self.path.read_text(encoding="utf-8")) if self.path.is_file() else {}

    def get(self, key: str) -> Any:
        return self.read().get(key)

    def put(self, key: str, value: Any) -> None:
        with self.path.with_suffix(".lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            found = self.read() | {key: value}
            part = self.path.with_suffix(".part")
            part.write_text(json.dumps(found, indent=0), encoding="utf-8")
            part.replace(self.path)


def spec_text(problem: Problem, folder: Path, store: Store, data: str) -> str:
    """The spec in its default form: as `orthaug init` writes it of the first experiment, or the motion by hand."""
    if problem.motion:
        document = tomlkit.parse(problem.motion)
        header = tomlkit.document()
        header["data"] = {"sampling_time": problem.sampling_time}
        header["data"] |= {"inputs": list(problem.inputs), "outputs": list(problem.outputs)}
        for key, value in document.items():
            header[key] = value
        return _with_data(header, problem)
    key = f"init | {problem.name} | {data} | {program()}"
    text = store.get(key)
    if text is None:
        options = ["--inputs", ",".join(problem.inputs), "--outputs", ",".join(problem.outputs)]
        options += ["--sampling-time", repr(problem.sampling_time), "--out", "init.toml"]
        code, *_, messages = command(["init", "train0.csv", *options], folder)
        if code:
            raise RuntimeError(
                f"orthaug init of {problem.name} ended with {code}: {messages[-500:]}"
            )
        text = (folder / "init.toml").read_text(encoding="utf-8")
        store.put(key, text)
    return _with_data(tomlkit.parse(text), problem)


def _with_data(document: tomlkit.TOMLDocument, problem: Problem) -> str:
    """Let all of the training record train, and the tests test; nothing else is edited."""
    data = document["data"]
    data.pop("tests", None)
    for key, value in problem.sections.items():
        data[key] = value
    return tomlkit.dumps(document)


def run(
    problem: Problem,
    columns: tuple[str, ...],
    store: Store,
    again: bool,
    warm: bool,
    say: Callable[[str], None],
) -> None:
    """Fit a problem in each column that is not in the store yet; `warm` fits twice, and times the second.

    Compiled programs are kept from run to run: the first of two columns alike takes longer than the second.
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        problem.write(folder)
        data = _sha(b"".join(path.read_bytes() for path in sorted(folder.glob("*.csv"))))
        text = spec_text(problem, folder, store, data)
        for column in columns:
            spec = variant(text, column, bool(problem.motion))
            if spec is None:
                continue
            key = f"{problem.name} | {column} | {program()} | {data} {_sha(spec)}"
            kept = store.get(key)
            if again or kept is None or (warm and not kept.get("warm")):
                result = fit(problem, spec, folder)
                if warm and not result.get("failed") and not result.get("refused"):
                    result = fit(problem, spec, folder)
                store.put(key, result | {"spec": spec, "warm": warm, "when": time.time()})
                say(
                    f"{problem.name:36} {column:13} {shown(result):>8} "
                    f"{result['seconds']:6.1f} s  {result['note']}"
                )


def fit(problem: Problem, spec: str, folder: Path) -> Result:
    """Fit a spec and read what came of it."""
    (folder / "spec.toml").write_text(spec, encoding="utf-8")
    code, seconds, cpu, messages = command(
        ["fit", "spec.toml", "--out", "result", "--force"], folder
    )
    result: Result = {
        "code": code,
        "seconds": seconds,
        "cpu": cpu,
        "error": None,
        "diverged": False,
        "note": "",
    }
    file = folder / "result" / "result.json"
    if code == 124 or not file.is_file():
        refused = "unknown key 'learner.beyond'" in messages
        last = " ".join(messages.split())[-200:]
        return result | {
            "note": f"exit code {code}: {last}",
            "failed": not refused,
            "refused": refused,
        }
    read = json.loads(file.read_text(encoding="utf-8"))
    for path in (folder / "result").rglob("*"):
        if path.is_file():
            path.unlink()
    scores = {part: one["simulation"]["nrmse"] for part, one in (read.get("scores") or {}).items()}
    tests = [number for part in problem.tests for number in scores.get(f"tests.{part}") or [None]]
    result["diverged"] = any(number is None for number in tests)
    result["error"] = None if result["diverged"] else sum(tests) / len(tests)
    result["train"], result["tests"] = scores.get("train"), tests
    result["status"] = read.get("status")
    result["validation"] = {
        k: (read.get("validation") or {}).get(k) for k in ("verdict", "text", "ratio")
    }
    result["warnings"] = [one["code"] for one in read.get("warnings", [])]
    result["criterion"] = read.get("criterion", read.get("focus"))
    result["parameters"] = {one["name"]: one["value"] for one in read.get("parameters", [])}
    result["note"] = (read.get("status") or {}).get("code", "")
    return result


def shown(result: Result | None) -> str:
    """An error as the tables show it."""
    if result is None or result.get("refused"):
        return ""
    if result.get("failed"):
        return "time" if result["code"] == 124 else "failed"
    return "div" if result["diverged"] else f"{result['error']:.4f}"


def latest(store: Store, names: list[str], fill: bool = False) -> dict[str, dict[str, Result]]:
    """Results of the program under test by problem and column; of several specs the last.

    With `fill`, a column that it has not run is that of another program, the last one that ran it.
    """
    found: dict[str, dict[str, Result]] = {name: {} for name in names}
    for key, value in store.read().items():
        name, column, *rest = key.split(" | ")
        if name not in found or value.get("refused") or not (fill or rest[0] == program()):
            continue
        value["own"] = rest[0] == program()
        before = found[name].get(column)
        if before is None or (before["own"], before["when"]) < (value["own"], value["when"]):
            found[name][column] = value
    return found
