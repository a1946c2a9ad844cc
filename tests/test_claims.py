"""Every measured number of the documents has a command that gives it, and that command can find a wrong number."""

from __future__ import annotations

import ast
import re
import sys
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[1]
sys.path.append(str(ROOT / "benchmarks"))

import claims  # noqa: E402
from anchors import (  # noqa: E402
    ANCHOR,
    AnchorError,
    Block,
    Tolerance,
    blocks,
    collect,
    numbers_in,
)
from documents import COMMENT  # noqa: E402

CHEAP = ("covariance.theta_block", "design.usual")
NAMES = [page.relative_to(ROOT).as_posix() for page in claims.pages()]


def block(text: str) -> Block:
    (only,) = blocks("page.md", text)
    return only


def test_every_number_that_looks_measured_has_an_anchor() -> None:
    found = claims.all_blocks()
    assert {block.page for block in found} == set(NAMES)
    assert {
        f"{block.page}:{block.line}": block.unexplained() for block in found if block.unexplained()
    } == {}


def test_every_comment_is_an_anchor() -> None:
    lines = [
        (name, line.strip())
        for name in NAMES
        for line in (ROOT / name).read_text(encoding="utf-8").splitlines()
    ]
    comments = [(name, line) for name, line in lines if line.startswith("<!--")]
    assert [
        one for one in comments if not ANCHOR.fullmatch(one[1]) and not COMMENT.fullmatch(one[1])
    ] == []


def test_every_anchor_names_a_function_and_numbers() -> None:
    assert len(claims.all_claims()) > 10
    for claim in claims.all_claims():
        file, _, function = claim.function.partition(".")
        tree = ast.parse((ROOT / "benchmarks" / f"{file}.py").read_text(encoding="utf-8"))
        (found,) = (
            node
            for node in tree.body
            if isinstance(node, ast.FunctionDef) and node.name == function
        )
        assert len(found.args.defaults) == len(found.args.args), f"{claim.function} needs arguments"
        assert claim.numbers, f"{claim.place} chooses no number"


def test_every_command_of_a_number_that_depends_on_the_machine_exists() -> None:
    found = [
        text for block in claims.all_blocks() for kind, text in block.anchors if kind == "machine"
    ]
    files = {file for text in found for file in re.findall(r"[\w/]+\.(?:py|toml)", text)}
    assert len(files) > 4
    assert {file for file in files if not (ROOT / file).is_file()} == set()


@pytest.mark.parametrize("name", CHEAP)
def test_the_cheapest_hold(name: str) -> None:
    values = list(claims.flat(claims.function_of(name)()))
    (claim,) = claims.chosen([name])[name]
    held, line = claims.compare(claim, values)
    assert held, line
    assert not claims.compare(claim, [value * 1.5 + 0.1 for value in values if value is not None])[
        0
    ]


@pytest.mark.parametrize(
    ("text", "values"),
    [
        ("0.251 / 0.512 mV, 20", [0.251, 0.512, 20]),
        ("1.36e-6, 300 | **10**", [1.36e-6, 300, 10]),
        ("at −3.5 or -2; ≤ 1e-12, 94–96", [-3.5, -2, 1e-12, 94, 96]),
        ("θ1, x2, 10⁴, jax 0.10.2 and 1e3x", []),
    ],
)
def test_numbers_of_a_text(text: str, values: list[float]) -> None:
    assert [number.value for number in numbers_in(text)] == values
    assert all(
        text[number.start : number.end].strip("<≤ ")[-1].isdigit() for number in numbers_in(text)
    )


@pytest.mark.parametrize(
    ("text", "tolerance", "value", "met"),
    [
        ("0.25", "", 0.2549, True),
        ("0.25", "", 0.2551, False),
        ("8", "", 7.2, False),
        ("1.5e-6", "", 1.549e-6, True),
        ("1.5e-6", "", 1.6e-6, False),
        ("100", "within 10 %", 110, True),
        ("100", "within 10 %", 113, False),
        ("94.8", "within 0.5", 95.3, True),
        ("94.8", "within 0.5", 95.4, False),
        ("2e-5", "within a factor 3", 5e-5, True),
        ("2e-5", "within a factor 3", 8e-5, False),
        ("2e-5", "within a factor 3", -2e-5, False),
        ("≤ 1e-12", "", 7e-14, True),
        ("≤ 1e-12", "", 2e-12, False),
        ("1.0", "within 10 %", np.nan, False),
        ("≤ 1.0", "", np.nan, False),
    ],
)
def test_how_close_is_close(text: str, tolerance: str, value: float, met: bool) -> None:
    (number,) = numbers_in(text)
    assert (Tolerance.of(tolerance) if tolerance else Tolerance()).met(number, value) is met


