"""Targets of `orthaug export --to`.

A new one is a file with a declaration, and an entry.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol, runtime_checkable

from orthaug._base import plugins
from orthaug._base.registry import Registry
from orthaug.export.c_source import CSource
from orthaug.export.fmu import Fmu
from orthaug.export.latex_text import LatexText
from orthaug.export.numpy_module import ControlModule, NumpyModule
from orthaug.export.onnx_graph import OnnxGraph
from orthaug.export.program import Program, Vectors
from orthaug.export.python_code import CasadiModule

VECTORS = "vectors.csv"


@runtime_checkable
class Target(Protocol):
    """A language or tool that a model is exported to. `summary` says in one line what is made."""

    summary: str

    def files(self, program: Program, vectors: Vectors) -> Mapping[str, str | bytes]:
        """Return content by file name; README.md and the test vectors are added to them.

        Raises:
            InputError: a model that this target cannot hold.
        """
        ...

    def usage(self, program: Program) -> str:
        """Return instructions in Markdown to run the exported code."""
        ...


TARGETS = Registry(
    "export",
    {
        "c": CSource,
        "casadi": CasadiModule,
        "control": ControlModule,
        "fmu": Fmu,
        "numpy": NumpyModule,
        "onnx": OnnxGraph,
        "latex": LatexText,
    },
    group=plugins.EXPORTERS,
)
