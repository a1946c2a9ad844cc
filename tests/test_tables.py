"""Files to columns: tables as they are found, and every file that is refused."""

from __future__ import annotations

import gc
import re
import zipfile
from pathlib import Path

import numpy as np
import pytest

from orthaug import InputError
from orthaug.data import tables
from orthaug.data.layouts import layout
from orthaug.data.survey import survey
from orthaug.data.tables import check_readable, has_column, read_table, read_titles


def put(folder: Path, name: str, content: str | bytes) -> Path:
    """A file with exactly this content."""
    path = folder / name
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def put_npz(folder: Path, **arrays) -> Path:
    path = folder / "run.npz"
    np.savez(path, **arrays)
    return path


def values(path: Path, *columns: str) -> list[list[float]]:
    """The named columns, each up to its last filled cell."""
    table = read_table(path, columns)
    return [table.columns[name][: table.filled[name]].tolist() for name in columns]


AS_FOUND = {
    "plain": "u,y\n1,2\n3,4\n",
    "no line break at the end": "u,y\n1,2\n3,4",
    "byte-order mark": b"\xef\xbb\xbfu,y\n1,2\n3,4\n",
    "CRLF": "u,y\r\n1,2\r\n3,4\r\n",
    "byte-order mark and CRLF": b"\xef\xbb\xbfu,y\r\n1,2\r\n3,4\r\n",
    "trailing separators": "u,y,\n1,2,\n3,4,\n",
    "several trailing separators": "u,y,,,\n1,2,,,\n3,4,,,\n",
    "trailing separators below the header only": "u,y\n1,2,\n3,4,\n",
    "blank lines at the end": "u,y\n1,2\n3,4\n\n\n",
    "lines of separators at the end": "u,y\n1,2\n3,4\n,\n,\n",
    "blank lines before the header": "\n\nu,y\n1,2\n3,4\n",
    "blank CRLF lines before the header": "\r\n  \r\nu,y\r\n1,2\r\n3,4\r\n",
    "remarks before the header": "# bench 3, 4 May\n% of u, y\n\nu,y\n1,2\n3,4\n",
    "a longer unused column": "u,y,other\n1,2,9\n3,4,9\n,,9\n,,9\n",
    "a shorter unused column": "u,y,other\n1,2,9\n3,4,\n",
    "text in an unused column": "u,note,y\n1,warm,2\n3,,4\n",
    "columns in another order": "y,u\n2,1\n4,3\n",
    "spaces around names and cells": " u , y \n 1 , 2 \n3 ,4\n",
    "quoted cells and names": '"u","y"\n"1","2"\n"3","4"\n',
    "semicolons": "u;y\n1;2\n3;4\n",
    "exponents and signs": "u,y\n+1e0,0.2E1\n3.0,40e-1\n",
}


@pytest.mark.parametrize("content", AS_FOUND.values(), ids=AS_FOUND.keys())
def test_csv_as_it_is_found(tmp_path, content):
    assert values(put(tmp_path, "run.csv", content), "u", "y") == [[1.0, 3.0], [2.0, 4.0]]


@pytest.mark.parametrize(
    ("content", "names"),
    [
        ("# u,y\n1,2\n", ["# u", "y"]),
        ("# a run\n# u,y\n", ["# u", "y"]),
        ("#\nu;y\n1,5;2\n", ["u", "y"]),
    ],
)
def test_names_may_stand_behind_the_sign_of_a_remark(tmp_path, content, names):
    """As NumPy writes them: the last line before the numbers is the header."""
    assert read_titles(put(tmp_path, "run.csv", content)).names == names


def test_numpy_and_pandas_read_the_same_numbers(tmp_path, monkeypatch):
    rng = np.random.default_rng(0)
    numbers = rng.normal(size=(300, 2)) * 10.0 ** rng.integers(-300, 300, (300, 2))
    cells = "\n".join(f"{u!r},{y:.12e}" for u, y in numbers.tolist())
    path = put(tmp_path, "run.csv", f"u,y\n{cells}\n")
    small = read_table(path, ("y", "u"))
    monkeypatch.setattr(tables, "_SMALL", 0)
    large = read_table(path, ("y", "u"))
    assert [small.filled, small.where(2), small.cell("u", 2)] == [
        large.filled,
        large.where(2),
        large.cell("u", 2),
    ]
    for name in ("u", "y"):
        np.testing.assert_array_equal(small.columns[name], large.columns[name])
    np.testing.assert_array_equal(small.columns["u"], numbers[:, 0])


