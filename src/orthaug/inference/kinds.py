"""The measures that a spec refers to by name.

A new one is a file with its declaration, and an entry here.

Those from files become `Samples` and `Weighted`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from annotated_types import Ge

from orthaug._base import plugins
from orthaug._base.errors import InputError, KeyedError
from orthaug._base.registry import Option, Registry
from orthaug.data.readers import read_record, read_samples
from orthaug.data.record import Record
from orthaug.inference.measures import Samples, Symmetrized, Training, Uniform, Weighted

Row = Annotated[int, Ge(0)]
Range = tuple[Row, Row]


@dataclass(frozen=True, eq=False)
class MeasurePlace:
    """Context that resolves a declared measure: folder of its files, raw lags, training data.

    `start` is the first usable row of each experiment.
    """

    folder: Path
    lags: Sequence[str]
    record: Record
    start: int


@dataclass(frozen=True)
class SampleFiles:
    """Declaration of `Samples` by files with a column per raw lag, and optionally `weight`.

    Columns are named as in expressions.

    Args:
        files: their paths, relative to the spec.
        rows: half-open ranges of rows of each file; None for all.
        every: keep each n-th row.
    """

    files: Annotated[tuple[str, ...], Option("samples")] = ()
    rows: Range | tuple[Range, ...] | None = None
    every: Annotated[int, Ge(1)] = 1

    def __post_init__(self) -> None:
        _check_files(self.files, "samples")

    def resolve(self, place: MeasurePlace) -> Samples:
        files = [place.folder / file for file in self.files]
        return Samples(*read_samples(files, place.lags, rows=self.rows, every=self.every))


@dataclass(frozen=True)
class WeightFiles:
    """Declaration of `Weighted` by files with a column `weight`.

    Together they have a row for each row of the training data.

    Rows before the first usable one have weights too, which are not used.
    """

    files: Annotated[tuple[str, ...], Option("weights")] = ()

    def __post_init__(self) -> None:
        _check_files(self.files, "weights")

    def resolve(self, place: MeasurePlace) -> Weighted:
        files = [place.folder / file for file in self.files]
        weights = np.concatenate(
            [
                read_record(f, outputs=["weight"], sampling_time=1.0).experiments[0].outputs[:, 0]
                for f in files
            ]
        )
        lengths = [len(experiment) for experiment in place.record.experiments]
        if len(weights) != sum(lengths):
            raise InputError(
                f"{', '.join(map(str, files))}: {len(weights)} weights for {sum(lengths)} rows "
                "of training data; give one for each row, in the same order."
            )
        pieces = np.split(weights, np.cumsum(lengths)[:-1])
        return Weighted(np.concatenate([piece[place.start :] for piece in pieces]))


def _check_files(files: Sequence[str], what: str) -> None:
    if not files:
        words = f" is missing; expected the files that hold the {what}"
        raise KeyedError(f"`files`{words}.", "files", words)


MEASURES = Registry(
    "measure",
    {
        "training": Training,
        "symmetrized": Symmetrized,
        "uniform": Uniform,
        "samples": SampleFiles,
        "weighted": WeightFiles,
    },
    group=plugins.MEASURES,
)
