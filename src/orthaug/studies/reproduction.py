"""`orthaug reproduce`: run and draw the paper's studies, and compare them on one page."""

from __future__ import annotations

import base64
import io
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jinja2
import platformdirs

from orthaug import __version__
from orthaug._base.checks import check_choice, nearest
from orthaug._base.errors import InputError
from orthaug._base.folders import check_replaceable, whole_folder
from orthaug.reports import plots
from orthaug.studies import (
    consistency,
    covariance,
    coverage,
    data_length,
    regularization_weight,
    solver_times,
    static_errors,
    static_noise,
)
from orthaug.studies.common import Counts, Drawing, Finding, Reproduction
from orthaug.studies.study import Run, as_table, runs
from orthaug.studies.theory import THEORY

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

PIPELINES = {  # name, and how the page says who trained
    "ours": "trained by Levenberg-Marquardt",
    "paper": "with the paper's own training: Adam, then L-BFGS",
    "scripts": "as the published scripts train: un-normalised, from θ⁰, with their seeds",
}
HYPHEN = "\N{NON-BREAKING HYPHEN}"  # a line of the page never ends within 1e-6
WIDTH = 100  # characters of a line in a terminal
MARK = "reproduction.json"
StudiesProgress = Callable[[str, int, int], None]
"""Called with the study's title, the runs done and all of them."""


@dataclass(frozen=True, eq=False)
class StudyOutcome:
    """One study with its table, figures and findings.

    Args:
        whole: how many runs the study has at its full size.
        small: whether it was run at the reduced size.
    """

    entry: Reproduction
    runs: list[Run]
    table: pd.DataFrame
    figures: dict[str, Drawing]
    findings: list[Finding]
    whole: int
    small: bool = False


def catalogue() -> dict[str, Reproduction]:
    """Return the paper's figures and tables, one file each, in its order."""
    modules: list[Any] = [
        static_errors,
        data_length,
        static_noise,
        covariance,
        consistency,
        regularization_weight,
        coverage,
        solver_times,
    ]
    return {module.REPRODUCTION.name: module.REPRODUCTION for module in modules}


def choose_studies(name: str | None) -> list[Reproduction]:
    """Return the studies to run: one by name, or all.

    Raises:
        InputError: no study of that name.
    """
    known = catalogue()
    if name is None:
        return list(known.values())
    if name not in known:
        raise InputError(
            f"there is no study '{name}'{nearest(name, known) or '.'} There are {', '.join(known)}."
        )
    return [known[name]]


def reproduce(
    entries: Sequence[Reproduction],
    *,
    pipeline: str = "ours",
    small: bool = False,
    store: Path | None = None,
    progress: StudiesProgress | None = None,
    client: Any = None,
) -> list[StudyOutcome]:
    """Run the studies; what a store holds already is not run again.

    Args:
        pipeline: "ours", "paper" for Adam and L-BFGS with the published iterations on normalised
            data, or "scripts" for what the published scripts do, un-normalised and from θ⁰.
        small: at the reduced size of the tests.
        store: where results are kept as they are made; None for the user's cache folder.
        client: a `distributed.Client` whose workers make the runs.
    """
    check_choice(pipeline, PIPELINES, "--pipeline")
    store = Path(platformdirs.user_cache_dir("orthaug")) / "studies" if store is None else store
    reproduced = []
    for entry in entries:
        report = (
            None
            if progress is None
            else lambda done, total, e=entry: progress(e.title, done, total)
        )
        done = runs(entry.study(pipeline, small), store=store, progress=report, client=client)
        table = as_table(done)
        whole = len(entry.study(pipeline, False).cases())
        shown = dict(entry.figures(table)), entry.findings(table)
        reproduced.append(StudyOutcome(entry, done, table, *shown, whole, small))
    return reproduced


def check_output(folder: Path, *, force: bool = False) -> None:
    """Raise InputError early where the page could not be written."""
    check_replaceable(folder, force=force)


def write(
    reproduced: Sequence[StudyOutcome], folder: Path, pipeline: str, *, force: bool = False
) -> None:
    """Write index.html, and for each study its figures as PNG and its runs as CSV.

    The folder is written whole or not at all.
    """
    with whole_folder(folder, force=force) as partial:
        for study in reproduced:
            place = partial / study.entry.name
            place.mkdir()
            study.table.to_csv(place / "runs.csv", index=False)
            for name, drawing in study.figures.items():
                plots.save(drawing.figure, place / f"{name}.png")
        content = {
            "orthaug": __version__,
            "pipeline": pipeline,
            "counts": _counts(reproduced)._asdict(),
            "size": _size(reproduced),
            "findings": as_rows(reproduced),
            "runs": {study.entry.name: when_text(study.runs) for study in reproduced},
        }
        (partial / MARK).write_text(
            json.dumps(content, indent=1, ensure_ascii=False) + "\n", encoding="utf-8"
        )
        (partial / "index.html").write_text(_page(reproduced, pipeline), encoding="utf-8")