HEADERS = [
    ("Force (N),Pos [mm]\n1,2\n", ["Force (N)", "Pos [mm]"]),
    ("Kraft in kN ,µ\n1,2\n", ["Kraft in kN", "µ"]),
    ('"u, filtered","y ""raw"""\n1,2\n', ["u, filtered", 'y "raw"']),
    ('"u, filtered";y\n1;2\n', ["u, filtered", "y"]),
    ("1,2\n1,2\n", ["1", "2"]),
]


ENCODED = ["utf-8", "utf-8-sig", "utf-16", "cp1252"]


@pytest.mark.parametrize("encoding", ENCODED)
def test_encodings_of_windows(tmp_path, encoding):
    path = put(tmp_path, "run.csv", "Kraft [µN];Wärme [°C]\n1,5;2\n3;4\n".encode(encoding))
    assert values(path, "Kraft [µN]", "Wärme [°C]") == [[1.5, 3.0], [2.0, 4.0]]
    assert layout(path).note == (
        "not UTF-8, so read as Windows-1252" if encoding == "cp1252" else ""
    )


@pytest.mark.parametrize(
    "above", ["Messung 4711\n", "Datum; 4711; kalt\n\nohne Last\n", "a, b, c, d\n", '"bench, 3"\n']
)
def test_a_remark_without_a_sign_is_distinguished_from_the_header_by_its_cells(tmp_path, above):
    path = put(tmp_path, "run.csv", above + "u,y\n1,2\n3,4\n")
    assert values(path, "u", "y") == [[1.0, 3.0], [2.0, 4.0]]
    assert read_table(path, ("u",)).first_line == above.count("\n") + 2
    path = put(tmp_path, "run.csv", above + "u;y\n1,5;2\n3;4,5\n")
    assert values(path, "u", "y") == [[1.5, 3.0], [2.0, 4.5]]


@pytest.mark.parametrize(
    "above",
    [
        "Messung;Stand 4;\n",
        "Messung 7;;\nDatum: 3.4.2025;;\n;;\n",
        "Stand;4;\n",
        "\nMessung\nStand;4;\n",
    ],
)
@pytest.mark.parametrize("units", ["", "[s];[kN];[mm]\n"])
def test_lines_that_excel_padded_above_the_header_are_no_header(tmp_path, above, units):
    header = "Zeit;Druck (Luft);Weg\n"
    path = put(tmp_path, "run.csv", f"{above}{header}{units}0,0;1;2\n0,1;3;4,5\n0,2;;\n")
    assert read_titles(path).names == ["Zeit", "Druck (Luft)", "Weg"]
    assert values(path, "Druck (Luft)", "Weg") == [[1.0, 3.0], [2.0, 4.5]]
    table = read_table(path, ["Weg"])
    assert table.first_line == f"{above}{header}{units}".count("\n") + 1
    assert table.units == ({"Zeit": "s", "Druck (Luft)": "kN", "Weg": "mm"} if units else {})


def test_lines_above_the_header_of_a_worksheet(tmp_path):
    openpyxl = pytest.importorskip("openpyxl")
    book = openpyxl.Workbook()
    for row in ([], ["Messung 7"], ["Stand", 4], [], ["t", "u", "y"], [0, 1, 2], [1, None, 4]):
        book.active.append(row)
    book.save(tmp_path / "run.xlsx")
    assert read_titles(tmp_path / "run.xlsx").names == ["t", "u", "y"]
    table = read_table(tmp_path / "run.xlsx", ["t", "y"])
    assert [table.columns[name].tolist() for name in ("t", "y")] == [[0.0, 1.0], [2.0, 4.0]]
    assert table.where(0) == "line 6 (row 0)"


