"""The executed notebooks of the documents: cells of their tutorials, outputs that are what the page says, run again."""

from __future__ import annotations

import importlib.util
import json
import sys
from pathlib import Path
from typing import Any

import pytest
from documents import Block, blocks_of, differences

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "docs" / "_site"))

import notebooks  # noqa: E402  (of the folder above)

PAGES = {name: ROOT / "docs" / "tutorials" / f"{name}.md" for name in notebooks.SHOWN}


def stored(name: str) -> dict[str, Any]:
    return json.loads((notebooks.NOTEBOOKS / f"{name}.ipynb").read_text(encoding="utf-8"))


def source(cell: dict[str, Any]) -> str:
    return "".join(cell["source"])


def printed(cell: dict[str, Any]) -> str:
    return "".join("".join(o["text"]) for o in cell["outputs"] if o["output_type"] == "stream")


def pairs(name: str, notebook: dict[str, Any]) -> list[tuple[dict[str, Any], Block]]:
    """Return the cells of a page's blocks, each with its block."""
    cells = {source(cell): cell for cell in notebook["cells"]}
    return [(cells[block.text.strip("\n")], block) for block in blocks_of(PAGES[name])]


@pytest.mark.parametrize("name", PAGES)
def test_a_notebook_has_the_text_and_code_of_its_tutorial(name):
    asked, kept = notebooks.notebook_of(PAGES[name]), stored(name)
    assert [(cell["cell_type"], cell["source"]) for cell in asked["cells"]] == [
        (cell["cell_type"], source(cell)) for cell in kept["cells"]
    ], "write it anew: python docs/_site/notebooks.py"
    written = set("".join(map(source, kept["cells"])).split())
    lost = [word for word in PAGES[name].read_text(encoding="utf-8").split() if word not in written]
    assert len(lost) < 0.4 * len(written)  # what is printed, and the picture


@pytest.mark.parametrize("name", PAGES)
def test_the_outputs_are_those_of_the_page(name):
    kept = stored(name)
    assert not [
        one
        for cell in kept["cells"]
        for one in cell.get("outputs", ())
        if one["output_type"] == "error" or one.get("name") == "stderr"
    ]
    for cell, block in pairs(name, kept):
        assert not differences(block.prints or "", printed(cell)), block.line


@pytest.mark.parametrize("name", PAGES)
def test_a_fit_is_a_table_and_its_plot_a_picture(name):
    shown = {source(cell): cell for cell in stored(name)["cells"]}
    kinds = [
        {k for o in shown[line]["outputs"] for k in o["data"]} for line in notebooks.SHOWN[name]
    ]
    assert "text/html" in kinds[0] and "image/png" in kinds[1]


@pytest.mark.skipif(
    None in map(importlib.util.find_spec, ("nbclient", "ipykernel")),
    reason="no kernel: pip install nbclient ipykernel",
)
def test_a_notebook_runs_from_top_to_bottom():
    again = notebooks.executed(notebooks.notebook_of(PAGES["terms"]))
    for cell, block in pairs("terms", again):
        assert not differences(block.prints or "", printed(cell)), block.line
