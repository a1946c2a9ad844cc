"""Seeded mutations of data files, specs and saved models, and the judgement of what the library makes of each.

A trial ends as "refused" (an InputError of one line), "equal" (what a plain reading of the mutated bytes gives, or
for models what was saved) or, for a fault, in words. The same seed gives the same mutation everywhere.
"""

from __future__ import annotations

import io
import json
import math
import re
import tomllib
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
from plain_readers import NAMES, plain

from orthaug import InputError, read_record

ROWS = 24
TYPES = ("csv", "semicolons.csv", "tsv", "xlsx", "parquet", "npz", "v5.mat", "v73.mat", "h5")
_EXTREMES = (
    b"\x00",
    b"\xff",
    b"\x7f\xff\xff\xff",
    b"\x80\x00\x00\x00",
    b"\xff" * 8,
    b"9" * 30,
    b"-1",
    b"1e999",
    b"nan",
)
_TEXTS = (
    *(
        "",
        "-1",
        "0",
        "1e308",
        "1e999",
        "nan",
        "inf",
        "true",
        '""',
        "'x'",
        "[]",
        "{}",
        "[[0, 1], 2]",
        "9" * 40,
        "0.5",
    ),
    *(
        '"y[k]"',
        '"u[k-99999]"',
        '"1/0*u[k]"',
        '"u[k"',
        '"\\u0000"',
        '"a\\nb"',
        "[" * 3000,
        "1979-05-27",
        '"auto"',
    ),
)


def signals() -> tuple[np.ndarray, np.ndarray]:
    """Two columns of numbers with all their digits."""
    rng = np.random.default_rng(0)
    u = rng.normal(size=ROWS)
    return u, np.round(3 * np.tanh(u) + rng.normal(size=ROWS), 3)


def write_original(kind: str, path: Path) -> None:
    """A sound file of one of the nine types."""
    u, y = signals()
    if kind.endswith(("csv", "tsv")):
        separator = {"csv": ",", "tsv": "\t", "semicolons.csv": ";"}[kind]
        lines = [separator.join(("u", "y", "note"))]
        lines += [
            separator.join((repr(a), repr(b), f"n{i}"))
            for i, (a, b) in enumerate(zip(u.tolist(), y.tolist(), strict=True))
        ]
        text = "\n".join(lines) + "\n"
        path.write_text(text.replace(".", ",") if separator == ";" else text)
    elif kind == "xlsx":
        import openpyxl

        book = openpyxl.Workbook()
        for row in (NAMES, *zip(u.tolist(), y.tolist(), strict=True)):
            book.active.append(row)
        book.save(path)
    elif kind == "parquet":
        import pyarrow as pa
        import pyarrow.parquet as pq

        table = pa.table({"u": u, "y": y})
        pq.write_table(
            table, path, write_page_checksum=True, compression="none", use_dictionary=False
        )
    elif kind == "npz":
        np.savez(path, u=u, y=y)
    elif kind == "v5.mat":
        import scipy.io

        scipy.io.savemat(path, {"u": u, "y": y})
    else:
        import h5py

        with h5py.File(path, "w", userblock_size=512 if kind == "v73.mat" else 0) as file:
            file["u"], file["y"] = u, y
        if kind == "v73.mat":
            path.write_bytes(
                b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM" + path.read_bytes()[128:]
            )


