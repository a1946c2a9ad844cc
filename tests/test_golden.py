"""Golden numbers: what the commands answer about the specs in tests/golden, against the answers stored beside them.

The first lines of a spec say what is asked of it, a command a line: `#: split run.csv --measure symmetrized`. Numbers
are equal to 1e-9, or to what the spec says with the reason: `#: within 1e-6`. `#: proof` leaves it to `make proofs`.
The records are those of golden_records.py. `python tests/test_golden.py` writes the answers anew, after a change that
moves them on purpose; `python tests/test_golden.py -k motion_exact` those of one spec. Read the diff before a commit.
"""

from __future__ import annotations

import io
import json
import math
import os
import shutil
import subprocess
import sys
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from compare_results import RELATIVE, differences
from test_cli import run

FOLDER = Path(__file__).parent / "golden"
VOLATILE = {
    *(
        "orthaug",
        "schema",
        "seconds",
        "sha256",
        "spec",
    ),  # versions, times, checksums of files and of a model, the spec as it is given
    *("text", "message", "sentence", "doubt"),  # words for people, which may change
    *(
        "worst",
        "phi_worst",
        "weights_worst",
    ),  # where something is largest, often at several places alike
}
ROUNDING = 1e-12  # a response whose input does not reach the output, so that its phase is rounding
LONG = 24  # numbers of a list from which on only a few, mean and RMS are kept


def specs(kind: str) -> list[Any]:
    """Return the specs of a kind as parameters of a test."""
    paths = sorted(FOLDER.glob(f"{kind}_*.toml"))
    return [
        pytest.param(path, id=path.stem, marks=[pytest.mark.proof] * ("proof" in asked(path)))
        for path in paths
    ]


def asked(spec: Path) -> list[str]:
    """Return what the first lines of a spec ask."""
    return [
        line[2:].strip()
        for line in spec.read_text(encoding="utf-8").splitlines()
        if line.startswith("#:")
    ]


def answers(spec: Path) -> dict[str, Any]:
    """Return the answer to each command of a spec, run in the current folder."""
    shutil.copy(spec, ".")
    found: dict[str, Any] = {}
    for number, line in zip(
        count(), (line for line in asked(spec) if not line.startswith(("within", "proof")))
    ):
        command, *options = line.split()
        subject = (
            [spec.name]
            if command in ("check", "fit", "compare", "select", "design")
            else [spec.stem, *options]
        )
        out = {"fit": spec.stem, "design": f"{spec.stem}.csv"}.get(command, f"{spec.stem}-{number}")
        out = (
            []
            if command in ("check", "split", "explain", "linearize", "simulate", "predict")
            else ["--out", out]
        )
        table = command in ("simulate", "predict")
        done = run(command, *subject, *out, *([] if table else ["--json"]))
        assert done.code == 0, f"{line}: {done.err}"
        answer = (
            pd.read_csv(io.StringIO(done.out)).to_dict("list") if table else json.loads(done.out)
        )
        found[line] = lasting(answer)
    return found


def is_checksum(entry: Any) -> bool:
    """Return whether it is the checksum of a model, which is that of its last bits."""
    return isinstance(entry, str) and len(entry) == 64 and " " not in entry


def lasting(value: Any) -> Any:
    """Return an answer without what is volatile, numbers with twelve digits, long lists as a few of them."""
    sizes = value.get("magnitude") if isinstance(value, dict) and "phase" in value else None
    if isinstance(sizes, list) and np.max(np.abs(sizes), initial=0.0) < ROUNDING:
        return "rounding"
    if isinstance(value, dict):
        return {
            name: lasting(entry)
            for name, entry in value.items()
            if name not in VOLATILE and not (name == "model" and is_checksum(entry))
        }
    if (
        isinstance(value, list)
        and len(value) > LONG
        and all(isinstance(entry, float | int) for entry in value)
    ):
        size = {
            "length": len(value),
            "mean": np.nanmean(value),
            "rms": np.sqrt(np.nanmean(np.square(value))),
        }
        return lasting(size | {"some": value[:: len(value) // 8]})
    if isinstance(value, list):
        return [lasting(entry) for entry in value]
    if isinstance(value, float):
        return float(f"{value:.12g}") if math.isfinite(value) else None
    return value


def assert_golden(spec: Path) -> None:
    """Compare the answers to a spec with those that are stored, or store them."""
    stored, found = spec.with_suffix(".json"), answers(spec)
    if os.environ.get("GOLDEN") == "write":
        lines = [
            f"{json.dumps(line)}: {json.dumps(answer, ensure_ascii=False)}"
            for line, answer in found.items()
        ]
        stored.write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")
    relative = [float(line.split()[1]) for line in asked(spec) if line.startswith("within")] or [
        RELATIVE
    ]
    kept = lasting(json.loads(stored.read_text(encoding="utf-8")))
    differing = differences(kept, found, relative=relative[0], floor=relative[0])
    largest = sorted(differing, key=lambda one: -one.relative)
    listed = "\n".join(map(str, largest[:10]))
    assert not largest, f"{len(largest)} numbers of {spec.name} differ, by most:\n{listed}"


@pytest.mark.parametrize("spec", specs("lagged"))
@pytest.mark.usefixtures("golden_folder", "without_figures")
def test_lagged_physics(spec):
    assert_golden(spec)


if __name__ == "__main__":
    files = sorted(Path(__file__).parent.glob("test_golden*.py"))
    whole = [
        sys.executable,
        "-m",
        "pytest",
        "-q",
        "-m",
        "proof or not proof",
        *map(str, files),
        *sys.argv[1:],
    ]
    sys.exit(subprocess.call(whole, env={**os.environ, "GOLDEN": "write"}))
