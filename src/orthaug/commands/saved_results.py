"""Results that were saved, side by side: what `orthaug compare` does with two folders or more."""

from __future__ import annotations

import os
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from pydantic import ValidationError

from orthaug._base.errors import InputError, Warning
from orthaug._base.folders import file_digest, whole_folder
from orthaug.commands.compare import choose_row, row_of, with_equal_rows, write_report
from orthaug.commands.folder import results_beside
from orthaug.commands.job import surroundings, toml_of
from orthaug.commands.parts import load_parts
from orthaug.commands.sections import values_by_key
from orthaug.commands.spec import Spec, spec_model
from orthaug.fitting.status import Ending
from orthaug.models import storage
from orthaug.models.model import Model
from orthaug.models.response import Response
from orthaug.reports.page_fit import Origin
from orthaug.reports.result import (
    CompareResult,
    DataResult,
    DifferenceResult,
    FitResult,
    RowResult,
    SettingResult,
)

_EXPECTED = "expected the result folders of two fits"


@dataclass(frozen=True, eq=False)
class SavedResult:
    """A result of `orthaug fit` that was saved, by the name that the user gave it."""

    name: str
    result: FitResult
    spec: Spec
    model: Model

    @property
    def row(self) -> RowResult:
        """The row of a comparison, with physical parameters after those that were estimated."""
        own, status = self.result, self.result.status
        kept = {key: getattr(own, key) for key in ("orthogonality_defect", "residuals")}
        kept |= {"status": status.code, "seconds": status.seconds, "validation": own.validation}
        parameters = [*own.parameters, *(own.physical_parameters or ())]
        return row_of(
            self.name, self.model, own.scores, own.warnings, parameters=parameters, **kept
        )


@dataclass(frozen=True, eq=False)
class SavedComparison:
    """A comparison of saved results, with the free runs of their models where data were found."""

    origin: Origin
    result: CompareResult
    responses: Mapping[str, Mapping[str, Response]]

    def __repr__(self) -> str:
        return f"SavedComparison({', '.join(row.name for row in self.result.comparison)})"

    def summary(self) -> str:
        """Return what `orthaug compare` prints."""
        from orthaug.reports.text import compare_text

        return compare_text(self.result, {})


def read_results(paths: Sequence[Path]) -> list[SavedResult]:
    """Return saved results of the same outputs and data.

    Raises:
        InputError: one folder alone, or one that holds no result of a fit; results that share no
            data.
    """
    if len(paths) < 2:
        given = f"{paths[0]}: is one folder" if paths else "no folder is given"
        raise InputError(f"{given}; expected a spec, or two result folders.")
    found: list[SavedResult] = []
    for path in paths:
        if str(path) in [one.name for one in found]:
            raise InputError(f"{path}: is given twice; {_EXPECTED}.")
        found.append(_read(path))
    first = found[0]
    for other in found[1:]:
        outputs = [", ".join(one.spec.data.outputs) for one in (first, other)]
        if outputs[0] != outputs[1]:
            raise InputError(
                f"{other.name}: its outputs are {outputs[1]}, those of {first.name} are "
                f"{outputs[0]}; expected results with the same outputs."
            )
        steps = [
            [(done.step, done.options) for done in one.result.data.prepare or ()]
            for one in (first, other)
        ]
        if steps[0] != steps[1]:
            raise InputError(
                f"{other.name}: its data were prepared in another way than those of {first.name} "
                "(`data.prepare`), so their scores are of different signals. Fit both with the "
                "same preparation."
            )
    if not _shared_parts(found):
        raise InputError(
            f"{other.name}: has no part of the data in common with {first.name}: "
            f"{_files_in_words(other)}, but {_files_in_words(first)}. Compare results of the same "
            "files and rows."
        )
    return found


def compare_results(found: Sequence[SavedResult], arguments: Sequence[str]) -> SavedComparison:
    """Return saved results in one table: parameters, scores, settings, and free runs.

    Args:
        found: results that `read_results` accepts.
        arguments: of the command.
    """
    names, first = _shared_parts(found), found[0]
    rows = [_on_parts(one.row, names) for one in found]
    responses, warnings = _free_runs(found, names)
    if "train" not in names:
        text = (
            f"training data differ: {'; '.join(_files_in_words(one) for one in found)}. "
            "Differences of the parameters include those of the data."
        )
        warnings.insert(0, Warning("training_data_differ", text))
    content = {
        "spec": first.result.spec,
        "data": _data_of(first.result.data, names),
        "comparison": rows,
        "chosen": choose_row(rows, simulates=True) if "validation" in names else None,
        "left_out": {},
        "differences": list(_differences(rows)),
        "settings": _settings(found),
        "warnings": warnings,
    }
    result = with_equal_rows(CompareResult.model_validate(content), responses, {})
    return SavedComparison(_origin(found, arguments), result, responses)


def write(comparison: SavedComparison, folder: Path, *, force: bool = False) -> None:
    """Write result.json, figures/ and report.html, whole or not at all."""
    from orthaug.reports.page_compare import ComparePage

    page = ComparePage(comparison.origin, comparison.result, comparison.responses)
    with whole_folder(folder, force=force) as partial:
        write_report(page, partial)