def test_numbers_are_chosen_by_columns_and_by_quoted_texts() -> None:
    table = block(
        "<!-- measured: a.b; columns 2 to 3; within 5 % -->\n"
        "| 9 | 8 | 7 |\n|---|---|---|\n| 1 | 2 (3) | 4 |\n| 5 | 6 | – |"
    )
    assert [number.value for number in table.claims[0].numbers] == [2, 3, 4, 6]
    assert table.claims[0].tolerance == Tolerance(share=0.05)
    text = block(
        '<!-- measured: a.b; "was # of", "gave #." -->\nIt was\n7 of 9 in 3 s and\ngave 5.5.'
    )
    assert [number.value for number in text.claims[0].numbers] == [7, 5.5]
    assert text.unexplained() == ["It was · of 9 in 3 s and gave "]
    assert block("<!-- measured: a.b -->\n7 of 9 took 3 s").unexplained() == []


@pytest.mark.parametrize(
    "text",
    [
        "took 20 s",
        "in 1.5 of them",
        "by 15 % more",
        "below 1e-6",
        "5 to 15 times",
        "- an item\n- of 3 of 14 tries",
        "| a |\n|---|\n| 0.5 |",
        "<!-- machine: x -->\nfirst\n\nsecond has 0.5",
        "<!-- stated: x -->\n## One\n\n# Next\n\nhas 0.5",
    ],
)
def test_a_number_without_an_anchor_is_found(text: str) -> None:
    assert [told for one in blocks("page.md", text) for told in one.unexplained()] != []


@pytest.mark.parametrize(
    "text",
    [
        "has 95 % intervals of 3 kinds, Sect. 5.2, `x = 0.5`",
        "```\n0.5 s\n```",
        "<!-- machine: x -->\ntook 20 s",
        "<!-- stated: x -->\n\ntook 20 s",
        "<!-- stated: x -->\n# One\n\n## Two\n\nhas 0.5",
    ],
)
def test_a_number_with_an_anchor_or_a_definition_is_let_pass(text: str) -> None:
    assert [told for one in blocks("page.md", text) for told in one.unexplained()] == []


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("<!-- measured: a.b; close -->\n1", "expected `within 20 %`"),
        ('<!-- measured: a.b; "was #" -->\nis 1', 'no text "was #" in the block below'),
        ("<!-- measured: a.b -->\n# Heading", "stands before a heading"),
        ("<!-- measured: a.b -->\n```\n1\n```", "stands before code"),
        ("<!-- stated: a -->", "stands before nothing"),
    ],
)
def test_an_anchor_that_says_nothing_is_refused(text: str, message: str) -> None:
    with pytest.raises(AnchorError, match=re.escape(message)):
        [one.claims for one in blocks("page.md", text)]


PAGE = """# One

It was 7 of 9 in 3 s.
<!-- measured: a.b; "gave #."; within 2 -->
It gave 5.5.

<!-- machine: python x.py -->
| a | b |
|---|---|
| 1 | 2 s |

| a | b |
|---|---|
| 3 | 4 s |

<!-- stated: what was tried -->
## Two

in 0.5 s
"""


def test_comments_become_entries_that_say_the_same() -> None:
    text, entries = collect("page.md", PAGE)
    assert "<!--" not in text
    assert entries == [
        {
            "document": "page.md",
            "text": "It gave 5.5.",
            "measured": "a.b",
            "numbers": '"gave #."',
            "within": "2",
        },
        {"document": "page.md", "text": "| 1 | 2 s |", "machine": "python x.py"},
        {"document": "page.md", "section": "Two", "stated": "what was tried"},
    ]
    beside = list(blocks("page.md", text, entries))
    (claim,) = (claim for one in beside for claim in one.claims)
    assert [number.value for number in claim.numbers] == [5.5]
    assert claim.tolerance == Tolerance(size=2)
    assert [bool(one.unexplained()) for one in beside] == [True, False, True, False]


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ({"text": "absent", "stated": "x"}, "0 blocks have 'absent'"),
        ({"text": "It", "section": "Two", "stated": "x"}, "expected `document`, `text` or"),
        ({"text": "It gave", "stated": "x", "near": "2"}, "expected `document`, `text` or"),
        ({"text": "It gave"}, "one of `measured`"),
        ({"text": "| a | b |", "stated": "x"}, "2 blocks have '| a | b |'"),
        ({"section": "Three", "stated": "x"}, "0 blocks have 'Three'"),
        ({"section": "Two", "measured": "a.b"}, "stands before a heading"),
        ({"text": "It gave", "measured": "a.b", "numbers": '"took #"'}, 'no text "took #"'),
    ],
)
def test_an_entry_that_says_nothing_is_refused(entry: dict[str, str], message: str) -> None:
    text, _ = collect("page.md", PAGE)
    with pytest.raises(AnchorError, match=re.escape(message)):
        [one.claims for one in blocks("page.md", text, [{"document": "page.md", **entry}])]


