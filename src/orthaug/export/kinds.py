"""The targets of `orthaug export --to`. A new one is a file with its declaration, and an entry here."""

from __future__ import annotations

from orthaug.export.c_source import CSource
from orthaug.export.casadi_module import CasadiModule
from orthaug.export.control_module import ControlModule
from orthaug.export.fmu import Fmu
from orthaug.export.latex_text import LatexText
from orthaug.export.numpy_module import NumpyModule
from orthaug.export.onnx_graph import OnnxGraph
from orthaug.export.target import Target

TARGETS: dict[str, type[Target]] = {
    "c": CSource,
    "casadi": CasadiModule,
    "control": ControlModule,
    "fmu": Fmu,
    "numpy": NumpyModule,
    "onnx": OnnxGraph,
    "latex": LatexText,
}
