"""The interface for users of Python: open, fit and compare specs, and write the page of a fit.

For a fit without a spec a job is built from the fit.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any, Never, overload

from orthaug._base.checks import check_type
from orthaug._base.errors import InputError, TrainingError
from orthaug._base.folders import check_new_file, whole_file
from orthaug.analysis.doubts import doubt
from orthaug.analysis.evidence import Evidence
from orthaug.analysis.examination import with_verdict
from orthaug.commands.fit import FitReport, fit_job, fit_report, report_of, write_result
from orthaug.commands.folder import check_folder, check_inputs_kept, check_kept
from orthaug.commands.job import Job, origin_of
from orthaug.commands.opening import job_physics, open_job
from orthaug.commands.parts import FilePart
from orthaug.commands.spec import (
    SelectionSection,
    TrainingSection,
)
from orthaug.data.record import Record
from orthaug.fitting.estimates import Estimate
from orthaug.models.rows import InMemory

if TYPE_CHECKING:
    from orthaug.commands.compare import Comparison
    from orthaug.commands.recover import Rehearsal
    from orthaug.commands.saved_results import SavedComparison

Spec = str | os.PathLike | Job
NAME = "fit.report()"
_HEIGHT = 800  # pixels of a page in a notebook


def load_spec(path: str | os.PathLike) -> Job:
    """Read a spec and all its data, and check them against each other; nothing is trained.

    Args:
        path: of the spec, a TOML file; paths in it start at its folder.

    Returns:
        What `fit_spec` and `compare` take. `train.record`, `validation` and `tests` are its data,
        `problem` the rows with the physics, `spec` the declarations.

    Raises:
        InputError: anything wrong with spec, files or physics; one line that names it.
    """
    check_type(path, str | os.PathLike, "path", "the name of a spec file")
    return open_job(Path(path))


def fit_spec(spec: Spec, out: str | os.PathLike | None = None) -> FitReport:
    """Train the job of a spec, score every part and judge the learner, as `orthaug fit` does.

    Args:
        spec: a spec file, or what `load_spec` returned.
        out: folder to write result, model, figures and report into; None to write nothing.

    Returns:
        `fit`, the `Estimate`; `result`, the content of result.json; `summary()`, what the command
        prints. Where training failed numerically `fit.status` says so, and there are no scores.

    Raises:
        InputError: as `load_spec`; a folder that cannot be written or holds something else.
    """
    job, folder = _open(spec, out)
    fitted = fit_job(job)
    if folder is not None:
        write_result(fitted, folder)
    return fitted


@overload
def compare(
    spec: Spec, models: Sequence[str | os.PathLike] = (), out: str | os.PathLike | None = None
) -> Comparison: ...
@overload
def compare(
    spec: list[str] | list[Path], models: Sequence[Never] = (), out: str | os.PathLike | None = None
) -> SavedComparison: ...
def compare(
    spec: Spec | list[str] | list[Path],
    models: Sequence[str | os.PathLike] = (),
    out: str | os.PathLike | None = None,
) -> Comparison | SavedComparison:
    """Compare physics alone and every structure on the same data and seeds, as `orthaug compare`.

    Args:
        spec: a spec file, or what `load_spec` returned; or a list of the result folders of two
            fits or more to the same data, which are set side by side, and nothing is trained.
        models: folders of saved models to put beside a spec.
        out: folder to write result, models and figure into; None to write nothing.

    Returns:
        `fitted`, one `FitReport` by the name of the structure; `verdicts`, whether the learner
        helps in each; `result`, the content of result.json; `summary()`, what the command prints.
        Of saved results `result`, `responses` (free runs by result and part) and `summary()`.

    Raises:
        InputError: as `fit_spec`; a model that does not fit the data; results that share no data.
    """
    if isinstance(models, str | os.PathLike) or not isinstance(models, Sequence):
        raise InputError("`models` must be a list of folders, such as ['orthaug-out/spec'].")
    for model in models:
        check_type(model, str | os.PathLike, "models", "a list of folders")
    if isinstance(spec, list):
        if models:
            raise InputError("`models` belong to a spec; give them among the results instead.")
        return _compare_results(spec, out)
    job, folder = _open(spec, out)
    from orthaug.commands import compare as comparing

    comparison = comparing.compare(job, [Path(model) for model in models])
    if folder is not None:
        comparing.write(comparison, folder)
    return comparison


def _compare_results(
    folders: Sequence[str | os.PathLike], out: str | os.PathLike | None
) -> SavedComparison:
    from orthaug.commands import saved_results

    for folder in folders:
        check_type(folder, str | os.PathLike, "spec", "a spec, or a list of result folders")
    check_type(out, str | os.PathLike | None, "out", "the name of a folder, or None")
    paths = [Path(folder) for folder in folders]
    if out is not None:
        check_folder(Path(out))
        check_kept(Path(out), *paths)
    found = saved_results.read_results(paths)
    comparison = saved_results.compare_results(found, ("compare", *map(str, paths)))
    if out is not None:
        saved_results.write(comparison, Path(out))
    return comparison


def recover(
    spec: Spec,
    *,
    draws: int = 20,
    seed: int = 0,
    share: float | None = None,
    terms: Sequence[str] = ("declared", "usual", "memory"),
    choices: int | None = None,
    out: str | os.PathLike | None = None,
) -> Rehearsal:
    """Rehearse a fit on simulated data with a known truth, as `orthaug recover` does.

    Args:
        spec: a spec file, or what `load_spec` returned.
        draws: data sets that are simulated and fitted.
        seed: of all random numbers.
        share: RMS of a planted term over that of the physics in its equation; None for terms as
            large as what the learner of the fit found.
        terms: groups of planted terms: "declared" ([[suspects]]), "usual", "memory".
        choices: draws on which other structures, measures, learner inputs and rows are fitted too;
            None for the first four.
        out: folder that keeps each draw as it is made, and result and figure; a second call goes on
            from there. None to write nothing.

    Returns:
        `result`, the content of recover.json; `summary()`, what the command prints.

    Raises:
        InputError: as `fit_spec`; a spec without a learner, a folder with draws of another spec.
        TrainingError: the fit of the user's data failed.
    """
    from orthaug.commands.recover import Asked, DrawFolder, rehearse, write

    asked = Asked(draws, seed, share, terms, choices)
    check_type(spec, Spec, "spec", "the name of a spec file, or what load_spec returns")
    check_type(out, str | os.PathLike | None, "out", "the name of a folder, or None")
    job = spec if isinstance(spec, Job) else open_job(Path(spec))
    folder = None if out is None else DrawFolder(Path(out))
    if folder is not None:
        check_inputs_kept(job, folder.path)
        folder.check(job)
    made = rehearse(job, asked, folder)
    if folder is not None:
        write(made, folder.path)
    return made


def _open(spec: Spec, out: str | os.PathLike | None) -> tuple[Job, Path | None]:
    """Return the job, and the folder to write, checked."""
    check_type(spec, Spec, "spec", "the name of a spec file, or what load_spec returns")
    check_type(out, str | os.PathLike | None, "out", "the name of a folder, or None")
    folder = None if out is None else Path(out)
    if folder is not None:
        check_folder(folder)
    job = spec if isinstance(spec, Job) else open_job(Path(spec))
    if folder is not None:
        check_inputs_kept(job, folder)
    return job, folder


@dataclass(frozen=True)
class Page:
    """A page of a fit: `html` is all of it; `path` the file that has it, or None.

    A notebook displays it.
    """

    html: str = field(repr=False)
    path: Path | None = None

    def _repr_html_(self) -> str:
        style = f"width:100%;height:{_HEIGHT}px;border:1px solid rgba(128,128,128,.35)"
        inside = escape(self.html, quote=True)
        return (
            f'<iframe title="report of the fit" sandbox="allow-scripts" style="{style}" '
            f'srcdoc="{inside}"></iframe>'
        )


@dataclass(frozen=True)
class FitFacts:
    """The declarations of a fit, where there is no spec."""

    fit: Any
    training: TrainingSection = field(default_factory=lambda: TrainingSection(fallback=False))
    selection: SelectionSection = field(default_factory=SelectionSection)

    def model_dump(self, **_: object) -> dict[str, object]:
        """Return the declarations that a title is made of."""
        record = self.fit.problem.record
        return {
            "data": {
                "inputs": [channel.name for channel in record.inputs],
                "outputs": [channel.name for channel in record.outputs],
            }
        }


def page_of(
    fit: Estimate,
    path: str | os.PathLike | None = None,
    tests: Mapping[str, Record] | None = None,
) -> Page:
    """Return the page of a fit: parameters, free runs, learned part, residuals, stability.

    Raises:
        TrainingError: a fit without a usable model.
        InputError: a path that cannot be written, records that do not fit.
    """
    place = _check_path(fit, path)
    evidence = Evidence.of(fit, tests=tests, blocks=0)
    job = job_of(fit, evidence)
    made = replace(
        origin_of(job, "fit"), name="spec", command=f"{NAME} in Python", toml=_account(fit)
    )
    report = doubt(with_verdict(report_of(job, fit, evidence)))
    return _write_page(fit_report(report, made), place)


def page_of_spec(fitted: FitReport, path: str | os.PathLike | None, tests: None = None) -> Page:
    """Return the page of a report by `fit_spec`, as the command line writes it.

    Errors as `page_of`.
    """
    place = _check_path(fitted.fit, path)
    return _write_page(fit_report(fitted), place)


def _check_path(fit: Estimate, path: str | os.PathLike | None) -> Path | None:
    check_type(path, str | os.PathLike | None, "path", "a file's name, or None")
    if path is not None and Path(path).suffix.lower() not in (".html", ".htm"):
        raise InputError(f"{path}: a page is HTML; give a name that ends in .html.")
    if path is not None:
        check_new_file(Path(path), force=True)
    if not fit.status.ok:
        raise TrainingError(f"{fit.status.message}. There is nothing to report.")
    return None if path is None else Path(path)


def _write_page(text: str, path: Path | None) -> Page:
    if path is not None:
        with whole_file(path, force=True) as partial:
            partial.write_text(text, encoding="utf-8")
    return Page(text, path)


def _account(fit: Estimate) -> str:
    """Return the text in the place of the spec."""
    learner = f"learner: {fit.model.form.bound.learner}"
    declared = (fit.problem.record, fit.problem.physics, learner)
    lines = ("Fitted in Python by orthaug.estimate; there is no spec.", *map(str, declared))
    return "".join(f"# {line}\n" for text in lines for line in text.splitlines())


def job_of(fit: Any, evidence: Evidence) -> Job:
    """Return the job of a fit, with as much as the fit knows of it."""
    return Job(
        path=Path(NAME),
        spec=FitFacts(fit),  # type: ignore[arg-type]  (a spec that knows less)
        train=FilePart("train", fit.problem.record),
        validation=None,
        tests=tuple(FilePart(part.name, part.record) for part in evidence.held_out),
        physics=job_physics(fit.problem.physics),
        problem=fit.problem,
        measure=evidence.measure,
        engine=InMemory(),
    )
