"""docs/notation.md: every label and symbol of the paper has a row, and what a row names stands where it says.

The paper's labels and symbols are stored in tests/references/paper.json, symbols with the LaTeX that they stand for.
"""

from __future__ import annotations

import ast
import re

import pytest
from test_docs import ROOT, backticked, members, statements
from test_theory import FUNCTIONS, PAPER
from test_theory import SOURCE as LATEX

TEXT = (ROOT / "docs" / "notation.md").read_text(encoding="utf-8")
CODE = ROOT / "src" / "orthaug"
LABEL = r"(?:eqs?|assum|cond|exmp|lem|property|thm):[\w-]+"
GREEK = (
    r"\\(?:alpha|beta|gamma|delta|epsilon|varepsilon|zeta|eta|theta|kappa|lambda|mu|nu|xi|pi|rho|sigma|tau|phi|chi|psi"
    r"|varphi|omega|Gamma|Delta|Theta|Lambda|Xi|Pi|Sigma|Phi|Psi|Omega)(?![A-Za-z])"
)
Row = dict[str, str]


def rows() -> list[Row]:
    """Every row of every table, its cells by the table's header."""
    found, header = [], None
    for line in TEXT.splitlines():
        if not line.startswith("|"):
            header = None
            continue
        cells = [cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]]
        if header is None:
            header = cells
        elif set(cells[0]) != {"-"}:
            assert len(cells) == len(header), line
            found.append(dict(zip(header, cells, strict=True)))
    return found


ROWS = rows()
NAMES = [f"{row.get('label') or row['symbol']} {row['in the code']}"[:60] for row in ROWS]


def labels_of(row: Row) -> set[str]:
    return set(backticked(row.get("label", "")))


def symbols_of(row: Row) -> set[str]:
    cell = row.get("symbol", "–").replace("\\", "")  # of stars, which would be emphasis
    return {cell, *cell.split(", ")} - {"–"}


def defined(nodes: list[ast.stmt]) -> set[str]:
    """Every class, function, argument and variable that is defined somewhere in the nodes."""
    names = set()
    for node in (inner for outer in nodes for inner in ast.walk(outer)):
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            names.add(node.name)
        elif isinstance(node, ast.arg):
            names.add(node.arg)
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            names.add(node.id)
    return names


def missing(row: Row) -> list[str]:
    """What the row names that its files do not define; files of the row that are not there."""
    files = [CODE / name for name in backticked(row["file"])]
    absent = [str(file.relative_to(CODE)) for file in files if not file.is_file()]
    if absent:
        return absent
    nodes = statements(files)
    known, found = defined(nodes), []
    for name in backticked(row["in the code"]):
        owner, _, attribute = name.partition(".")
        if re.fullmatch(r"[A-Za-z_]\w*(?:\.\w+)?", name):
            found += (
                [name]
                if owner not in known or (attribute and attribute not in members(owner, nodes))
                else []
            )
    return found


@pytest.mark.parametrize("row", ROWS, ids=NAMES)
def test_what_a_row_names_exists(row):
    assert all(row.values()), "an empty cell; write –"
    assert set(row) in (
        {"label", "meaning", "in the code", "file", "test"},
        {"symbol", "meaning", "in the code", "shape, unit", "paper", "file", "test"},
    )
    if row["file"] == "–":
        assert row["in the code"].startswith("none") and len(row["in the code"].split()) > 3, (
            "without a reason"
        )
    else:
        assert backticked(row["in the code"]) and missing(row) == []
        files = [CODE / name for name in backticked(row["file"])]
        named = {part for name in backticked(row["in the code"]) for part in name.split(".")}
        assert all(named & defined(statements([file])) for file in files), (
            "a file of the row defines none of its names"
        )
        assert row["test"] != "–", "code without a test"
    for test in backticked(row["test"]):
        file, _, name = test.partition(".")
        assert name in FUNCTIONS.get(file, set()), test
    assert set(re.findall(LABEL, " ".join(row.values()))) <= set(PAPER["labels"])


def test_what_is_not_there_is_seen():
    row = {
        "in the code": "`Projection.solve`, `Projection.solved`, `Projektion`",
        "file": "`physics/projection.py`",
    }
    assert missing(row) == ["Projection.solved", "Projektion"]
    assert missing(row | {"file": "`physics/projektion.py`"}) == ["physics/projektion.py"]


def test_every_label_and_every_symbol_has_a_row():
    labels, symbols = ([one for row in ROWS for one in of(row)] for of in (labels_of, symbols_of))
    assert len(PAPER["labels"]) > 30 and len(PAPER["symbols"]) > 100
    assert {
        label: labels.count(label) for label in PAPER["labels"] if labels.count(label) != 1
    } == {}
    assert {
        symbol: symbols.count(symbol) for symbol in PAPER["symbols"] if symbols.count(symbol) != 1
    } == {}


def latex() -> str:
    if not LATEX.is_file():
        pytest.skip("the paper's source is not here")
    source = LATEX.read_text(encoding="utf-8")
    return source[source.index("\\begin{document}") : source.index("\\bibliography{")]


def test_the_stored_labels_are_those_of_the_paper():
    assert re.findall(rf"\\label\{{({LABEL})\}}", latex()) == PAPER["labels"]


def test_the_stored_symbols_are_those_of_the_paper():
    """Each stands in the source; every Greek letter, every letter with a subscript in roman and every calligraphic and
    blackboard letter of the source, but for ℝ and ℤ, is part of one."""
    source, stored = latex(), "  ".join(PAPER["symbols"].values())
    assert [symbol for symbol, meant in PAPER["symbols"].items() if meant not in source] == []
    kinds = [
        GREEK,
        r"\\math(?:cal|bb)\{[A-Z]\}",
        r"(?<![A-Za-z\\])[A-Za-z]_\\mathrm\{\w+\}",
        r"\\(?:hat|tilde|bar|breve)\{\\?\w+(?:\{\w+\})?\}",
    ]
    used = {letter for kind in kinds for letter in re.findall(kind, source)}
    assert len(used) > 40
    assert (
        sorted(letter for letter in used - {r"\mathbb{R}", r"\mathbb{Z}"} if letter not in stored)
        == []
    )
