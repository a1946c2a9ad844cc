"""A rehearsal on the user's own problem with a known truth: what `orthaug recover` does.

Data are simulated by the physics at its estimate, a planted term that the physics lacks, and noise,
on the recorded inputs. Each draw is fitted as the spec says, and the result is compared with the
truth: simulation-based calibration (Talts et al. 2018) of one's own fit, beside other choices of
structure, measure, learner inputs, rows and input.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from orthaug._base.errors import InputError, Warning
from orthaug._base.folders import check_replaceable, whole_file, whole_folder, write_manifest
from orthaug._base.lines import plural
from orthaug._base.parallel import cores, one_blas_thread, one_core
from orthaug.commands.draws import GROUPS, Asked, Plan, count_choices, outcome_of, plan_for
from orthaug.commands.job import Job
from orthaug.commands.opening import open_job
from orthaug.reports.recovery import RecoverResult, recover_text
from orthaug.studies.study import CasesProgress, Run, Study, runs

FINDINGS = "recover.json"
_PLAN = "rehearsal.json"
_FEWEST = 4  # draws for which another process is worth its start
_WORK = """
from orthaug.commands.app.child import watch_parent
watch_parent()  # it ends with the process that started it
from orthaug.commands.recover import work
work()
"""
_LOOKS = 0.5  # s between two looks at what the others have done


@dataclass(frozen=True, eq=False)
class Rehearsal:
    """A rehearsal: `result` is the content of recover.json."""

    job: Job
    result: RecoverResult

    def __repr__(self) -> str:
        return f"Rehearsal({self.job.path.name}: {plural(self.result.draws, 'draw')})"

    def summary(self) -> str:
        """Return what `orthaug recover` prints."""
        return recover_text(self.result)


@dataclass(frozen=True)
class DrawFolder:
    """The folder that keeps each draw of a job as it is made; a later call goes on from there.

    Args:
        force: begin anew, whatever the folder holds.
    """

    path: Path
    force: bool = False

    def check(self, job: Job) -> None:
        """Raise InputError for draws of another spec, other content, or no right to write."""
        found = self._fingerprint()
        if found == job.fingerprint or self.force:
            check_replaceable(self.path, force=True)
        elif found is not None:
            raise InputError(
                f"{self.path}: holds draws of another spec or other data; give another --out, or "
                "begin anew with --force."
            )
        else:
            check_replaceable(self.path)

    def begin(self, job: Job) -> Path:
        """Make the folder unless it is there with draws of this job, and return it."""
        if self.force or self._fingerprint() != job.fingerprint:
            with whole_folder(self.path, force=self.force) as partial:
                content = {"command": "recover", "fingerprint": job.fingerprint}
                (partial / _PLAN).write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
        return self.path

    def _fingerprint(self) -> str | None:
        """Return the fingerprint of the job whose draws are there; None without one."""
        try:
            found = json.loads((self.path / _PLAN).read_text(encoding="utf-8"))["fingerprint"]
        except (OSError, ValueError, KeyError, TypeError):
            return None
        return str(found)


def rehearse(
    job: Job,
    asked: Asked,
    folder: DrawFolder | None = None,
    progress: CasesProgress | None = None,
    announce: Callable[[str], None] | None = None,
) -> Rehearsal:
    """Fit the job, simulate the draws, fit each, and compare with the truth.

    Args:
        folder: keeps each draw as it is made, and gives those that it has; None to keep none.
        progress: called with the draws done and all of them.
        announce: called before the draws with the number of fits and the time they may take.

    Raises:
        InputError: rows that are not in memory, terms that cannot be planted.
        TrainingError: the fit of the user's data failed.
    """
    with one_blas_thread(), tempfile.TemporaryDirectory(prefix="orthaug-") as own:
        began = time.monotonic()
        plan = plan_for(job, asked)
        first = time.monotonic() - began
        place = Path(own) if folder is None else folder.begin(job)

        def report_plan(lacking: Sequence[int], processes: int) -> None:
            if announce is not None:
                announce(_plan_text(plan, asked, lacking, processes, first))

        found = _make_draws(plan, asked, place, progress, report_plan)
        done = runs(_study(plan, asked), store=place, workers=1)
    return Rehearsal(job, _result(plan, asked, done, found))


def _study(plan: Plan, asked: Asked, share: tuple[int, int] = (0, 1)) -> Study:
    """Return the draws as a study, or every `share[1]`-th of them.

    Its cases are what a draw depends on beside the program.
    """

    def one_draw(
        fingerprint: str, seed: int, share: float | None, terms: str, compared: int, draw: int
    ) -> Mapping[str, object]:
        with one_core():
            return {"outcome": json.dumps(outcome_of(plan, seed, draw, choices=draw < compared))}

    cases: dict[str, Sequence[object]] = {
        "fingerprint": [plan.job.fingerprint],
        "seed": [asked.seed],
        "share": [asked.share],
        "terms": [",".join(group for group in GROUPS if group in asked.terms)],
        "compared": [asked.compared],
        "draw": range(asked.draws),
    }
    first, every = share
    return Study("draws", one_draw, cases, where=lambda draw, **_: draw % every == first)


def _make_draws(
    plan: Plan,
    asked: Asked,
    store: Path,
    progress: CasesProgress | None,
    report_plan: Callable[[Sequence[int], int], None],
) -> int:
    """Make the draws that a store lacks, and return how many it had.

    They are made in this process and in others beside it.

    Fits spend their time in Python as well as in compiled programs, so that threads would wait for
    each other. What another process has not made, because it failed, is made here afterwards.
    """
    whole = _study(plan, asked)
    places = [store / whole.name / f"{whole.key(case)}.json" for case in whole.cases()]
    lacking = [draw for draw, place in enumerate(places) if not place.is_file()]
    missing = len(lacking)
    every = max(1, min(cores(), missing // _FEWEST + 1))
    if missing:
        report_plan(lacking, every)

    def report(*_: object) -> None:
        if progress is not None:
            progress(sum(place.is_file() for place in places), asked.draws)

    report()
    others = [_start(plan.job, asked, store, (number, every)) for number in range(1, every)]
    try:
        runs(_study(plan, asked, (0, every)), store=store, workers=1, progress=report)
        while any(other.poll() is None for other in others):
            time.sleep(_LOOKS)
            report()
    finally:
        for other in others:
            if other.stdin is not None:
                other.stdin.close()  # ends it, as `watch_parent` says
            other.wait()
    return asked.draws - missing


def _plan_text(
    plan: Plan, asked: Asked, lacking: Sequence[int], processes: int, first: float
) -> str:
    """Return how many fits the `lacking` draws take, and roughly how long by the first fit."""
    compared, choices = sum(draw < asked.compared for draw in lacking), count_choices(plan)
    fits = len(lacking) + compared * choices
    minutes = fits * first / processes / 60
    length = "about a minute or less" if minutes < 1 else f"roughly {minutes:.0f} min"
    also = f", {compared} of them with {plural(choices, 'other choice')}" if compared else ""
    return (
        f"rehearsal: {plural(fits, 'fit')} for {plural(len(lacking), 'draw')}{also}. They take "
        f"{length}, since the fit of your data took {first:.2g} s."
    )


def _start(job: Job, asked: Asked, store: Path, share: tuple[int, int]) -> subprocess.Popen:
    """Return a process that makes its share of the draws."""
    given = {"path": str(job.path), "fingerprint": job.fingerprint, "asked": asdict(asked)}
    given |= {"store": str(store), "share": share}
    command = [sys.executable, "-c", _WORK]
    silent = subprocess.DEVNULL
    return subprocess.Popen(
        [*command, json.dumps(given)], stdin=subprocess.PIPE, stdout=silent, stderr=silent
    )


def work() -> None:
    """Make the share of the draws that the first argument of the process describes."""
    from orthaug._base.jax import keep_programs

    given = json.loads(sys.argv[1])
    asked, job = Asked(**given["asked"]), open_job(Path(given["path"]))
    if job.fingerprint != given["fingerprint"]:
        sys.exit(2)  # the file has changed since: the one that asked makes these draws
    keep_programs()
    with one_blas_thread():
        study = _study(plan_for(job, asked), asked, tuple(given["share"]))
        runs(study, store=Path(given["store"]), workers=1)


def _result(plan: Plan, asked: Asked, done: Sequence[Run], found: int) -> RecoverResult:
    """Return the content of recover.json from all draws, `found` of them made earlier."""
    job, outputs = plan.job, plan.fit.problem.outputs
    std = np.sqrt(np.sum(plan.noise**2, axis=1))
    units = job.physics.declared_units
    if job.physics.map is not None:
        units = units | {p.name: p.unit for p in job.physics.map.parameters}
    outcomes = [json.loads(run.result["outcome"]) for run in done]
    facts = {
        "spec": job.declaration,
        "data": job.data,
        "draws": asked.draws,
        "seed": asked.seed,
        "share": asked.share,
        "rows": job.problem.count,
        "compared": asked.compared,
        "noise": {
            "enters": "output" if plan.at_output else "equation",
            "std": dict(zip(outputs, std, strict=True)),
        },
        "left_out": [{"name": name, "reason": why} for name, why in plan.left_out],
        "seconds": sum(run.seconds for run in done),
        "stored": found,
        "physics_only": True if job.spec.declared_learner() is None else None,
        "designs": job.spec.design is not None,
        "warnings": [Warning(w.code, w.text) for w in job.warnings],
    }
    planted = [
        {
            "name": one.name,
            "source": group,
            "expression": one.suspect.expression,
            "memory": None if one.suspect.memory is None else one.suspect.memory.name,
            "place": one.suspect.equation or one.suspect.output,
            "coefficient": one.coefficient,
        }
        for group, one in plan.terms
    ]
    return RecoverResult.of(facts, plan.system.values, units, planted, outcomes)


def write(rehearsal: Rehearsal, folder: Path) -> None:
    """Write recover.json and the figure beside the draws."""
    from orthaug.reports import plots
    from orthaug.reports.finding_plots import recovery_figure

    (folder / "figures").mkdir(exist_ok=True)
    figure = recovery_figure(rehearsal.result)
    plots.save(figure, folder / "figures" / "recovery.png")
    with whole_file(folder / FINDINGS, force=True) as partial:
        partial.write_text(rehearsal.result.to_json() + "\n", encoding="utf-8")
    write_manifest(folder)
