"""Studies: one function over a grid of arguments and seeds, its results in a table.

An interrupted study goes on.

A study is a declaration, so anyone's Monte Carlo is a function and a grid:

    study = Study("friction", fit_once, {"level": [0.1, 0.3], "seed": range(20)})
    table = run(study, store=Path("results"))
"""

from __future__ import annotations

import hashlib
import inspect
import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cache
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

from orthaug._base.checks import finite_or_none
from orthaug._base.errors import InputError
from orthaug._base.folders import whole_file
from orthaug._base.parallel import run_all
from orthaug.models.tasks import ask, places

if TYPE_CHECKING:
    import pandas as pd

Case = dict[str, Any]
CasesProgress = Callable[[int, int], None]
"""Called after each run with the runs done and all of them."""


@dataclass(frozen=True)
class Study:
    """A function and the grid that it runs over.

    Args:
        name: of its folder in a store.
        one: takes one value of each axis as keyword arguments, gives a mapping of plain values:
            numbers, texts, lists.
        grid: axes by name, each with its values; all combinations run, the last axis fastest. Slow
            cases go first.
        version: raise it when `one` computes something else, so that stored results no longer
            count.
        where: of all combinations, those that run; takes what `one` takes. None for all.
        workers: cases at a time; 1 for a study that measures time, None for the machine's cores.
    """

    name: str
    one: Callable[..., Mapping[str, Any]]
    grid: Mapping[str, Sequence[Any]]
    version: int = 1
    where: Callable[..., bool] | None = None
    workers: int | None = None

    def cases(self) -> list[Case]:
        """Return every combination that runs, as keyword arguments of plain values."""
        axes = [
            [_value(self, axis, value) for value in values] for axis, values in self.grid.items()
        ]
        combinations = (dict(zip(self.grid, values, strict=True)) for values in product(*axes))
        return [case for case in combinations if self.where is None or self.where(**case)]

    def key(self, case: Case) -> str:
        """Return the key of a stored result.

        It is a hash of study, version, arguments, function and this package's code.
        """
        declared = {
            "study": self.name,
            "version": self.version,
            "case": case,
            "code": _text(self.one),
        }
        declared["orthaug"] = _sources()
        return hashlib.sha256(json.dumps(declared, sort_keys=True).encode()).hexdigest()[:24]


@dataclass(frozen=True)
class Run:
    """One case with its result, and when that was made.

    Args:
        made: when the result was made, ISO 8601 in UTC, whole seconds.
        seconds: that the case took then; other cases may have shared the machine.
        stored: whether it was read from a store instead of made now.
    """

    case: Case
    result: dict[str, Any]
    made: str
    seconds: float
    stored: bool


@cache
def _sources() -> str:
    """Return a digest of this package's code: results of older code do not count."""
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parents[1].rglob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()


def _text(function: Callable[..., object]) -> str:
    try:
        return inspect.getsource(function)
    except (OSError, TypeError):
        return getattr(function, "__qualname__", "")


def run(
    study: Study,
    *,
    store: Path | None = None,
    workers: int | None = None,
    progress: CasesProgress | None = None,
    client: Any = None,
) -> pd.DataFrame:
    """Run what the store does not hold yet, several cases at a time; a row per case, axes first.

    Args:
        store: a folder that keeps each result as it is made; None to keep nothing.
        workers: cases at a time; by default the study's own number, or the machine's cores.
        client: a `distributed.Client`; its workers make the cases of a study that does not measure
            time.

    Raises:
        InputError: a result that is not plain values; a store that cannot be written.
    """
    return as_table(runs(study, store=store, workers=workers, progress=progress, client=client))


def as_table(done: Sequence[Run]) -> pd.DataFrame:
    """Return a row per run, axes first.

    Stored results and those made now are not distinguished.
    """
    import pandas as pd

    return pd.DataFrame([{**run.case, **run.result} for run in done])


def runs(
    study: Study,
    *,
    store: Path | None = None,
    workers: int | None = None,
    progress: CasesProgress | None = None,
    client: Any = None,
) -> list[Run]:
    """Return the runs as `run` makes them, with the time of every result instead of a table."""
    cases = study.cases()
    found = [_read(store, study, case) for case in cases]
    todo = [i for i, run in enumerate(found) if run is None]
    done = len(cases) - len(todo)
    if progress is not None:
        progress(done, len(cases))

    wanted, elsewhere = (
        study.workers if workers is None else workers,
        client is not None and study.workers != 1,
    )
    if elsewhere:
        wanted = places(client)

    def run_case(i: int, check: Callable[[], None]) -> None:
        nonlocal done
        check()
        began = time.perf_counter()
        made_of = ask(client, check, study.one, **cases[i]) if elsewhere else study.one(**cases[i])
        result = _plain(study, made_of)
        seconds = round(time.perf_counter() - began, 3)
        made = datetime.now(UTC).isoformat(timespec="seconds")
        run = Run(cases[i], result, made, seconds, stored=False)
        _write(store, study, run)
        found[i] = run
        done += 1
        if progress is not None:
            progress(done, len(cases))

    run_all(run_case, todo, wanted)
    return [run for run in found if run is not None]


def _path(store: Path, study: Study, case: Case) -> Path:
    return store / study.name / f"{study.key(case)}.json"


def _read(store: Path | None, study: Study, case: Case) -> Run | None:
    """Return a stored result; None where there is none, or where it was cut or altered."""
    if store is None:
        return None
    try:
        content = json.loads(_path(store, study, case).read_text(encoding="utf-8"))
        if content.pop("sha256") != _checksum(study, case, content):
            return None
        return Run(
            case,
            dict(content["result"]),
            str(content["made"]),
            float(content["seconds"]),
            stored=True,
        )
    except (OSError, ValueError, TypeError, KeyError, AttributeError, RecursionError):
        return None


def _checksum(study: Study, case: Case, content: Mapping[str, object]) -> str:
    """Return a digest of a record and the case it belongs to."""
    written = json.dumps([study.key(case), content], sort_keys=True, allow_nan=False)
    return hashlib.sha256(written.encode()).hexdigest()


def _write(store: Path | None, study: Study, run: Run) -> None:
    if store is None:
        return
    content: dict[str, object] = {"made": run.made, "seconds": run.seconds, "result": run.result}
    content["sha256"] = _checksum(study, run.case, content)
    path = _path(store, study, run.case)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with whole_file(path, force=True, result=False) as partial:
            partial.write_text(json.dumps(content, allow_nan=False), encoding="utf-8")
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror}).") from None


def _plain(study: Study, result: Mapping[str, object]) -> dict[str, object]:
    return {key: _value(study, key, value) for key, value in result.items()}


def _value(study: Study, key: str, value: Any) -> Any:
    """Return the value as JSON has it; None for a number that is not finite."""
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, list | tuple):
        return [_value(study, key, item) for item in value]
    if isinstance(value, float):
        return finite_or_none(value)
    if value is None or isinstance(value, bool | int | str):
        return value
    raise InputError(
        f"study '{study.name}': '{key}' is a {type(value).__name__}; expected numbers, texts "
        "or lists."
    )