def test_a_row_of_units_is_not_taken_for_the_header_above_which_a_name_lacks(tmp_path):
    path = put(tmp_path, "run.csv", "t,,y\ns,V,m\n0,1,2\n1,3,4\n")
    assert read_titles(path).names == ["t", "y"]


UNITS_UNDER_NAMES = {
    "all": ("t,u,y\nms,V,cm\n20,1,2\n40,3,4\n", {"t": "ms", "u": "V", "y": "cm"}),
    "brackets": ("t;u;y\n[ms];(V);[%]\n20;1;2\n40;3;4\n", {"t": "ms", "u": "V", "y": "%"}),
    "spaces": ("t u y\n[ms] [V] [cm]\n20 1 2\n40 3 4\n", {"t": "ms", "u": "V", "y": "cm"}),
    "commas": ("t;u;y\nms;V;cm\n20,0;1,0;2\n40,0;3;4\n", {"t": "ms", "u": "V", "y": "cm"}),
    "without some": ("t,u,y,note\nms,-,cm,\n20,1,2,\n40,3,4,warm\n", {"t": "ms", "y": "cm"}),
    "gaps below": ("t,u,y,z\nms,V,cm,\n20,1,2,\n40,3,4,7\n", {"t": "ms", "u": "V", "y": "cm"}),
    "a line above": ("bench 3\n\nt,u,y\nms,V,cm\n20,1,2\n40,3,4\n", dict(t="ms", u="V", y="cm")),
}


@pytest.mark.parametrize(
    ("content", "units"), UNITS_UNDER_NAMES.values(), ids=UNITS_UNDER_NAMES.keys()
)
def test_a_row_of_units_under_the_header_is_no_sample(tmp_path, content, units):
    path = put(tmp_path, "run.csv", content)
    table = read_table(path, ["t", "u", "y"], "t")
    assert {name: column.tolist() for name, column in table.columns.items()} == {
        "t": [0.02, 0.04],
        "u": [1.0, 3.0],
        "y": [2.0, 4.0],
    }
    assert table.units == units
    first = 1 + next(i for i, line in enumerate(content.split("\n")) if line.startswith("20"))
    assert table.where(0) == f"line {first} (row 0)"
    assert read_titles(path).names[:3] == ["t", "u", "y"]


def test_a_row_of_units_in_a_workbook(tmp_path):
    openpyxl = pytest.importorskip("openpyxl")
    book = openpyxl.Workbook()
    for row in (["t", "u [V]", "y"], ["ms", "mV", "cm"], [20, 1, 2], [40, None, 4]):
        book.active.append(row)
    book.save(tmp_path / "run.xlsx")
    table = read_table(tmp_path / "run.xlsx", ["t", "y"], "t")
    assert [table.columns[name].tolist() for name in ("t", "y")] == [[0.02, 0.04], [2.0, 4.0]]
    assert table.where(0) == "line 3 (row 0)"


@pytest.mark.parametrize(
    "content",
    [
        "t,u,y\n0,Bad,Bad\n1,1,2\n2,3,4\n",
        "t,u,y\nnan,nan,nan\n1,1,2\n2,3,4\n",
        "t,u,y\n,,\n1,1,2\n2,3,4\n",
        "t,u,y\nthe time of day,the voltage,cm\n1,1,2\n2,3,4\n",
        "note,u,y\nwarm,,\n1,1,2\n2,3,4\n",
        "t,u,y\nms,V,cm\nms,V,cm\n1,1,2\n",
    ],
)
def test_a_first_row_that_holds_no_units_stays_a_row(tmp_path, content):
    table = read_table(put(tmp_path, "run.csv", content), ["u", "y"])
    assert not table.units
    assert np.isnan(table.columns["u"][0])


def test_columns_of_one_name_are_distinguished(tmp_path):
    path = put(tmp_path, "run.csv", "T [K],u,T [K],T [K]\n1,2,3,4\n")
    assert read_titles(path).names == ["T [K].0", "u", "T [K].1", "T [K].2"]
    assert values(path, "T [K].0", "T [K].2", "u", "T [K].1") == [[1.0], [4.0], [2.0], [3.0]]
    with pytest.raises(InputError, match=r"no column 'T \[K\].3'"):
        read_table(path, ("T [K].3",))
    path = put(tmp_path, "own.csv", "T,T.0,T\n1,2,3\n")  # a name of its own stays
    assert [values(path, name) for name in ("T.0", "T.1", "T.2")] == [[[2.0]], [[1.0]], [[3.0]]]


