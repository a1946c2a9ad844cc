"""An entry of `orthaug reproduce`: its runs, its figures, its numbers beside those of the paper and of its scripts."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

from orthaug.studies.study import Study

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure


class Finding(NamedTuple):
    """A quantity, each counted once, beside what the paper prints and what its scripts gave when they were run."""

    quantity: str
    ours: str
    verdict: str
    """What the numbers say, in words."""
    published: str = ""
    scripts: str = ""
    as_published: bool | None = None
    """Whether ours agrees with the paper; None where the paper has nothing to compare with."""
    as_scripts: bool | None = None
    """Whether ours agrees with the scripts' runs; None where they have nothing to compare with."""

    @property
    def beyond(self) -> bool:
        """Whether there is nothing to compare with, so that the row is neither met nor missed."""
        return self.as_published is None and self.as_scripts is None


class Counts(NamedTuple):
    """Comparisons that are met, and all of them, apart by what ours is compared with; rows beyond the paper."""

    published_met: int
    published: int
    scripts_met: int
    scripts: int
    beyond: int

    @classmethod
    def of(cls, findings: Iterable[Finding]) -> Counts:
        rows = list(findings)
        paper = [row.as_published for row in rows if row.as_published is not None]
        scripts = [row.as_scripts for row in rows if row.as_scripts is not None]
        return cls(sum(paper), len(paper), sum(scripts), len(scripts), sum(row.beyond for row in rows))


class Drawing(NamedTuple):
    """A figure, one sentence on what it shows, and sentences on how to read it."""

    figure: Figure
    shows: str
    reading: str = ""


@dataclass(frozen=True)
class Reproduction:
    """One entry of `orthaug reproduce`.

    `study(pipeline, small)` declares the runs: `pipeline` is one of `reproduction.PIPELINES`; `small` for the reduced
    size of the tests. `figures(table)` draws, by file name; `findings(table)` compares. `text` says what is run.
    """

    name: str
    title: str
    text: str
    study: Callable[[str, bool], Study]
    figures: Callable[[pd.DataFrame], Mapping[str, Drawing]]
    findings: Callable[[pd.DataFrame], list[Finding]]