def test_a_number_that_cannot_be_measured_here_is_left_out() -> None:
    (claim,) = block("<!-- measured: a.b -->\n1.0 and 2.0").claims
    assert claims.compare(claim, [None, 2.0]) == (
        True,
        "met      page.md:2  a.b, 1 number: 2 (2), 1 left out: no data",
    )
    assert claims.compare(claim, [None, None]) == (True, "skipped  page.md:2  a.b: no data")
    assert claims.compare(claim, [1.0, None, 2.0])[1].endswith("2 numbers in the text, 3 computed")
    assert not claims.compare(claim, [None, 2.1])[0]


def test_comments_of_all_pages_are_moved(project, capsys) -> None:
    page = project / "README.md"
    before = [(one.text, one.anchors) for one in claims.all_blocks()]
    assert claims.main(["--collect"]) == 0
    assert capsys.readouterr().out == "2 anchors moved into benchmarks/claims.yaml\n"
    assert "<!--" not in page.read_text()
    assert [(one.text, one.anchors) for one in claims.all_blocks()] == before
    assert claims.main([]) == 0
    page.write_text(page.read_text().replace("2.0 and 3.05", "nothing"))
    with pytest.raises(AnchorError, match="0 blocks have '2.0 and 3.05' of claims.yaml"):
        claims.all_claims()


@pytest.fixture
def project(tmp_path, monkeypatch) -> Path:
    """Documents of two claims whose functions give 1.0 and (2.0, 3.0)."""
    for name in ("benchmarks", "examples", "docs"):
        (tmp_path / name).mkdir()
    for name in ("benchmarks/README.md", "examples/README.md", "docs/a.md"):
        (tmp_path / name).write_text("nothing\n")
    (tmp_path / "README.md").write_text(
        "<!-- measured: one.value -->\n1.0\n\n<!-- measured: two.rows; within 0.1 -->\n2.0 and 3.05"
    )
    monkeypatch.setattr(claims, "ROOT", tmp_path)
    monkeypatch.setattr(claims, "STORE", tmp_path / "out" / "claims.json")
    monkeypatch.setattr(
        claims, "function_of", {"one.value": lambda: 1.0, "two.rows": lambda: [[2.0], (3.0,)]}.get
    )
    return tmp_path


def test_all_claims_are_compared(project, capsys) -> None:
    assert claims.main([]) == 0
    assert capsys.readouterr().out.splitlines() == [
        "met      README.md:2  one.value, 1 number: 1 (1)",
        "met      README.md:5  two.rows, 2 numbers: 2 (2), 3.05 (3)",
    ]
    assert claims.main(["--list"]) == 0
    assert re.search(r"^two\.rows +0 s  README\.md:5$", capsys.readouterr().out, re.MULTILINE)


def test_a_wrong_number_is_reported(project, capsys) -> None:
    assert claims.main(["one"]) == 0
    page = project / "README.md"
    page.write_text(page.read_text().replace("1.0", "1.2").replace("3.05", "3.2"))
    capsys.readouterr()
    assert claims.main(["--last"]) == 1
    assert capsys.readouterr().out.splitlines() == [
        "differs  README.md:2  one.value: 1.2 (computed 1)",
        "unknown  two.rows has not run yet",
    ]
    assert claims.main(["two.rows"]) == 1
    assert capsys.readouterr().out == "differs  README.md:5  two.rows: 3.2 (computed 3)\n"
    with pytest.raises(SystemExit, match="No number in the documents comes from three"):
        claims.main(["three", "one"])
