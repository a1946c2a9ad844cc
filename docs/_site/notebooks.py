"""Three tutorials as executed notebooks: their text and code, what the code printed, and the fit as a notebook shows it.

    python docs/_site/notebooks.py          all of them: a minute
    python docs/_site/notebooks.py terms    that of one tutorial

nbclient runs them in a kernel of its own. All are written to docs/notebooks.
"""

from __future__ import annotations

import json
import re
import sys
import tempfile
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
NOTEBOOKS = ROOT / "docs" / "notebooks"
sys.path.insert(0, str(ROOT / "tests"))

import documents  # noqa: E402  (of the folder above)

SHOWN = {
    "terms": ["fit", 'fit.plot.learned("y[k-1]");'],
    "several_outputs": ["fit", "fit.plot.free_run();"],
    "memory": ["fit", "fit.plot.free_run();"],
}
"""Tutorials, and the cells that a notebook has in the place of the picture."""
PICTURE = re.compile(r"!\[[^\]]*\]\([^)]*\)\n+(\*[^\n]*\*\n)?")
LINK = re.compile(r"\]\((?!https?:|#|\.\./)([\w/]+\.md)")


def notebook_of(page: Path) -> dict[str, Any]:
    """Return the notebook of a tutorial, not executed: format 4.5 as plain content."""
    cells: list[dict[str, Any]] = []
    lines, at = page.read_text(encoding="utf-8").split("\n"), 0
    for block in documents.blocks("\n".join(lines)):
        assert block.language == "python" and not block.given, f"{page.name}:{block.line}"
        cells += _texts(lines[at : block.line - 1], SHOWN[page.stem])
        cells.append(_cell("code", block.text))
        at = block.line + block.text.count("\n") + 1
    cells += _texts(lines[at:], SHOWN[page.stem])
    for number, cell in enumerate(cells):
        cell["id"] = f"{page.stem}-{number}"
    language = {"language_info": {"name": "python"}}
    kernel = {"kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"}}
    return {"cells": cells, "metadata": {**kernel, **language}, "nbformat": 4, "nbformat_minor": 5}


def _texts(lines: list[str], shown: list[str]) -> list[dict[str, Any]]:
    """Return cells of the text between blocks, without what a block printed, and its picture drawn."""
    text = re.sub(r"```text\n.*?\n```", "", "\n".join(lines), flags=re.DOTALL)
    text = LINK.sub(r"](../tutorials/\1", re.sub(r"<!--.*?-->", "", text))
    before, *after = PICTURE.split(text)
    parts = [_cell("markdown", before)]
    for part in after[1::2]:
        parts += [*(_cell("code", line) for line in shown), _cell("markdown", part)]
    return [part for part in parts if part["source"]]


def _cell(kind: str, text: str) -> dict[str, Any]:
    own = {"execution_count": None, "outputs": []} if kind == "code" else {}
    return {"cell_type": kind, "metadata": {}, "source": text.strip("\n"), **own}


def executed(notebook: dict[str, Any]) -> dict[str, Any]:
    """Return a notebook with what its cells show, run from top to bottom in a fresh folder.

    Raises:
        nbclient.exceptions.CellExecutionError: a cell failed.
    """
    import nbclient
    import nbformat

    made = nbformat.from_dict(notebook)
    with tempfile.TemporaryDirectory() as folder:
        resources = {"metadata": {"path": folder}}
        nbclient.NotebookClient(
            made, timeout=600, kernel_name="python3", resources=resources, record_timing=False
        ).execute()
    made.metadata = notebook["metadata"]
    return json.loads(nbformat.writes(made))


def main() -> None:
    NOTEBOOKS.mkdir(exist_ok=True)
    for name in sys.argv[1:] or SHOWN:
        made = executed(notebook_of(ROOT / "docs" / "tutorials" / f"{name}.md"))
        text = json.dumps(made, indent=1, ensure_ascii=False)
        (NOTEBOOKS / f"{name}.ipynb").write_text(f"{text}\n", encoding="utf-8")


if __name__ == "__main__":
    main()