def test_columns_of_one_name_in_a_workbook(tmp_path):
    pandas = pytest.importorskip("pandas")
    pytest.importorskip("openpyxl")
    pandas.DataFrame([["y", "y"], [1, 2], [3, 4]]).to_excel(
        tmp_path / "a.xlsx", index=False, header=False
    )
    assert values(tmp_path / "a.xlsx", "y.1", "y.0") == [[2.0, 4.0], [1.0, 3.0]]
    with pytest.raises(
        InputError, match=r"2 times; names must differ, or be numbered .* 'y.0', 'y.1'"
    ):
        read_table(tmp_path / "a.xlsx", ("y",))


@pytest.mark.parametrize(("content", "names"), HEADERS)
def test_headers_with_spaces_units_and_quotes(tmp_path, content, names):
    assert values(put(tmp_path, "run.csv", content), *names) == [[1.0], [2.0]]


@pytest.mark.parametrize(
    "content",
    ["u;y\n1,5;-2,25\n3;4e1\n", "u;y\n1.5;-2.25\n3;4e1\n", '"u";"y"\n1,5;"-2,25"\n3;40\n'],
)
def test_semicolons_go_with_decimal_commas_and_points(tmp_path, content):
    assert values(put(tmp_path, "run.csv", content), "u", "y") == [[1.5, 3.0], [-2.25, 40.0]]


def test_tsv(tmp_path):
    assert values(put(tmp_path, "run.tsv", "u (N)\ty\t\n1.5\t2\t\n3\t4\t\n"), "u (N)", "y") == [
        [1.5, 3.0],
        [2.0, 4.0],
    ]


def test_the_ending_may_be_upper_case(tmp_path):
    assert values(put(tmp_path, "RUN.CSV", "u\n1\n"), "u") == [[1.0]]


SEPARATED = {
    "commas": "1.5,2\n-3,4e1\n",
    "commas and spaces": " 1.5, 2\n  -3, 40\n",
    "semicolons and decimal commas": "1,5;2\n-3;40,0\n",
    "tabs": "1.5\t2\n-3\t40\n",
    "tabs and decimal commas": "1,5\t2\n-3,0\t40\n",
    "spaces": "1.5 2\n-3 40\n",
    "columns of spaces": "  1.5000e+00    2.0000e+00\n -3.0000e+00    4.0000e+01  \n",
    "spaces and decimal commas": "1,5 2,0\n-3 40\n",
    "spaces and tabs": "1.5 \t2\n-3  40\n",
    "blank lines at the end": "1.5 2\n-3 40\n\n\n",
    "trailing separators": "1.5,2,\n-3,40,\n",
    "Windows": "1,5;2\r\n-3;40\r\n",
}


@pytest.mark.parametrize("ending", ["csv", "txt", "dat"])
@pytest.mark.parametrize("headed", [True, False], ids=["header", "no header"])
@pytest.mark.parametrize("kind", SEPARATED)
def test_separators_are_known_by_the_content(tmp_path, kind, headed, ending, monkeypatch):
    content, names, expected = SEPARATED[kind], ["x1", "x2"], [[1.5, -3.0], [2.0, 40.0]]
    if headed:
        commas = "decimal commas" in kind
        separator = next(
            mark
            for mark in (";", "\t", " " if commas else ",", " ")
            if mark in content.split("\n")[0]
        )
        names, content = ["Weg [mm]", "F"], f"Weg [mm]{separator}F\n{content}"
    path = put(tmp_path, f"run.{ending}", content)
    assert read_titles(path).names == names
    assert values(path, *names) == expected
    monkeypatch.setattr(tables, "_SMALL", 0)
    assert values(path, *names) == expected


