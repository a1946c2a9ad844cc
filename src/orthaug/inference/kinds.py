"""The measures that a spec knows by name. A new one is a file with its declaration, and an entry here."""

from __future__ import annotations

from orthaug._base.registry import Registry
from orthaug.inference.measure_files import SampleFiles, WeightFiles
from orthaug.inference.measures import Symmetrized, Training, Uniform

MEASURES = Registry(
    "measure",
    {
        "training": Training,
        "symmetrized": Symmetrized,
        "uniform": Uniform,
        "samples": SampleFiles,
        "weighted": WeightFiles,
    },
)
