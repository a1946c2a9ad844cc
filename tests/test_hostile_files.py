"""Files made to break a reader: each is refused in one line, and none costs memory or time."""

from __future__ import annotations

import io
import struct
import time
import warnings
import zipfile
import zlib
from pathlib import Path

import numpy as np
import pytest

from orthaug import InputError, read_record
from orthaug._base import memory
from orthaug.data.survey import survey
from orthaug.data.tables import read_table

NS = 'xmlns="http://schemas.openxmlformats.org/spreadsheetml/2006/main"'


def refusal(path: Path, *columns: str) -> str:
    """The message of a refused file."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # as under PYTHONWARNINGS=error
        with pytest.raises(InputError) as refused:
            read_table(path, columns or ("u", "y"))
    text = str(refused.value)
    assert text.startswith(f"{path}: ") and text.isprintable(), text
    return text


def npy(shape: str, kind: str = "<f8", body: bytes = b"") -> bytes:
    """An array file that declares what it does not hold."""
    header = (
        f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}".encode().ljust(117)
        + b"\n"
    )
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + body


def put_npz(folder: Path, members: dict[str, bytes], **options) -> Path:
    path = folder / "run.npz"
    with zipfile.ZipFile(path, "w", **options) as archive:
        for name, content in members.items():
            archive.writestr(f"{name}.npy", content)
    return path


@pytest.mark.parametrize(
    "shape", ["(1000000000000,)", f"({10**30},)", "(1000000, 1000000)", "(-1,)"]
)
def test_npz_that_declares_more_than_it_holds(tmp_path, shape):
    assert "'u' is " in refusal(put_npz(tmp_path, {"u": npy(shape)}), "u")


def test_an_array_larger_than_the_memory(tmp_path, monkeypatch):
    path = tmp_path / "run.npz"
    np.savez_compressed(path, u=np.zeros(100_000))
    monkeypatch.setattr(memory, "available", lambda: 1e5)
    assert (
        "an array of 100000 numbers would take 1.53 MiB of memory; 97.7 KiB are available"
        in refusal(path, "u")
    )


def marked(path: Path, local: int, central: int, value: int) -> Path:
    """The archive with one 16-bit field of its headers replaced."""
    content = bytearray(path.read_bytes())
    for magic, offset in ((b"PK\x03\x04", local), (b"PK\x01\x02", central)):
        at = content.find(magic)
        content[at + offset : at + offset + 2] = struct.pack("<H", value)
    path.write_bytes(content)
    return path


def test_an_encrypted_npz_and_one_of_unknown_compression(tmp_path):
    array = npy("(2,)", body=np.ones(2).tobytes())
    assert "encrypted" in refusal(marked(put_npz(tmp_path, {"u": array}), 6, 8, 1), "u")
    assert "compression" in refusal(marked(put_npz(tmp_path, {"u": array}), 8, 10, 99), "u")


def test_long_doubles_beyond_double_precision_are_not_finite_and_warn_of_nothing(tmp_path):
    np.savez(tmp_path / "run.npz", u=np.array([1.0, np.finfo(np.longdouble).max], np.longdouble))
    with (
        warnings.catch_warnings(),
        pytest.raises(InputError, match="row 1, column 'u': found 'inf'"),
    ):
        warnings.simplefilter("error")
        read_record(tmp_path / "run.npz", inputs=["u"], sampling_time=1.0)


def test_parquet_with_the_channel_as_index(tmp_path):
    pandas = pytest.importorskip("pandas")
    path = tmp_path / "run.parquet"
    pandas.DataFrame({"u": [3.0, 1.0], "y": [2.0, 5.0]}).set_index("u").to_parquet(path)
    table = read_table(path, ("u", "y"))
    assert (table.columns["u"].tolist(), table.columns["y"].tolist()) == ([3, 1], [2, 5])


RELATIONS = "http://schemas.openxmlformats.org/officeDocument/2006/relationships"
PACKAGE = "http://schemas.openxmlformats.org/package/2006"
KIND = "application/vnd.openxmlformats-officedocument.spreadsheetml"
ROWS = (
    '<row r="1"><c r="A1" t="s"><v>0</v></c><c r="B1" t="s"><v>1</v></c></row>'
    '<row r="2"><c r="A2"><v>1</v></c><c r="B2"><v>2</v></c></row>'
    '<row r="3"><c r="A3"><v>3</v></c><c r="B3"><v>4</v></c></row>'
)
PARTS = {
    "types": (
        "[Content_Types].xml",
        f'<Types xmlns="{PACKAGE}/content-types"><Default Extension="xml" ContentType="application/xml"/>'
        '<Default Extension="rels" ContentType="application/vnd.openxmlformats-package.relationships+xml"/>'
        f'<Override PartName="/xl/workbook.xml" ContentType="{KIND}.sheet.main+xml"/>'
        f'<Override PartName="/xl/worksheets/sheet1.xml" ContentType="{KIND}.worksheet+xml"/>'
        f'<Override PartName="/xl/sharedStrings.xml" ContentType="{KIND}.sharedStrings+xml"/></Types>',
    ),
    "root": (
        "_rels/.rels",
        f'<Relationships xmlns="{PACKAGE}/relationships"><Relationship Id="r1" '
        f'Type="{RELATIONS}/officeDocument" Target="xl/workbook.xml"/></Relationships>',
    ),
    "workbook": (
        "xl/workbook.xml",
        f'<workbook {NS} xmlns:r="{RELATIONS}"><sheets><sheet name="S" sheetId="1" r:id="r1"/></sheets></workbook>',
    ),
    "relations": (
        "xl/_rels/workbook.xml.rels",
        f'<Relationships xmlns="{PACKAGE}/relationships"><Relationship Id="r1" '
        f'Type="{RELATIONS}/worksheet" Target="worksheets/sheet1.xml"/><Relationship Id="r2" '
        f'Type="{RELATIONS}/sharedStrings" Target="sharedStrings.xml"/></Relationships>',
    ),
    "strings": ("xl/sharedStrings.xml", f"<sst {NS}><si><t>u</t></si><si><t>y</t></si></sst>"),
    "sheet": (
        "xl/worksheets/sheet1.xml",
        f"<worksheet {NS}><sheetData>{ROWS}</sheetData></worksheet>",
    ),
    "styles": ("xl/styles.xml", None),
}


def workbook(path: Path, **changed: str | None) -> Path:
    """A workbook of u = 1, 3 and y = 2, 4, laid out as by Excel, with parts replaced or (None) left out."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for key, (name, whole) in PARTS.items():
            text = changed.get(key, whole)
            if text is not None:
                archive.writestr(name, text.replace("WHOLE", whole or ""))
    return path