UNNAMED = [
    ("# bench 3, 4 May\n% of u and y\n1,2\n3,4\n", ["x1", "x2"], [[1, 3], [2, 4]]),
    (
        "# t u y\n0 1 2\n1 3 4\n",
        ["t", "u", "y"],
        [[0, 1], [1, 3], [2, 4]],
    ),  # as numpy.savetxt writes it
    ("0\n1\n3\n", ["x1"], [[0, 1, 3]]),
    (
        "0,1\n0.5,7\n1,2\n",
        ["x1", "x2"],
        [[0, 0.5, 1], [1, 7, 2]],
    ),  # time goes on from the first line
    ("0,1\n3.5,7\n2,2\n", ["0", "1"], [[3.5, 2], [7, 2]]),  # columns that pandas counted
    ("nan,1\n0.5,\n1,2\n", ["x1", "x2"], [[np.nan, 0.5, 1], [1, np.nan, 2]]),
    (".5 -.25\n1 2\n", ["x1", "x2"], [[0.5, 1], [-0.25, 2]]),
    ("time [s] force [N]\n0 1\n1 3\n", ["time [s]", "force [N]"], [[0, 1], [1, 3]]),
    ("level 1,5 bar;y\n1;2\n", ["level 1,5 bar", "y"], [[1], [2]]),
    ("2024-03-01 12:00:00;1,5\n2024-03-01 12:00:01;2,5\n", ["x1", "x2"], None),
]


@pytest.mark.parametrize(("content", "names", "expected"), UNNAMED, ids=range(len(UNNAMED)))
def test_columns_without_names_are_numbered(tmp_path, content, names, expected):
    path = put(tmp_path, "run.dat", content)
    assert read_titles(path).names == names
    if expected is None:
        assert read_table(path, ["x1", "x2"], "x1").columns["x1"].tolist() == [0.0, 1.0]
        return
    table = read_table(path, names)
    np.testing.assert_array_equal([table.columns[name] for name in names], expected)


def test_a_column_with_an_empty_cell_in_the_header_is_named_by_its_place(tmp_path):
    path = put(tmp_path, "run.csv", '"r",,"u",,"x6",\n1,2,3,4,5,\n6,7,8,9,10,\n')
    assert values(path, "x2", "u", "x4", "x6") == [[2, 7], [3, 8], [4, 9], [5, 10]]
    for name in ("x1", "x3", "x7"):  # named otherwise, or not there
        with pytest.raises(InputError, match=f"no column '{name}'"):
            read_table(path, [name])


def test_a_row_of_a_file_without_header_is_named_by_its_line(tmp_path):
    path = put(tmp_path, "run.txt", "# only a remark\n1 2\n3 x\n")
    table = read_table(path, ["x1", "x2"])
    assert (table.where(1), table.cell("x2", 1), table.first_line) == ("line 3 (row 1)", "x", 2)
    assert layout(path).note == "no header, so the columns are called x1 to x2"
    with pytest.raises(
        InputError,
        match="line 3 has 3 cells, line 1 has 2. Correct the line: is a separator or a decimal",
    ):
        read_table(put(tmp_path, "run.dat", "1 2\n3 4\n5 6 7\n"), ["x1"])


def test_numbers_are_read_to_the_last_digit(tmp_path):
    rng = np.random.default_rng(0)
    numbers = (rng.normal(size=500) * 10.0 ** rng.integers(-12, 12, 500)).tolist()
    path = put(tmp_path, "run.csv", "y\n" + "".join(f"{number!r}\n" for number in numbers))
    assert values(path, "y") == [numbers]


def test_a_table_says_where_a_row_stands_and_what_a_cell_holds(tmp_path):
    table = read_table(put(tmp_path, "run.csv", "\nu,y\n1,2\n3, n/a \n,6\n"), ("u", "y"))
    assert table.where(1) == "line 4 (row 1)"
    assert table.cell("y", 1) == "n/a"
    assert table.cell("u", 2) == ""
    assert table.filled == {"u": 2, "y": 3}
    assert read_table(put_npz(tmp_path, y=np.ones(2)), ("y",)).where(1) == "row 1"


def test_parquet(tmp_path):
    pandas = pytest.importorskip("pandas")
    pytest.importorskip("pyarrow")
    path = tmp_path / "run.parquet"
    pandas.DataFrame({"u": [1, 3], "pos (mm)": [2.5, 4.5], "note": ["a", "b"]}).to_parquet(path)
    assert values(path, "u", "pos (mm)") == [[1.0, 3.0], [2.5, 4.5]]


