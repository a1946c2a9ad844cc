"""`orthaug reproduce`: the paper's studies run, drawn, put beside the published numbers, and gathered on one page."""

from __future__ import annotations

import base64
import io
import json
import time
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
from orthaug.studies.catalogue import catalogue
from orthaug.studies.entry import Finding, Reproduction
from orthaug.studies.study import run
from orthaug.studies.theory import THEORY

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

PIPELINES = ("ours", "paper", "scripts")
MARK = "reproduction.json"
StudiesTell = Callable[[str, int, int], None]
"""Called with the study's title, the runs done and all of them."""


@dataclass(frozen=True, eq=False)
class Reproduced:
    """One study with its table, figures and findings."""

    entry: Reproduction
    table: pd.DataFrame
    figures: dict[str, Figure]
    findings: list[Finding]
    seconds: float
    small: bool = False


def chosen(name: str | None) -> list[Reproduction]:
    """The studies to run: one by name, or all.

    Raises:
        InputError: no study of that name.
    """
    known = catalogue()
    if name is None:
        return list(known.values())
    if name not in known:
        raise InputError(f"there is no study '{name}'{nearest(name, known) or '.'} There are {', '.join(known)}.")
    return [known[name]]


def reproduce(
    entries: Sequence[Reproduction],
    *,
    pipeline: str = "ours",
    small: bool = False,
    store: Path | None = None,
    progress: StudiesTell | None = None,
) -> list[Reproduced]:
    """Run the studies; what a store holds already is not run again.

    Args:
        pipeline: "ours", "paper" for Adam and L-BFGS with the published iterations on normalised data, or "scripts"
            for what the published scripts do, un-normalised and from θ⁰.
        small: at the reduced size of the tests.
        store: where results are kept as they are made; None for the user's cache folder.
    """
    check_choice(pipeline, PIPELINES, "--pipeline")
    store = Path(platformdirs.user_cache_dir("orthaug")) / "studies" if store is None else store
    reproduced = []
    for entry in entries:
        began = time.perf_counter()
        tell = None if progress is None else lambda done, total, e=entry: progress(e.title, done, total)
        table = run(entry.study(pipeline, small), store=store, progress=tell)
        drawn, compared = dict(entry.figures(table)), entry.findings(table)
        reproduced.append(Reproduced(entry, table, drawn, compared, time.perf_counter() - began, small))
    return reproduced


def is_reproduction(folder: Path) -> bool:
    """Whether a folder holds what `orthaug reproduce` wrote."""
    return (folder / MARK).is_file()


def check_output(folder: Path) -> None:
    """Raise InputError early where the page could not be written."""
    check_replaceable(folder, is_reproduction)


def write(reproduced: Sequence[Reproduced], folder: Path, pipeline: str) -> None:
    """index.html, and for each study its figures as PNG and its runs as CSV; whole or not at all."""
    with whole_folder(folder, is_reproduction) as partial:
        for study in reproduced:
            place = partial / study.entry.name
            place.mkdir()
            study.table.to_csv(place / "runs.csv", index=False)
            for name, figure in study.figures.items():
                plots.save(figure, place / f"{name}.png")
        content = {"orthaug": __version__, "pipeline": pipeline, "findings": as_rows(reproduced)}
        (partial / MARK).write_text(json.dumps(content, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
        (partial / "index.html").write_text(_page(reproduced, pipeline), encoding="utf-8")


def as_rows(reproduced: Sequence[Reproduced]) -> list[dict[str, Any]]:
    """The findings as plain rows, each with its study."""
    return [{"study": study.entry.name, **finding._asdict()} for study in reproduced for finding in study.findings]


def text(reproduced: Sequence[Reproduced]) -> str:
    """The table: quantity, published, the published scripts as measured, ours, verdict."""
    head = ("quantity", "published", "scripts", "ours", "", "verdict")
    rows: list[tuple[str, ...]] = [head]
    for finding in (finding for study in reproduced for finding in study.findings):
        mark = "met" if finding.met else "differs"
        rows.append((finding.quantity, finding.published, finding.scripts, finding.ours, mark, finding.verdict))
    widths = [max(len(row[i]) for row in rows) for i in range(len(head))]
    return "\n".join("  ".join(c.ljust(w) for c, w in zip(row, widths, strict=True)).rstrip() for row in rows)


def _page(reproduced: Sequence[Reproduced], pipeline: str) -> str:
    """One HTML file with its figures inside."""
    source = files("orthaug.studies").joinpath("templates/reproduction.html").read_text(encoding="utf-8")
    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined)
    studies = [
        {
            "name": study.entry.name,
            "title": study.entry.title,
            "text": study.entry.text,
            "findings": study.findings,
            "figures": {name: _inline(figure) for name, figure in study.figures.items()},
            "runs": len(study.table),
            "seconds": f"{study.seconds:.0f}",
        }
        for study in reproduced
    ]
    findings = [finding for study in reproduced for finding in study.findings]
    return environment.from_string(source).render(
        studies=studies,
        theory=THEORY,
        pipeline=pipeline,
        version=__version__,
        small=any(study.small for study in reproduced),
        compared=len(findings),
        met=sum(finding.met for finding in findings),
    )


def _inline(figure: Figure) -> str:
    buffer = io.BytesIO()
    figure.savefig(buffer, dpi=160, format="png")
    return base64.b64encode(buffer.getvalue()).decode()
