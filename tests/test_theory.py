"""The table of theory: every statement of the paper has a row, and what a row names exists."""

from __future__ import annotations

import ast
import importlib
import json
import re
from pathlib import Path
from typing import Any

import pytest
from test_architecture import ROOMS
from test_cli import run

from orthaug.studies.reproduction import catalogue
from orthaug.studies.theory import THEORY, Statement

TESTS = Path(__file__).parent
PAPER = json.loads((TESTS / "references" / "paper.json").read_text(encoding="utf-8"))
SOURCE = TESTS.parents[1] / "shared" / "paper" / "orthogonal-by-construction.tex"
STATEMENTS = ("assum", "cond", "exmp", "lem", "property", "thm")
COMMANDS = {*re.findall(r"^  (\w+) ", run("--help").out.partition("Commands:")[2], re.MULTILINE)}
FUNCTIONS = {
    path.stem: {
        node.name
        for node in ast.parse(path.read_text(encoding="utf-8")).body
        if hasattr(node, "name")
    }
    for path in TESTS.glob("test_*.py")
}


def places(statement: Statement) -> list[str]:
    """Dotted names of the code, such as `physics.projection.Projection.solve`."""
    return re.findall(rf"(?<![\w/.])(?:{'|'.join(ROOMS)})(?:\.[A-Za-z_]\w*)+", " ".join(statement))


def cited(statement: Statement) -> list[tuple[str, str]]:
    """File and function, or none for a whole file, of every test; a function alone is in the file named before."""
    found, file = [], ""
    for whole, given, name in re.findall(
        r"tests/(test_\w+)\.py|(?:(test_\w+)\.)?(test_\w+)", statement.shown
    ):
        file = whole or given or file
        found.append((file, name))
    return found


def studies(statement: Statement) -> list[str]:
    listed = re.findall(r"(?i)\bstud(?:y|ies) (\w+(?: and \w+)?)", " ".join(statement))
    return [name for names in listed for name in names.split(" and ")]


def thing(place: str) -> Any:
    """The module, or what stands in it; None where there is no such thing."""
    found, path = None, ""
    for name in place.split("."):
        path = f"{path}.{name}" if path else name
        if hasattr(found, "__path__") or found is None:
            try:
                found = importlib.import_module(f"orthaug.{path}")
                continue
            except ModuleNotFoundError:
                return None
        fields = getattr(found, "__dataclass_fields__", {})
        found = getattr(found, name, fields.get(name))
        if found is None:
            return None
    return found


@pytest.mark.parametrize("statement", THEORY, ids=[statement.label for statement in THEORY])
def test_what_a_row_names_exists(statement):
    assert [place for place in places(statement) if thing(place) is None] == []
    assert [(file, name) for file, name in cited(statement) if file not in FUNCTIONS] == []
    assert [
        (file, name) for file, name in cited(statement) if name and name not in FUNCTIONS[file]
    ] == []
    assert set(studies(statement)) <= set(catalogue())
    assert set(re.findall(r"`orthaug (\w+)", " ".join(statement))) <= COMMANDS
    for study, figure in re.findall(r"study (\w+), figure (\w+)", statement.shown):
        text = Path(importlib.import_module(f"orthaug.studies.{study}").__file__ or "").read_text(
            encoding="utf-8"
        )
        assert f'"{figure}":' in text
    labels = re.findall(rf"\b(?:eqs?|{'|'.join(STATEMENTS)}):[\w-]+", " ".join(statement))
    assert [label for label in labels if label not in PAPER["labels"]] == []
    assert places(statement) or statement.computed == "—"
    assert cited(statement) or studies(statement)
    assert all("\\" not in part and part.strip() for part in statement)


def test_the_names_are_found():
    """The patterns above do find them."""
    assert len({place for statement in THEORY for place in places(statement)}) > 25
    assert len({test for statement in THEORY for test in cited(statement)}) > 15
    assert thing("fitting.status.Ending.SPANNED") and thing("analysis.validation.dominance")
    assert (
        thing("fitting.status.Ending.SPANED") is None and thing("fitting.statuses.Ending") is None
    )
    one = Statement(
        "", "", "", "test_paper.test_lemma_1, test_example_1; tests/test_bias.py; study consistency"
    )
    assert cited(one) == [
        ("test_paper", "test_lemma_1"),
        ("test_paper", "test_example_1"),
        ("test_bias", ""),
    ]
    assert studies(one) == ["consistency"]


def test_the_theory_has_every_statement_of_the_paper():
    labels = [label for label in PAPER["labels"] if label.partition(":")[0] in STATEMENTS]
    given = [statement.label for statement in THEORY]
    assert [label for label in labels if label not in given] == []
    assert sum("emark" in label for label in given) == PAPER["remarks"]


def test_the_stored_statements_are_those_of_the_paper():
    if not SOURCE.is_file():
        pytest.skip("the paper's source is not here")
    source = SOURCE.read_text(encoding="utf-8")
    found = re.findall(
        r"\\begin\{(?:assum|exmp|cond|lem|thm)\}(?:\[[^]]*\])?\s*\\label\{([^}]*)\}", source
    )
    assert sorted(found) == sorted(
        label for label in PAPER["labels"] if label.partition(":")[0] in STATEMENTS
    )
    assert len(re.findall(r"\\begin\{rem\}", source)) == PAPER["remarks"]