def sheet(rows: str) -> str:
    return f"<worksheet {NS}><sheetData>{rows}</sheetData></worksheet>"


HEADER = '<row r="1"><c r="A1" t="s"><v>0</v></c><c r="B1" t="s"><v>1</v></c></row>'
FAR = '<row r="2"><c r="A2"><v>1</v></c><c r="B2"><v>2</v></c></row><row r="1048576"><c r="XFD1048576"><v>9</v></c></row>'
BOMB = (
    "<!DOCTYPE a [<!ENTITY a '"
    + "x" * 100
    + "'>"
    + "".join(f"<!ENTITY {b} '{f'&{a};' * 50}'>" for a, b in zip("abcdefg", "bcdefgh", strict=True))
    + "]>"
)
WORKBOOKS = [
    ({"sheet": "WHOLE<"}, "cannot be read as .xlsx"),
    ({"sheet": "<worksheet"}, "cannot be read as .xlsx"),
    ({"sheet": None}, "cannot be read as .xlsx|no worksheet"),
    ({"workbook": "<workbook"}, "cannot be read as .xlsx"),
    ({"types": "<Types"}, "cannot be read as .xlsx"),
    ({"types": None}, "cannot be read as .xlsx"),
    ({"styles": "<styleSheet"}, "cannot be read as .xlsx"),
    ({"strings": f"<sst {NS}><si><t>u</t></si></sst>"}, "cannot be read as .xlsx"),
    ({"sheet": sheet(HEADER.replace("<v>1<", "<v>-1<"))}, "cannot be read as .xlsx"),
    ({"strings": BOMB + f"<sst {NS}><si><t>&h;</t></si></sst>"}, "declares a document type"),
    ({"sheet": BOMB + sheet(HEADER)}, "declares a document type"),
    ({"workbook": BOMB + "WHOLE"}, "declares a document type"),
]