def test_npz_vectors_and_columns_of_a_matrix(tmp_path):
    u = np.arange(6.0).reshape(2, 3)
    path = put_npz(
        tmp_path, a=np.arange(2), b=np.array([[1.5, 2.5]]), c=np.array([[3.0], [4.0]]), U=u
    )
    assert values(path, "a", "b", "c", "U[2]", "U[0]") == [
        [0, 1],
        [1.5, 2.5],
        [3, 4],
        [2, 5],
        [0, 3],
    ]


def test_a_variable_may_have_brackets_in_its_name(tmp_path):
    assert values(put_npz(tmp_path, **{"U[2]": np.ones(3)}), "U[2]") == [[1, 1, 1]]


def test_unused_variables_of_an_npz_do_not_matter(tmp_path):
    """Also one that would have to be unpickled: it is not."""
    path = put_npz(
        tmp_path, y=np.ones(2), note=np.array({"made": "by hand"}, dtype=object), z=np.array([1j])
    )
    assert values(path, "y") == [[1.0, 1.0]]


def test_has_column(tmp_path):
    path = put(tmp_path, "run.csv", "u,y\n1,2\n")
    assert has_column(path, "y")
    assert not has_column(path, "position")
    assert not has_column(put_npz(tmp_path, U=np.ones((3, 2))), "y")


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("run.csv", "", "0 bytes"),
        ("run.csv", "y,y\n1,2\n", "the header has the column 'y' 2 times; names must differ"),
        ("run.npz", "y", "cannot be read as .npz"),
        ("run.log", "y\n1\n", "unknown file type '.log'"),
    ],
)
def test_has_column_of_a_file_that_cannot_be_read(tmp_path, name, content, message):
    """A file that cannot be read is no file without the column."""
    with pytest.raises(InputError, match=f"{name}: .*{message}"):
        has_column(put(tmp_path, name, content), "y")
    with pytest.raises(InputError, match="absent.csv: no such file"):
        has_column(tmp_path / "absent.csv", "y")


REFUSED_TEXT = [
    ("run.csv", b"", r"the file is empty \(0 bytes\)"),
    ("run.csv", "\n\n", "holds only blank lines"),
    ("run.csv", "\r\n  \r\n", "holds only blank lines"),
    ("run.csv", bytes(range(256)) * 4, "not a text table; expected UTF-8 text with a header row"),
    ("run.csv", b"u,y\n\x00\x01\xff\xfe\n", "not a text table; expected UTF-8"),
    (
        "run.csv",
        "u,y\n1,2\n".encode("utf-16-le"),
        "not a text table; expected UTF-8",
    ),  # no mark says so
    ("run.csv", b"u,y,\xfc\x01\n1,2,3\n", "not a text table; expected UTF-8"),
    ("run.csv", b"\xef\xbb\xbfu,y,\xfc\n1,2,3\n", "not a text table; expected UTF-8"),
    (
        "run.csv",
        "1.5,2\n1,2\n",
        "no column 'u': the file has no header, so its columns are called x1, x2",
    ),
    ("run.csv", "u,y\n1,2\n3,4,5\n", "line 3.*3 cells.*2"),
    ("run.csv", 'u,y\n1,2\n3,"4\n5,6\n', "not a readable table.*row 2"),
    ("run.csv", "force,position\n1,2\n", "no column 'u'; the file has 'force', 'position'"),
    ("run.csv", "U,y\n1,2\n", "no column 'u', did you mean 'U'. The file has 'U', 'y'"),
    (
        "run.csv",
        "u (N),y\n1,2\n",
        r"no column 'u', did you mean 'u \(N\)'\? .* Write into `\[data.channels\]` of the spec: "
        r'u = \{ column = "u \(N\)", unit = "N" \}\.',
    ),
    ("run.csv", ",,\n1,2,3\n", "no column 'u'; the file has no column names"),
    ("run.csv", "u,y,y\n1,2,3\n", "column 'y' 2 times; names must differ"),
    ("run.txt", "1 2\n3 4\n5 6 7\n", "no column 'u': the file has no header"),
    ("run.tsv", "u,y\n1,2\n", "no column 'u'.*The file has 'u,y'"),
    ("run.xml", "<a/>", r"unknown file type '.xml'; known are .csv, .tsv, .txt, .dat, .parquet"),
    ("run", "u,y\n1,2\n", "unknown file type ''; known are .csv"),
    ("run.npz", b"not a zip", "cannot be read as .npz .*cut or corrupt"),
    ("run.npz", b"PK\x03\x04 cut", "cannot be read as .npz .*cut or corrupt"),
    ("run.parquet", b"PAR1 is how it starts", "not a readable Parquet file"),
    ("run.parquet", b"\x00" * 100, "not a readable Parquet file"),
]


