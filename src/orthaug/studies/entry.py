"""An entry of `orthaug reproduce`: its runs, its figures, its numbers beside the published ones."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

from orthaug.studies.study import Study

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure


class Finding(NamedTuple):
    """A quantity beside what is published and what the published scripts gave when they were run."""

    quantity: str
    published: str
    scripts: str
    ours: str
    met: bool
    verdict: str
    """One sentence where they differ; short where they agree."""


@dataclass(frozen=True)
class Reproduction:
    """One entry of `orthaug reproduce`.

    `study(pipeline, small)` declares the runs: pipeline "ours", "paper" or "scripts"; `small` for the size of the
    tests. `figures(table)` draws, by file name; `findings(table)` compares. `text` says what is shown.
    """

    name: str
    title: str
    text: str
    study: Callable[[str, bool], Study]
    figures: Callable[[pd.DataFrame], Mapping[str, Figure]]
    findings: Callable[[pd.DataFrame], list[Finding]]