def _read(path: Path) -> SavedResult:
    """Return the saved result of a folder, or of a model in one.

    Raises:
        InputError: there is none, or its training failed.
    """
    if not os.path.isdir(path):  # false of a name that no file can have, where pathlib raises
        what = "is a file" if os.path.exists(path) else "there is no such folder"
        raise InputError(f"{path}: {what}; {_EXPECTED}, or one spec.")
    content = next(results_beside(path), None)
    if content is None:
        raise InputError(
            f"{path}: has no result.json that can be read; {_EXPECTED}. A model without one joins "
            "the comparison of a spec: `orthaug compare SPEC --model MODEL`."
        )
    try:
        result = FitResult.model_validate(content)
        spec = spec_model().model_validate(result.spec, context={"folder": path})
    except (ValidationError, ValueError, RecursionError):
        raise InputError(
            f"{path}: its result.json is no result of `orthaug fit` of this version; {_EXPECTED}."
        ) from None
    if result.status.code == Ending.NON_FINITE.code:
        raise InputError(f"{path}: its training failed, so there is no model; {_EXPECTED}.")
    return SavedResult(str(path), result, spec, storage.load(path))


def _shared_parts(found: Sequence[SavedResult]) -> list[str]:
    """Return the names of the parts that have the same files and rows in every result."""
    first, *others = (
        {name: [(file.sha256, file.rows) for file in files] for name, files in parts.items()}
        for parts in (one.result.data.parts for one in found)
    )
    names = {"train": "train", "validation": "validation"}
    shared = [name for name in first if all(other.get(name) == first[name] for other in others)]
    return [names.get(name, f"tests.{name}") for name in shared]


def _files_in_words(one: SavedResult) -> str:
    names = [Path(file.file).name for file in one.result.data.train]
    return f"{one.name} was trained on {', '.join(names[:3])}{', …' if len(names) > 3 else ''}"


def _data_of(data: DataResult, names: Sequence[str]) -> DataResult:
    """Return the parts of some names alone."""
    tests = {name: files for name, files in (data.tests or {}).items() if f"tests.{name}" in names}
    return data.model_copy(
        update={
            "train": data.train if "train" in names else [],
            "validation": data.validation if "validation" in names else None,
            "tests": tests or None,
        }
    )


def _on_parts(row: RowResult, names: Sequence[str]) -> RowResult:
    scores = {name: scores for name, scores in row.scores.items() if name in names}
    return row.model_copy(update={"scores": scores})


def _differences(rows: Sequence[RowResult]) -> Iterator[DifferenceResult]:
    """Yield the difference of every parameter between the first row and each other one."""
    first, *others = rows
    known = {parameter.name: parameter for parameter in first.parameters}
    for row in others:
        for other in row.parameters:
            own = known.get(other.name)
            if own is None or own.value is None or other.value is None:
                continue
            value, std = other.value - own.value, max(own.std or 0.0, other.std or 0.0)
            yield DifferenceResult(
                name=other.name, result=row.name, value=value, of_std=value / std if std else None
            )


def _settings(found: Sequence[SavedResult]) -> list[SettingResult]:
    """Return the keys in which specs differ, except the names of files; and the version."""
    given = [
        {"orthaug": one.result.orthaug, **dict(values_by_key(one.result.spec))} for one in found
    ]
    keys = dict.fromkeys(key for own in given for key in own)
    values = {key: [own.get(key) for own in given] for key in keys}
    return [
        SettingResult(key=key, values=dict(zip((o.name for o in found), own, strict=True)))
        for key, own in values.items()
        if any(value != own[0] for value in own) and not key.endswith(".files")
    ]


def _free_runs(
    found: Sequence[SavedResult], names: Sequence[str]
) -> tuple[dict[str, dict[str, Response]], list[Warning]]:
    """Return the free runs of every model on shared parts, and a warning where data are missing.

    There are none where the files of one result are not found.
    """
    responses: dict[str, dict[str, Response]] = {}
    for one in found:
        folder = _folder_of_data(one)
        if folder is None:
            files = ", ".join(file.file for file in one.result.data.train[:3])
            text = (
                f"no free run is drawn, because the data of {one.name} ({files}) are not as they "
                "were in the current folder or above the result. Run this in the folder of the "
                "spec."
            )
            return {}, [Warning("data_not_found", text)]
        train, validation, tests = load_parts(folder / "spec.toml", one.spec)
        responses[one.name], form = {}, one.model.form
        for part in (train, *([validation] if validation else ()), *tests):
            if part.name in names:
                whole = part.without_short(form.first_row, 0 if form.memory else form.states + 1)
                responses[one.name][part.name] = one.model.simulate(whole.record)
    lengths = [
        {part: [len(t.model) for t in run.trajectories] for part, run in runs.items()}
        for runs in responses.values()
    ]
    alike = [name for name in names if all(own[name] == lengths[0][name] for own in lengths)]
    return {
        name: {part: run for part, run in runs.items() if part in alike}
        for name, runs in responses.items()
    }, []


def _folder_of_data(one: SavedResult) -> Path | None:
    """Return the folder from which the files of a result have the content that was fitted."""
    files = [file for files in one.result.data.parts.values() for file in files]
    for folder in dict.fromkeys((Path.cwd(), *Path(one.name).resolve().parents)):
        if all(_is_same(folder / file.file, file.sha256) for file in files):
            return folder
    return None


def _is_same(file: Path, sha256: str) -> bool:
    try:
        return file.is_file() and file_digest(file) == sha256
    except (OSError, ValueError, InputError):
        return False


def _origin(found: Sequence[SavedResult], arguments: Sequence[str]) -> Origin:
    """Return the origin of a comparison, with the specs one below the other."""
    date, machine, versions = surroundings()
    return Origin(
        name=" and ".join(Path(one.name).name for one in found),
        toml="\n".join(f"# {one.name}\n{toml_of(one.result.spec)}" for one in found),
        command=shlex.join(("orthaug", *arguments)),
        date=date,
        machine=machine,
        versions=versions,
        seed=found[0].spec.training.seed,
    )