@pytest.mark.parametrize(("name", "content", "message"), REFUSED_TEXT, ids=range(len(REFUSED_TEXT)))
def test_refused_files(tmp_path, name, content, message):
    path = put(tmp_path, name, content)
    with pytest.raises(InputError, match=message) as refusal:
        read_table(path, ("u", "y"))
    assert str(refusal.value).startswith(f"{path}: ")
    assert "\n" not in str(refusal.value)
    del refusal
    gc.collect(1)  # a file that was left open is reported in this test, not in a later one


@pytest.mark.parametrize("content", ["u,y\n", "u,y", "u,y\n\n\n", "u,y\r\n,\r\n", "\nu,y\n"])
def test_a_header_without_data_rows_holds_nothing(tmp_path, content):
    """`read_record` says so in words; here no column may have a row, or the refusal says it already."""
    try:
        table = read_table(put(tmp_path, "run.csv", content), ("u", "y"))
    except InputError as refusal:
        assert "no data rows" in str(refusal)
    else:
        assert table.filled == {"u": 0, "y": 0}


def test_a_file_that_is_not_there(tmp_path):
    with pytest.raises(InputError, match="absent.csv: no such file"):
        read_table(tmp_path / "absent.csv", ("y",))


def test_a_folder_is_no_file(tmp_path):
    (tmp_path / "run.csv").mkdir()
    with pytest.raises(InputError, match="run.csv: not a file"):
        check_readable(tmp_path / "run.csv")
    with pytest.raises(InputError, match="run.csv: not a file"):
        read_table(tmp_path / "run.csv", ("y",))


REFUSED_NPZ = [
    ("v", {"vel": np.ones(3)}, r"no variable 'v', did you mean 'vel'\? The file holds vel \(3\)"),
    (
        "y",
        {"a": np.ones((2, 3)), "b": 1.0},
        r"no variable 'y'; the file holds a \(2×3\), b \(a scalar\)",
    ),
    ("y", {}, "no variable 'y'; the file holds nothing"),
    (
        "y",
        {"y": np.ones((2, 3))},
        r"'y' is no vector; write a column of a matrix as \"y\[0\]\".*y \(2×3\)",
    ),
    ("y", {"y": 1.0}, "'y' is no vector"),
    ("y", {"y": np.ones((2, 2, 2))}, "'y' is no vector"),
    (
        "y[3]",
        {"y": np.ones((2, 3))},
        r"'y\[3\]': no such column \(counted from 0\); the file holds y \(2×3\)",
    ),
    ("y[0]", {"y": np.ones(3)}, r"'y\[0\]': no such column"),
    (
        "y[-1]",
        {"y": np.ones((2, 3))},
        r"'y\[-1\]': a column of a matrix is written \"y\[0\]\", a row .*counted from",
    ),
    ("x[0]", {"y": np.ones(3)}, "no variable 'x'"),
    ("y", {"y": np.array([1j, 2])}, "'y' is complex; expected real numbers"),
    ("y", {"y": np.array(["a", "b"])}, "'y' is text, no numbers; the file holds y"),
    (
        "y",
        {"y": np.array(["2020-01-01"], dtype="datetime64[s]")},
        r"'y' is datetime64\[s\] values, no numbers",
    ),
]


