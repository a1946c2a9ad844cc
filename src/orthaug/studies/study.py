"""Studies: one function over a grid of arguments and seeds, its results in a table. An interrupted study goes on.

A study is a declaration, so anyone's Monte Carlo is a function and a grid:

    study = Study("friction", fit_once, {"level": [0.1, 0.3], "seed": range(20)})
    table = run(study, store=Path("results"))
"""

from __future__ import annotations

import hashlib
import inspect
import json
import os
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

from orthaug._base.checks import finite_or_none
from orthaug._base.errors import InputError
from orthaug._base.parallel import spread

if TYPE_CHECKING:
    import pandas as pd

Case = dict[str, Any]
CasesTell = Callable[[int, int], None]
"""Called after each run with the runs done and all of them."""


@dataclass(frozen=True)
class Study:
    """A function and the grid that it runs over.

    Args:
        name: of its folder in a store.
        one: takes one value of each axis as keyword arguments, gives a mapping of plain values: numbers, texts, lists.
        grid: axes by name, each with its values; all combinations run, the last axis fastest. Slow cases go first.
        version: raise it when `one` computes something else, so that stored results no longer count.
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
        """Every combination that runs, as keyword arguments of plain values."""
        axes = [[_value(self, axis, value) for value in values] for axis, values in self.grid.items()]
        combinations = (dict(zip(self.grid, values, strict=True)) for values in product(*axes))
        return [case for case in combinations if self.where is None or self.where(**case)]

    def key(self, case: Case) -> str:
        """The key of a stored result: a hash of study, version, arguments, function and this package's code."""
        declared = {"study": self.name, "version": self.version, "case": case, "code": _text(self.one)}
        declared["orthaug"] = _sources()
        return hashlib.sha256(json.dumps(declared, sort_keys=True).encode()).hexdigest()[:24]


@cache
def _sources() -> str:
    """A digest of this package's code: results of older code do not count."""
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parents[1].rglob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()


def _text(function: Callable[..., Any]) -> str:
    try:
        return inspect.getsource(function)
    except (OSError, TypeError):
        return getattr(function, "__qualname__", "")


def run(
    study: Study,
    *,
    store: Path | None = None,
    workers: int | None = None,
    progress: CasesTell | None = None,
) -> pd.DataFrame:
    """Run what the store does not hold yet, several cases at a time; a row per case, axes first.

    Args:
        store: a folder that keeps each result as it is made; None to keep nothing.
        workers: cases at a time; by default the study's own number, or the machine's cores.

    Raises:
        InputError: a result that is not plain values; a store that cannot be written.
    """
    import pandas as pd

    cases = study.cases()
    results = [_read(store, study, case) for case in cases]
    todo = [i for i, result in enumerate(results) if result is None]
    done = len(cases) - len(todo)
    if progress is not None:
        progress(done, len(cases))

    def run_case(i: int, check: Callable[[], None]) -> None:
        nonlocal done
        check()
        result = _plain(study, study.one(**cases[i]))
        _write(store, study, cases[i], result)
        results[i] = result
        done += 1
        if progress is not None:
            progress(done, len(cases))

    spread(run_case, todo, study.workers if workers is None else workers)
    return pd.DataFrame([{**case, **(result or {})} for case, result in zip(cases, results, strict=True)])


def _path(store: Path, study: Study, case: Case) -> Path:
    return store / study.name / f"{study.key(case)}.json"


def _read(store: Path | None, study: Study, case: Case) -> dict[str, Any] | None:
    """A stored result; None where there is none, or where it was cut."""
    if store is None:
        return None
    try:
        content = json.loads(_path(store, study, case).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return content if isinstance(content, dict) else None


def _write(store: Path | None, study: Study, case: Case, result: dict[str, Any]) -> None:
    if store is None:
        return
    path = _path(store, study, case)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, partial = tempfile.mkstemp(dir=path.parent, prefix=".", suffix=".partial")
        with os.fdopen(handle, "w", encoding="utf-8") as file:
            json.dump(result, file, allow_nan=False)
        Path(partial).replace(path)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror}).") from None


def _plain(study: Study, result: Mapping[str, Any]) -> dict[str, Any]:
    return {key: _value(study, key, value) for key, value in result.items()}


def _value(study: Study, key: str, value: Any) -> Any:
    """The value as JSON has it; None for a number that is not finite."""
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, list | tuple):
        return [_value(study, key, item) for item in value]
    if isinstance(value, float):
        return finite_or_none(value)
    if value is None or isinstance(value, bool | int | str):
        return value
    raise InputError(f"study '{study.name}': '{key}' is a {type(value).__name__}; expected numbers, texts or lists.")