def as_rows(reproduced: Sequence[StudyOutcome]) -> list[dict[str, object]]:
    """Return the findings as plain rows, each with its study."""
    return [
        {"study": study.entry.name, **finding._asdict()}
        for study in reproduced
        for finding in study.findings
    ]


def _counts(reproduced: Sequence[StudyOutcome]) -> Counts:
    return Counts.of(finding for study in reproduced for finding in study.findings)


def reduced_text(reproduced: Sequence[StudyOutcome]) -> str:
    """Return what the reduced size means for the comparisons; empty at full size."""
    some = [study for study in reproduced if study.small]
    if not some:
        return ""
    made, whole = sum(len(study.runs) for study in some), sum(study.whole for study in some)
    return (
        f"small: {made} of {whole} runs. At this size differences from the paper and its "
        "scripts are expected; without --small it is seen which of them stay."
    )


def _size(reproduced: Sequence[StudyOutcome]) -> dict[str, object]:
    """Return the reduced size in words, null at full size, and each study's runs of all."""
    studies = {
        study.entry.name: {"runs": len(study.runs), "of": study.whole} for study in reproduced
    }
    return {
        "small": any(study.small for study in reproduced),
        "text": reduced_text(reproduced) or None,
        "studies": studies,
    }


def when_text(done: Sequence[Run]) -> str:
    """Return how many runs were made now or read from a store, when, and their seconds."""
    parts = []
    for stored in (False, True):
        some = [run for run in done if run.stored is stored]
        if some:
            days = sorted({run.made[:10] for run in some})
            dates = days[0] if len(days) == 1 else f"{days[0]} to {days[-1]}"
            origin = "read from the store, made on" if stored else "made now, on"
            parts.append(
                f"{len(some)} {origin} {dates} in {sum(run.seconds for run in some):.3g} s"
            )
    return f"{len(done)} run{'s' * (len(done) != 1)}: {'; '.join(parts)}, summed over runs"


def text(reproduced: Sequence[StudyOutcome]) -> str:
    """Return a table per study, in lines for a terminal, and what is met."""
    from rich import box
    from rich.console import Console
    from rich.table import Table

    buffer = io.StringIO()
    console = Console(file=buffer, width=WIDTH, color_system=None, legacy_windows=False)
    for study in reproduced:
        table = Table(
            title=study.entry.title,
            title_justify="left",
            box=box.SIMPLE_HEAD,
            padding=(0, 1),
            expand=True,
        )
        for name, ratio in (
            ("quantity", 24),
            ("published", 14),
            ("scripts", 18),
            ("ours", 18),
            ("verdict", 26),
        ):
            table.add_column(name, ratio=ratio, overflow="fold")
        for row in study.findings:
            references = ((row.published, row.as_published), (row.scripts, row.as_scripts))
            marked = (_mark(*pair, study.small) for pair in references)
            table.add_row(row.quantity, *marked, row.ours, row.verdict)
        console.print(table, markup=False, highlight=False)
        if study.small:
            console.print(
                f"small: {len(study.runs)} of {study.whole} runs\n", markup=False, highlight=False
            )
    note = reduced_text(reproduced)
    if note:
        console.print(note, markup=False, highlight=False)
    counts = _counts(reproduced)
    console.print(
        f"met against the printed paper: {counts.published_met} of {counts.published}\n"
        f"met against its scripts, as measured: {counts.scripts_met} of {counts.scripts}\n"
        f"beyond the paper, neither met nor missed: {counts.beyond}",
        markup=False,
        highlight=False,
    )
    return "\n".join(line.rstrip() for line in buffer.getvalue().splitlines())


def _mark(reference: str, met: bool | None, small: bool) -> str:
    if met is None:
        return reference or "–"
    return f"{reference} ({'met' if met else 'differs at small size' if small else 'differs'})"


def _page(reproduced: Sequence[StudyOutcome], pipeline: str) -> str:
    source = (
        files("orthaug.studies").joinpath("templates/reproduction.html").read_text(encoding="utf-8")
    )
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True
    )
    environment.filters["whole"] = lambda words: words.replace("e-", f"e{HYPHEN}")
    studies = [
        {
            "entry": study.entry,
            "findings": study.findings,
            "figures": [(drawing, _inline(drawing.figure)) for drawing in study.figures.values()],
            "counts": Counts.of(study.findings),
            "when": when_text(study.runs),
            "small": study.small,
            "size": f"{len(study.runs)} of {study.whole} runs",
        }
        for study in reproduced
    ]
    return environment.from_string(source).render(
        studies=studies,
        theory=THEORY,
        trained=PIPELINES[pipeline],
        version=__version__,
        reduced=reduced_text(reproduced),
        counts=_counts(reproduced),
    )


def _inline(figure: Figure) -> str:
    buffer = io.BytesIO()
    figure.savefig(buffer, dpi=160, format="png")
    return base64.b64encode(buffer.getvalue()).decode()