@pytest.mark.parametrize(("name", "arrays", "message"), REFUSED_NPZ, ids=range(len(REFUSED_NPZ)))
def test_refused_variables(tmp_path, name, arrays, message):
    with pytest.raises(InputError, match=message) as refusal:
        read_table(put_npz(tmp_path, **arrays), (name,))
    assert str(tmp_path) in str(refusal.value)


class Trap:
    """Leaves a file behind when it is unpickled."""

    def __init__(self, sign: Path):
        self.sign = sign

    def __reduce__(self):
        return (Path.touch, (self.sign,))


def test_pickled_arrays_are_refused_and_never_unpickled(tmp_path):
    sign = tmp_path / "unpickled"
    path = put_npz(tmp_path, y=np.array([Trap(sign), Trap(sign)], dtype=object))
    with pytest.raises(InputError, match="run.npz: 'y' is Python objects, no numbers"):
        read_table(path, ("y",))
    assert not sign.exists()


def test_a_plain_array_file_is_no_archive(tmp_path):
    np.save(tmp_path / "run.npy", np.ones(3))
    with pytest.raises(InputError, match="run.npz: cannot be read as .npz"):
        read_table((tmp_path / "run.npy").rename(tmp_path / "run.npz"), ("y",))


def test_a_zip_of_something_else_is_no_archive_of_arrays(tmp_path):
    with zipfile.ZipFile(tmp_path / "run.npz", "w") as archive:
        archive.writestr("y", "hello")
    with pytest.raises(InputError, match=f"{re.escape(str(tmp_path))}/run.npz: "):
        read_table(tmp_path / "run.npz", ("y",))


@pytest.mark.parametrize(
    ("column", "message"),
    [
        (["a", "b"], "column 'y' holds .* values; expected numbers"),
        ([[1.0], [2.0, 3.0]], "column 'y' holds object values; expected numbers"),
        (
            np.array(["2020-01-01", "2020-01-02"], dtype="datetime64[ns]"),
            "column 'y' holds datetime64.*; expected numbers",
        ),
    ],
)
def test_refused_parquet_columns(tmp_path, column, message):
    pandas = pytest.importorskip("pandas")
    pytest.importorskip("pyarrow")
    path = tmp_path / "run.parquet"
    pandas.DataFrame({"y": column}).to_parquet(path)
    with pytest.raises(InputError, match=message):
        read_table(path, ("y",))
    with pytest.raises(InputError, match="no column 'x'; the file has 'y'"):
        read_table(path, ("x",))


def test_a_cut_parquet_file(tmp_path):
    pandas = pytest.importorskip("pandas")
    pytest.importorskip("pyarrow")
    path = tmp_path / "run.parquet"
    pandas.DataFrame({"y": np.arange(100.0)}).to_parquet(path)
    path.write_bytes(path.read_bytes()[:-20])
    with pytest.raises(InputError, match="run.parquet: not a readable Parquet file"):
        read_table(path, ("y",))


def test_a_line_with_too_many_cells_is_counted(tmp_path):
    rows = [f"{k},{k % 3},{k % 5}\n" for k in range(30)]
    rows[10] = "10,1,0,7,8\n"
    path = put(tmp_path, "run.csv", "t,u,y\n" + "".join(rows))
    wanted = "line 12 has 5 cells, the header has 3. Correct the line: is a separator or a decimal"
    for look in (lambda: read_table(path, ["u"]), lambda: survey(path)):
        with pytest.raises(InputError, match=wanted):
            look()
    rows[10] = rows[20] = "20,1,0,7\n"
    path = put(tmp_path, "run.csv", "t,u,y\n" + "".join(rows))
    with pytest.raises(InputError, match="the header has 3; 2 lines have too many"):
        survey(path)


@pytest.mark.parametrize("step", ["0,10", "0,00"])
def test_decimal_commas_between_commas_are_a_question(tmp_path, step):
    rows = "".join(f"{k},{k % 10}0,1,5{k},{step}\n" for k in range(30))
    path = put(tmp_path, "run.csv", "Zeit,Druck,Weg\n" + rows)
    wanted = (
        "line 2 has 6 cells under 3 names, and so have most lines. Perhaps the decimals have "
        "commas, too: export the table with ; as separator"
    )
    with pytest.raises(InputError, match=wanted):
        survey(path)
