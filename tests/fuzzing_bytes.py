"""Entry points for a fuzzer that is guided by coverage: functions of bytes that raise only at a fault.

With atheris, which is no dependency: `python benchmarks/fuzz.py --guided expression CORPUS -max_total_time=600`.
"""

from __future__ import annotations

import json
import tempfile
from functools import cache
from pathlib import Path
from typing import Any

import fuzzing
from safetensors.numpy import load as load_arrays

from orthaug import InputError
from orthaug.data.expressions import parse_named
from orthaug.data.tables import read_titles
from orthaug.models import storage

ENDINGS = (".csv", ".tsv", ".npz", ".mat", ".h5", ".xlsx", ".parquet")
_KNOWN = dict.fromkeys(("x", "v", "u", "k"), 1.0)


def expression(data: bytes) -> None:
    """Parse text as an equation of motion."""
    try:
        parse_named(data.decode("utf-8", "replace"), _KNOWN, "equation")
    except InputError:
        return


def header(data: bytes) -> None:
    """Read the columns of a file whose ending the first byte chooses."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, f"run{ENDINGS[data[0] % len(ENDINGS)] if data else '.csv'}")
        path.write_bytes(data[1:])
        try:
            read_titles(path)
        except InputError:
            return


def model(data: bytes) -> None:
    """Load a model whose declaration is these bytes, its checksum made right, with the arrays of a fitted one."""
    with tempfile.TemporaryDirectory() as folder:
        try:
            declared = json.loads(data)
        except (ValueError, RecursionError):
            declared = None
        if isinstance(declared, dict):
            said = {
                k: v
                for k, v in declared.items()
                if k not in ("format", "orthaug", "arrays_sha256", "checksum")
            }
            packed = storage.pack(storage.FORMAT, said, _arrays("motion" in declared))
            try:
                storage.write_packed(
                    packed, Path(folder, "model.json"), Path(folder, "arrays.safetensors")
                )
            except UnicodeEncodeError:  # a lone surrogate is no text that a file holds
                return
        else:
            Path(folder, "model.json").write_bytes(data)
            Path(folder, "arrays.safetensors").write_bytes(b"")
        try:
            storage.load(folder)
        except InputError:
            return


@cache
def _arrays(motion: bool) -> dict[str, Any]:
    """The arrays of a small fitted model."""
    with tempfile.TemporaryDirectory() as folder:
        content = (
            fuzzing.motion_files(Path(folder)) if motion else fuzzing.model_files(Path(folder))
        )
    return load_arrays(content["arrays.safetensors"])


def write_seeds(target: str, corpus: Path) -> None:
    """Write valid inputs of a target to begin from: a fuzzer finds no archive and no model from nothing."""
    with tempfile.TemporaryDirectory() as name:
        folder, seeds = Path(name), {}
        if target == "header":
            for i, ending in enumerate(ENDINGS):
                kind = {".mat": "v5.mat"}.get(ending, ending[1:])
                fuzzing.write_original(kind, folder / f"run{ending}")
                seeds[kind] = bytes([i]) + (folder / f"run{ending}").read_bytes()
        elif target == "model":
            for kind, files in (("lagged", fuzzing.model_files), ("motion", fuzzing.motion_files)):
                (folder / kind).mkdir()
                seeds[kind] = files(folder / kind)["model.json"]
        else:
            seeds["equation"] = b"-(u - k*x**2)/max(abs(v), 1e-3) + tanh(2*v)*sqrt(x**2 + 1) - pi"
    for kind, content in seeds.items():
        (corpus / kind).write_bytes(content)


TARGETS = {"expression": expression, "header": header, "model": model}