@pytest.mark.parametrize(("parts", "message"), WORKBOOKS, ids=range(len(WORKBOOKS)))
def test_broken_workbooks(tmp_path, parts, message):
    pytest.importorskip("openpyxl")
    assert read_table(workbook(tmp_path / "whole.xlsx"), ("u", "y")).columns["y"].tolist() == [2, 4]
    found = refusal(workbook(tmp_path / "run.xlsx", **parts))
    assert any(part in found for part in message.split("|")), found


def test_a_cell_at_the_far_corner_costs_nothing(tmp_path):
    pytest.importorskip("openpyxl")
    table = read_table(workbook(tmp_path / "run.xlsx", sheet=sheet(HEADER + FAR)), ("u", "y"))
    assert (table.columns["u"][:1].tolist(), table.filled) == ([1.0], {"u": 1, "y": 1})


def test_a_number_beyond_double_precision_in_a_workbook(tmp_path):
    pytest.importorskip("openpyxl")
    for number in ("1e400", "9" * 400):
        row = f'<row r="2"><c r="A2"><v>{number}</v></c><c r="B2"><v>2</v></c></row>'
        with pytest.raises(InputError, match="column 'u': found '"):
            read_record(workbook(tmp_path / "run.xlsx", sheet=sheet(HEADER + row)), inputs=["u"])


def test_a_chart_sheet_before_the_worksheet(tmp_path):
    openpyxl = pytest.importorskip("openpyxl")
    from openpyxl.chart import LineChart

    book = openpyxl.Workbook()
    for row in (["u", "y"], [1, 2], [3, 4]):
        book.active.append(row)
    book.create_chartsheet("Chart", 0).add_chart(LineChart())
    book.save(tmp_path / "run.xlsx")
    assert read_table(tmp_path / "run.xlsx", ("u", "y")).columns["y"].tolist() == [2, 4]


