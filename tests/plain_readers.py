"""Plain readings of data files, written without the library: what the bytes of a file say two columns hold."""

from __future__ import annotations

import csv
import io
import re
import struct
import xml.etree.ElementTree as ET
import zipfile
import zlib
from pathlib import Path

import numpy as np

Columns = dict[str, list[float]]
NAMES = ("u", "y")
_KINDS = {
    1: "i1",
    2: "u1",
    3: "i2",
    4: "u2",
    5: "i4",
    6: "u4",
    7: "f4",
    9: "f8",
    12: "i8",
    13: "u8",
}


def plain(path: Path) -> Columns:
    """The columns u and y, up to their last cell; an exception where the file does not say."""
    content = path.read_bytes()
    if path.suffix in (".csv", ".tsv"):
        return _text(content, "\t" if path.suffix == ".tsv" else None)
    if path.suffix == ".xlsx":
        return _sheet(content)
    if path.suffix == ".npz":
        with np.load(io.BytesIO(content), allow_pickle=False) as archive:
            return {name: archive[name].ravel().astype(float).tolist() for name in NAMES}
    if path.suffix == ".parquet":
        import pyarrow.parquet as pq

        table = pq.read_table(io.BytesIO(content), page_checksum_verification=True)
        return {name: [float(v) for v in table.column(name).to_pylist()] for name in NAMES}
    if path.suffix == ".mat" and b"\x89HDF" not in content[:1024]:
        return _mat(content)
    return _hdf5(path, content)


def _text(content: bytes, separator: str | None) -> Columns:
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError:  # as files of old programs are; `fit` warns of it
        text = content.decode("cp1252")
    lines = text.splitlines(keepends=True)
    top = next(i for i, line in enumerate(lines) if line.strip())
    if separator is None:
        separator = (
            ";" if ";" in lines[top] and "," not in re.sub(r'"[^"]*"', "", lines[top]) else ","
        )
    header, *rows = list(
        csv.reader(io.StringIO("".join(lines[top:]), newline=""), delimiter=separator)
    )
    places = {name: [cell.strip() for cell in header].index(name) for name in NAMES}
    commas = separator == ";"
    table = [[row[i].strip() if i < len(row) else "" for i in places.values()] for row in rows]
    while table and not any(table[-1]):
        table.pop()
    return {
        name: [float(row[j].replace(",", ".") if commas else row[j]) for row in table]
        for j, name in enumerate(NAMES)
    }


def _sheet(content: bytes) -> Columns:
    archive = zipfile.ZipFile(io.BytesIO(content))

    def tree(name: str) -> ET.Element:
        return ET.fromstring(archive.read(name))

    def local(element: ET.Element) -> str:
        return element.tag.rpartition("}")[2]

    first = next(e for e in tree("xl/workbook.xml").iter() if local(e) == "sheet")
    wanted = next(value for key, value in first.attrib.items() if key.endswith("}id"))
    target = next(
        e.get("Target") for e in tree("xl/_rels/workbook.xml.rels") if e.get("Id") == wanted
    )
    shared = []
    if "xl/sharedStrings.xml" in archive.namelist():
        shared = [
            "".join(t.text or "" for t in e.iter() if local(t) == "t")
            for e in tree("xl/sharedStrings.xml")
        ]
    cells: dict[tuple[int, str], str] = {}
    for cell in tree("xl/" + (target or "").removeprefix("/xl/")).iter():
        if local(cell) == "c":
            column, row = re.fullmatch(r"([A-Z]+)(\d+)", cell.attrib["r"]).groups()  # type: ignore[union-attr]
            value = next((e.text or "" for e in cell if local(e) == "v"), "")
            if cell.get("t") == "s":
                value = shared[int(value)] if int(value) >= 0 else str(1 / 0)
            elif cell.get("t") == "inlineStr":
                value = "".join(e.text or "" for e in cell.iter() if local(e) == "t")
            if value != "":
                cells[int(row), column] = value
    top = min(row for row, _ in cells)
    place = {text.strip(): column for (row, column), text in cells.items() if row == top}
    last = max([row for row, column in cells if column in (place["u"], place["y"])])
    return {
        name: [float(cells[row, place[name]]) for row in range(top + 1, last + 1)] for name in NAMES
    }


def _mat(content: bytes) -> Columns:
    found, at = {}, 128
    while at < len(content):
        kind, size = struct.unpack_from("<II", content, at)
        body, at = content[at + 8 : at + 8 + size], at + 8 + size
        if kind == 15:
            body = zlib.decompress(body)[8:]
        name, values = _matrix(body)
        found[name] = values
    return {name: found[name] for name in NAMES}


def _matrix(body: bytes) -> tuple[str, list[float]]:
    elements, at = [], 0
    while at < len(body):
        kind, size = struct.unpack_from("<II", body, at)
        if kind >> 16:  # small: size in the upper half, data in the next four bytes
            size, kind, start = kind >> 16, kind & 0xFFFF, at + 4
            at += 8
        else:
            start, at = at + 8, at + 8 + (size + 7) // 8 * 8
        elements.append((kind, body[start : start + size]))
    shape = np.frombuffer(elements[1][1], "<i4")
    kind, data = elements[3]
    values = np.frombuffer(data, "<" + _KINDS[kind]).astype(float)
    return elements[2][1].decode(), values[: int(np.prod(shape))].tolist()


def _hdf5(path: Path, content: bytes) -> Columns:
    """The bytes of contiguous data at the places that the file's own tables name."""
    import h5py

    columns = {}
    with h5py.File(path, "r") as file:
        for name in NAMES:
            data = file[name]
            begin = data.id.get_offset()
            if begin is None:
                columns[name] = np.asarray(data, float).ravel().tolist()
            else:
                columns[name] = (
                    np.frombuffer(content, data.dtype, data.size, begin).astype(float).tolist()
                )
    return columns
