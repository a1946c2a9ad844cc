"""The page of a fit that was made in Python, without a spec: a job is made of what the fit knows."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from html import escape
from pathlib import Path
from typing import Any

from orthaug._base.checks import check_type
from orthaug._base.errors import InputError, TrainingError
from orthaug._base.folders import check_new_file, whole_file
from orthaug.commands.fit import Fitted, fit_report, judged, told_of
from orthaug.commands.job import Job, origin_of
from orthaug.commands.lagged_job import LaggedJob
from orthaug.commands.motion_job import MotionJob
from orthaug.commands.parts import Part
from orthaug.commands.spec import TrainingSection, ValidationSection
from orthaug.data.record import Record
from orthaug.fitting.estimates import Estimate
from orthaug.fitting.kinds import STRUCTURES
from orthaug.fitting.motion_estimates import MotionEstimate
from orthaug.inference.measures import Training, weigh_problem
from orthaug.models.rows import InMemory

NAME = "fit.report()"
_HEIGHT = 800  # pixels of a page in a notebook


@dataclass(frozen=True)
class Page:
    """A page of a fit: `html` is all of it; `path` the file that has it, or None. A notebook shows it."""

    html: str = field(repr=False)
    path: Path | None = None

    def _repr_html_(self) -> str:
        style = f"width:100%;height:{_HEIGHT}px;border:1px solid rgba(128,128,128,.35)"
        inside = escape(self.html, quote=True)
        return f'<iframe title="report of the fit" sandbox="allow-scripts" style="{style}" srcdoc="{inside}"></iframe>'


@dataclass(frozen=True)
class Known:
    """What a fit tells in the place of a spec."""

    fit: Any
    suspects: tuple[()] = ()
    physics: None = None
    motion: None = None
    training: TrainingSection = field(default_factory=lambda: TrainingSection(fallback=False))
    validation: ValidationSection = field(default_factory=lambda: ValidationSection(blocks=0))

    def declared_learner(self) -> Any:
        """The learner; None without one."""
        bound = self.fit.model.form.bound
        return None if bound is None else bound.learner

    def declared_structure(self, kind: str | None = None, measure: Any = None) -> Any:
        """The kind of structure that was fitted."""
        return STRUCTURES[kind or self.fit.model.structure]()

    def declared_criterion(self) -> Any:
        """What was fitted."""
        return self.fit.criterion

    def declared_solver(self) -> Any:
        """The default: physics alone needs no other."""
        from orthaug.fitting.solvers.levenberg_marquardt import LevenbergMarquardt

        return LevenbergMarquardt()

    def model_dump(self, **_: Any) -> dict[str, Any]:
        """What a title is made of."""
        record = self.fit.problem.record
        return {
            "data": {
                "inputs": [channel.name for channel in record.inputs],
                "outputs": [channel.name for channel in record.outputs],
            }
        }


def page_of(
    fit: Estimate | MotionEstimate, path: str | os.PathLike | None = None, tests: Mapping[str, Record] | None = None
) -> Page:
    """What `fit.report` returns: parameters, free runs, what was learned, residuals, stability.

    Raises:
        TrainingError: a fit without a usable model. InputError: a path that cannot be written, records that do not fit.
    """
    place = _checked(fit, path)
    job = job_of(fit, {} if tests is None else tests)
    made = replace(origin_of(job, "fit"), name="spec", command=f"{NAME} in Python", toml=_account(fit))
    return _written(fit_report(judged(told_of(job, fit)), made), place)


def page_of_spec(fitted: Fitted, path: str | os.PathLike | None, tests: None = None) -> Page:
    """The page of what `fit_spec` returned, as the command line writes it; errors as `page_of`."""
    place = _checked(fitted.fit, path)
    return _written(fit_report(fitted), place)


def _checked(fit: Estimate | MotionEstimate, path: str | os.PathLike | None) -> Path | None:
    check_type(path, str | os.PathLike | None, "path", "a file's name, or None")
    if path is not None and Path(path).suffix.lower() not in (".html", ".htm"):
        raise InputError(f"{path}: a page is HTML; give a name that ends in .html.")
    if path is not None:
        check_new_file(Path(path), force=True)
    if not fit.status.ok:
        raise TrainingError(f"{fit.status.message}. There is nothing to report.")
    return None if path is None else Path(path)


def _written(text: str, path: Path | None) -> Page:
    if path is not None:
        with whole_file(path, force=True) as partial:
            partial.write_text(text, encoding="utf-8")
    return Page(text, path)


def _account(fit: Estimate | MotionEstimate) -> str:
    """What stands in the place of the spec."""
    physics = fit.problem.motion if isinstance(fit, MotionEstimate) else fit.problem.baseline
    bound = fit.model.form.bound
    told = (fit.problem.record, physics, f"learner: {'none' if bound is None else bound.learner}")
    lines = ("Fitted in Python by orthaug.estimate; there is no spec.", *map(str, told))
    return "".join(f"# {line}\n" for text in lines for line in text.splitlines())


def job_of(fit: Any, tests: Mapping[str, Record]) -> Job:
    """The job whose result the fit is, as far as the fit knows it."""
    if not isinstance(tests, Mapping) or not all(isinstance(record, Record) for record in tests.values()):
        raise InputError("`tests` must be records by their names, such as {'steps': record}.")
    problem = fit.problem
    named: dict[str, Any] = {"path": Path(NAME), "spec": Known(fit), "validation": None, "problem": problem}
    named["train"] = Part("train", problem.record, 0, ())
    named["tests"] = tuple(
        Part(f"tests.{name}", fit.model.fitting(record, need_outputs=True), 0, ()) for name, record in tests.items()
    )
    measure = Training() if fit.model.measure == "training" else getattr(fit.measure, "measure", None) or Training()
    if isinstance(fit, MotionEstimate):
        return MotionJob(measure=measure, engine=InMemory(), **named)
    weighed = weigh_problem(measure, problem)
    return LaggedJob(weighed=weighed, physics=None, engine=InMemory(), **named)