def test_an_encrypted_workbook(tmp_path):
    (tmp_path / "run.xlsx").write_bytes(b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1" + bytes(600))
    assert "an encrypted workbook" in refusal(tmp_path / "run.xlsx")


def test_mat_with_garbage_for_zlib(tmp_path):
    scipy_io = pytest.importorskip("scipy.io")
    path = tmp_path / "run.mat"
    scipy_io.savemat(path, {"u": np.arange(300.0) ** 0.5}, do_compression=True)
    content = bytearray(path.read_bytes())
    for begin in (140, 160, 400):
        spoilt = content.copy()
        spoilt[begin : begin + 40] = zlib.compress(b"garbage")[:40].ljust(40, b"\xff")
        path.write_bytes(spoilt)
        assert "cannot be read as .mat" in refusal(path, "u")


@pytest.mark.parametrize("ending", ["h5", "mat"])
def test_hdf5_that_declares_more_than_there_is_memory(tmp_path, ending):
    h5py = pytest.importorskip("h5py")
    path = tmp_path / f"run.{ending}"
    with h5py.File(path, "w", userblock_size=512) as file:
        file.create_dataset("u", (10**12,), chunks=(1000,), dtype="f8")
    if ending == "mat":
        head = b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM"
        path.write_bytes(head + path.read_bytes()[128:])
    assert "an array of 1000000000000 numbers would take 14.6 TiB of memory" in refusal(path, "u")


@pytest.mark.parametrize(
    "content", ["u,y\n1,2\n3\0,4\n", "u,y\n1,2\n3,4\n\0", "u,y,n\n1,2,a\0b\n", "u,\0y\n1,2\n"]
)
def test_nul_bytes_in_a_csv(tmp_path, content):
    (tmp_path / "run.csv").write_text(content)
    assert "not a text table" in refusal(tmp_path / "run.csv", "u")


@pytest.mark.parametrize(
    "content", ["u;y\n12,5;1.234\n", "u;y\n1.234;1\n2;12,5\n", "u;y;n\n1.234;2;0\n3;4.5;0,5\n"]
)
def test_a_point_beside_decimal_commas_may_be_one_of_thousands(tmp_path, content):
    (tmp_path / "run.csv").write_text(content)
    with pytest.raises(
        InputError, match=r"found '(1\.234|4\.5)'; expected decimals with commas, as in other cells"
    ):
        read_record(tmp_path / "run.csv", inputs=["u"], outputs=["y"])


def test_numbers_of_a_text_are_those_that_python_reads(tmp_path):
    """To the last bit, with points and with commas."""
    rng = np.random.default_rng(1)
    numbers = [
        f"{x:.{d}e}" for x, d in zip(rng.normal(size=4000), rng.integers(1, 22, 4000), strict=True)
    ]
    for name, texts in (("a.csv", numbers), ("b.csv", [n.replace(".", ",") for n in numbers])):
        (tmp_path / name).write_text("y;z\n" + "".join(f"{text};1\n" for text in texts))
        assert read_table(tmp_path / name, ("y",)).columns["y"].tolist() == [
            float(n) for n in numbers
        ]


TIMES = [
    (
        np.delete(np.arange(60) * 0.1, np.arange(2, 60, 3)),
        "a step of 0.2 s where 0.1 s is usual|0.1 s where 0.2 s",
    ),
    (
        np.cumsum(np.linspace(0.1, 0.14, 200)),
        "the step drifts between 0.107 s and 0.133 s|drifts between",
    ),
    (np.r_[np.arange(30) * 0.1, 3.0 + np.arange(30) * 0.13], "drifts between"),
    (1.7e18 + 1e7 * np.arange(20), "subtract the first instant"),
]


@pytest.mark.parametrize(
    ("instants", "message"), TIMES, ids=["a third missing", "drift", "two rates", "nanoseconds"]
)
def test_time_columns_that_are_not_even(tmp_path, instants, message):
    np.savez(tmp_path / "run.npz", t=instants, y=np.arange(len(instants)) % 5.0)
    with pytest.raises(InputError) as refused:
        read_record(tmp_path / "run.npz", outputs=["y"], time="t")
    assert any(part in str(refused.value) for part in message.split("|")), refused.value


def test_time_columns_that_are_even_enough(tmp_path):
    rng = np.random.default_rng(3)
    for count in (2, 5, 20, 1000):
        jitter = rng.uniform(-0.15, 0.15, count)
        for start in (0.0, 1.7e9):
            np.savez(
                tmp_path / "run.npz", t=start + 0.01 * (np.arange(count) + jitter), y=np.ones(count)
            )
            if start == 0.0 or count == 1000:
                step = read_record(tmp_path / "run.npz", outputs=["y"], time="t").sampling_time
                assert step == pytest.approx(0.01, rel=0.35 / max(count - 1, 1))


def test_one_column_is_not_time_and_output(tmp_path):
    (tmp_path / "run.csv").write_text("t,u\n0,1\n1,2\n2,0\n")
    with pytest.raises(
        InputError, match="the column 't' is both `time` and the output 'y'; correct one of them"
    ):
        read_record(tmp_path / "run.csv", inputs=["u"], outputs=["y"], columns={"y": "t"}, time="t")


def structured(folder: Path, format_: str) -> Path:
    path = folder / "run.mat"
    u, y = np.arange(5.0), np.arange(10.0).reshape(2, 5)
    if format_ == "5":
        import scipy.io

        scipy.io.savemat(path, {"data": {"u": u, "deep": {"Y": y}, "note": "warm"}, "Y": y})
        return path
    h5py = pytest.importorskip("h5py")
    with h5py.File(path, "w", userblock_size=512) as file:
        file["data/u"], file["data/deep/Y"], file["Y"] = u[:, None], y.T, y.T
    path.write_bytes(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM" + path.read_bytes()[128:])
    return path


@pytest.mark.parametrize("format_", ["5", "7.3"])
def test_fields_of_structs_and_rows_of_matrices(tmp_path, format_):
    path = structured(tmp_path, format_)
    columns = read_table(path, ("data.u", "data.deep.Y[1,:]", "Y[0,:]", "Y[:,0]")).columns
    assert [c.tolist() for c in columns.values()] == [
        [0, 1, 2, 3, 4],
        [5, 6, 7, 8, 9],
        [0, 1, 2, 3, 4],
        [0, 5],
    ]
    assert 'Name a field of it, such as "data.u"' in refusal(path, "data")
    assert "no variable 'data.v'" in refusal(path, "data.v")
    assert 'a row as "Y[0,:]"' in refusal(path, "Y")
    assert "no such row" in refusal(path, "Y[2,:]")
    assert "counted from 0" in refusal(path, "Y[0,0]")


def test_a_workbook_in_memory_is_not_left_open(tmp_path):
    """A refused file can be replaced at once, also where open files are locked."""
    path = workbook(tmp_path / "run.xlsx", sheet="<worksheet")
    refusal(path)
    path.write_bytes(io.BytesIO(b"gone").getvalue())


def test_an_npz_that_is_made_to_fill_the_memory(tmp_path, monkeypatch):
    """By its header, before anything is unpacked; the channel that is asked for counts, no other."""
    from orthaug.data import variables

    monkeypatch.setattr(variables, "_LARGE", 1e5)
    path = tmp_path / "run.npz"
    np.savez_compressed(path, u=np.zeros(100_000), y=np.random.default_rng(0).normal(size=20_000))
    assert "'u' is 781 KiB in" in refusal(path, "u") and "Store it uncompressed" in refusal(
        path, "u"
    )
    assert len(read_table(path, ("y",)).columns["y"]) == 20_000


def put_zeros(path: Path, names: tuple[str, ...], head: bytes, size: int) -> None:
    """An npz whose members go on with gigabytes of zeros, which are packed once a MiB and never held."""
    block = zlib.compressobj(9, zlib.DEFLATED, -15)
    packed = block.compress(bytes(2**20)) + block.flush(zlib.Z_FULL_FLUSH)
    begin = zlib.compressobj(9, zlib.DEFLATED, -15)
    first = begin.compress(head + bytes(size % 2**20)) + begin.flush(zlib.Z_FULL_FLUSH)
    body = first + size // 2**20 * packed + b"\x03\x00"  # an empty last block
    whole, central = io.BytesIO(), b""
    for name in names:
        found = struct.pack(
            "<HHHHHIIIHH", 20, 0, 8, 0, 33, 0, len(body), len(head) + size, len(name) + 4, 0
        )
        member = f"{name}.npy".encode()
        central += (
            b"PK\x01\x02\x14\x00" + found + bytes(10) + struct.pack("<I", whole.tell()) + member
        )
        whole.write(b"PK\x03\x04" + found + member + body)
    end = struct.pack("<HHHHIIH", 0, 0, len(names), len(names), len(central), whole.tell(), 0)
    path.write_bytes(whole.getvalue() + central + b"PK\x05\x06" + end)


def test_an_npz_of_some_megabytes_that_holds_two_arrays_of_3_gigabytes(tmp_path, monkeypatch):
    path = tmp_path / "run.npz"
    put_zeros(path, ("u", "y"), npy("(400000000,)"), 3_200_000_000)
    with (
        zipfile.ZipFile(path) as archive,
        archive.open("y.npy") as member,
    ):  # a sound archive of true zeros
        assert member.read(128) == npy("(400000000,)") and not any(member.read(2**22))
    assert 5e6 < path.stat().st_size < 8e6
    began = time.process_time()
    monkeypatch.setattr("orthaug._base.memory._free_bytes", lambda: 64.0 * 2**30)
    assert "'u' is 2.98 GiB in" in refusal(path, "u", "y")
    with pytest.raises(InputError, match="'u' is 2.98 GiB in"):
        survey(path)
    monkeypatch.setattr("orthaug._base.memory._free_bytes", lambda: 4.0 * 2**30)
    assert "4 GiB are available" in refusal(path, "u", "y")
    assert time.process_time() - began < 2


def test_an_npz_whose_header_is_of_gigabytes(tmp_path):
    path = tmp_path / "run.npz"
    put_zeros(path, ("u",), b"\x93NUMPY\x02\x00" + struct.pack("<I", 3_200_000_000), 3_200_000_000)
    began = time.process_time()
    assert "'u' is unreadable" in refusal(path, "u")
    assert time.process_time() - began < 2