def mutated(content: bytes, rng: np.random.Generator) -> bytes:
    """One to four small damages: bytes changed, removed, repeated, inserted, or the end cut off."""
    for _ in range(rng.integers(1, 5)):
        if not content:
            return content
        at, size = int(rng.integers(len(content))), int(rng.integers(1, 1 + min(64, len(content))))
        piece = _EXTREMES[rng.integers(len(_EXTREMES))]
        content = (
            content[:at] + bytes([content[at] ^ (1 << int(rng.integers(8)))]) + content[at + 1 :],
            content[:at] + piece + content[at + len(piece) :],
            content[:at] + rng.bytes(size) + content[at + size :],
            content[:at] + content[at + size :],
            content[:at] + content[at : at + size] * 2 + content[at + size :],
            content[:at] + piece + content[at:],
            content[: max(at, len(content) // 2)],
        )[rng.choice(7, p=[0.3, 0.2, 0.15, 0.1, 0.1, 0.1, 0.05])]
    return content


def mutated_member(content: bytes, rng: np.random.Generator) -> bytes:
    """An archive with one of its members damaged, left out or doubled, its checksums right again."""
    source = zipfile.ZipFile(io.BytesIO(content))
    names = source.namelist()
    victim, drop = names[rng.integers(len(names))], rng.random() < 0.05
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in names:
            part = source.read(name)
            if name != victim:
                archive.writestr(name, part)
            elif not drop:
                archive.writestr(
                    name, _digits(part, rng) if rng.random() < 0.5 else mutated(part, rng)
                )
    return out.getvalue()


def _digits(content: bytes, rng: np.random.Generator) -> bytes:
    """One of the numbers in a text replaced, so that it stays well formed."""
    places = list(re.finditer(rb"\d+", content))
    if not places:
        return mutated(content, rng)
    found = places[rng.integers(len(places))]
    new = (b"0", b"7", b"1048576", b"99999999999", b"-1", b"1e400", b"1.5", b"")[rng.integers(8)]
    return content[: found.start()] + new + content[found.end() :]


def refusal_or(judge: Callable[[], str]) -> str:
    """ "refused" for an InputError of one visible line, otherwise what `judge` says, or the fault in words."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            return judge()
    except InputError as refusal:
        text = str(refusal)
        return "refused" if text.isprintable() and len(text) <= 1210 else f"message: {text!r}"
    except Exception as error:  # the very thing that is looked for
        return f"{type(error).__name__}: {error}"[:300]


def try_file(kind: str, seed: int, original: bytes, folder: Path) -> str:
    """One mutation of a data file."""
    rng = np.random.default_rng([TYPES.index(kind), seed])
    inner = kind in ("xlsx", "npz") and seed % 4
    path = folder / f"run.{kind}"
    path.write_bytes(mutated_member(original, rng) if inner else mutated(original, rng))

    def judge() -> str:
        record = read_record(path, inputs=["u"], outputs=["y"], sampling_time=1.0)
        found = {"u": record.experiments[0].inputs[:, 0], "y": record.experiments[0].outputs[:, 0]}
        try:
            expected = plain(path)
        except (
            Exception
        ) as error:  # it does not know what else a format may hold, nor what it may leave out
            if all(
                found[name].tolist() == own.tolist()
                for name, own in zip(NAMES, signals(), strict=True)
            ):
                return "equal"
            return f"read, but plainly not: {type(error).__name__}: {error}"[:300]
        same = all(found[name].tolist() == expected[name] for name in NAMES)
        return "equal" if same else "another number"

    return refusal_or(judge)


def try_spec(seed: int, text: str, folder: Path) -> str:
    """One mutation of a spec, opened with its data: what is accepted holds what the file says."""
    from orthaug.commands.opening import open_job

    rng = np.random.default_rng([100, seed])
    path = folder / "spec.toml"
    if seed % 3 == 0:
        path.write_bytes(mutated(text.encode(), rng))
    else:
        for _ in range(rng.integers(1, 4)):
            text = _spec_changed(text, rng)
        path.write_text(text, encoding="utf-8")

    def judge() -> str:
        spec = open_job(path, require_full_rank=False).spec
        given = tomllib.loads(path.read_text(encoding="utf-8-sig"))
        return "equal" if _agrees(given, spec.model_dump(exclude_unset=True)) else "another number"

    return refusal_or(judge)


def _spec_changed(text: str, rng: np.random.Generator) -> str:
    lines = text.splitlines()
    i, j = (int(n) for n in rng.integers(len(lines), size=2))
    value = _TEXTS[rng.integers(len(_TEXTS))]
    act = rng.integers(6)
    if act == 0:
        lines.insert(i, lines[j])
    elif act == 1:
        del lines[i]
    elif act == 2 and "=" in lines[i]:
        lines[i] = lines[i].split("=")[0] + "= " + value
    elif act == 3:
        lines[i], lines[j] = lines[j], lines[i]
    elif act == 4:
        lines[i] = re.sub(r"[\d.]+", lambda _: value, lines[i], count=1)
    else:
        lines[i] = lines[i].replace('"', value.strip("\"'[]{}")[:5] + '"', 1)
    return "\n".join(lines) + "\n"


def _agrees(given: object, kept: object) -> bool:
    """Whether every value of a TOML file stands in what was read from it."""
    if isinstance(given, dict):
        return isinstance(kept, dict) and all(
            k in kept and _agrees(v, kept[k]) for k, v in given.items()
        )
    if isinstance(given, list):
        return (
            isinstance(kept, list | tuple)
            and len(kept) == len(given)
            and all(map(_agrees, given, kept))
        )
    if isinstance(given, float) and isinstance(kept, float):
        return given == kept or (math.isnan(given) and math.isnan(kept))
    return (
        type(given) is type(kept)
        and given == kept
        or (isinstance(given, int) and kept == float(given))
    )


def try_model(seed: int, original: dict[str, bytes], folder: Path) -> str:
    """One mutation of a saved model: refused, or bit by bit what was saved. With a forged checksum: no traceback."""
    from orthaug.models import packed_files, storage

    rng = np.random.default_rng([200, seed])
    victim = sorted(original)[rng.integers(len(original))]
    forged = seed % 5 == 0
    for name, content in original.items():
        if name == victim and not forged:
            content = (
                _digits(content, rng)
                if name.endswith("json") and seed % 2
                else mutated(content, rng)
            )
        (folder / name).write_bytes(content)
    if forged:
        declared = _json_changed(json.loads(original["model.json"]), rng)
        declared.pop("checksum", None)
        declared["checksum"] = packed_files._checksum(declared)
        (folder / "model.json").write_text(json.dumps(declared), encoding="utf-8")

    def judge() -> str:
        model = storage.load(folder)
        if forged:
            return "equal"
        again = folder / "again"
        again.mkdir(exist_ok=True)
        storage.write(model, again)
        same = all((again / name).read_bytes() == content for name, content in original.items())
        return "equal" if same else "another model"

    return refusal_or(judge)


def _json_changed(node: object, rng: np.random.Generator) -> object:
    """A declaration with one entry somewhere in it replaced or left out."""
    values = (None, -1, 1e308, "x", [], {}, True, [[1]], 10**30, "a\nb")
    if isinstance(node, dict) and node:
        key = sorted(node)[rng.integers(len(node))]
        act = rng.random()
        if act < 0.2:
            return {k: v for k, v in node.items() if k != key}
        changed = _json_changed(node[key], rng) if act < 0.8 else values[rng.integers(len(values))]
        return {**node, key: changed}
    if isinstance(node, list) and node and rng.random() < 0.8:
        i = int(rng.integers(len(node)))
        return [*node[:i], _json_changed(node[i], rng), *node[i + 1 :]]
    return values[rng.integers(len(values))]


SPEC = """
[data]
sampling_time = 0.5
inputs = ["u"]
outputs = ["y"]
train = { files = ["run.csv"], rows = [0, 20] }
[data.tests.steps]
files = ["run.csv"]
rows = [[10, 16], [18, 24]]
skip = 2
[data.channels.y]
unit = "m"
scale = 2.5
[lags]
na = 1
nb = [2]
[[baseline.terms]]
parameter = "a"
regressor = "y[k-1]"
initial = 0.5
min = -0.75
max = 1.5
[[baseline.terms]]
parameter = "c"
regressor = "g*u[k-1]"
[baseline.constants]
g = 9.81
[[suspects]]
kind = "coulomb"
on = "y[k-1]"
coefficient = 0.1
[design]
samples = 400
amplitude = 1.5
[learner]
kind = "mlp"
hidden = [4, 3]
activation = "tanh"
[structure]
kind = "orthogonal-penalty"
weight = 2.0
[training]
iterations = 50
restarts = 3
seed = 7
regularization = 0.1
output_weights = "std"
[validation]
blocks = 3
"""


def model_files(folder: Path) -> dict[str, bytes]:
    """A small fitted model as it is saved."""
    import orthaug as oa
    from orthaug import Channel

    u, y = signals()
    record = oa.Record.from_arrays(u, y, outputs=[Channel("y", "m")])
    baseline = oa.Baseline.from_terms(
        [oa.Term("a", "y[k-1]"), oa.Term("b", "g*u[k]", 0.5, "m")], {"g": 2.0}
    )
    solver = oa.LevenbergMarquardt(iterations=2)
    oa.save(oa.estimate(record, baseline, learner=oa.MLP(hidden=(2,)), solver=solver).model, folder)
    return {
        path.name: path.read_bytes() for path in folder.iterdir() if path.name != "manifest.json"
    }


def motion_files(folder: Path) -> dict[str, bytes]:
    """A small fitted motion as it is saved."""
    import orthaug as oa

    u, y = signals()
    motion = oa.Motion.from_equations(
        [oa.State("x", "a*(u - d)", start="y", learned=True)],
        [oa.Output("y", "x")],
        [oa.PhysicalParameter("a", 1.0, "1/s", min=0)],
        ["u"],
        define={"d": "x/2"},
    )
    solver = oa.LevenbergMarquardt(iterations=2)
    record = oa.Record.from_arrays(u, y, sampling_time=0.1)
    oa.save(oa.estimate(record, motion, learner=oa.MLP(hidden=(2,)), solver=solver).model, folder)
    return {
        path.name: path.read_bytes() for path in folder.iterdir() if path.name != "manifest.json"
    }
