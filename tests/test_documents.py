"""Every block of code of README and docs runs as it is written, in a fresh folder, and prints what stands below it."""

from __future__ import annotations

import matplotlib
import pytest
from documents import ROOT, Page, blocks, differences, pages

PAGES = {page.relative_to(ROOT).as_posix(): page for page in pages()}
BLOCKS = {name: list(blocks(page.read_text(encoding="utf-8"))) for name, page in PAGES.items()}
RUNNING = [name for name, found in BLOCKS.items() if any(block.not_run is None for block in found)]
NOT_RUN = 20


@pytest.mark.parametrize("name", RUNNING)
def test_the_page_runs(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    matplotlib.use("agg")
    page = Page(PAGES[name])
    for block in page.blocks:
        if block.not_run is None:
            printed = page.printed(block)
            assert block.prints is None or differences(block.prints, printed) == [], f"{name}:{block.line}"


def test_few_blocks_are_not_run_and_each_says_why():
    left_out = [
        f"{name}:{block.line} {block.language}: {block.not_run}"
        for name, found in BLOCKS.items()
        for block in found
        if block.not_run is not None
    ]
    print("\n".join(left_out))
    assert len(left_out) <= NOT_RUN
    assert all(len(reason.rpartition(": ")[2].split()) >= 2 for reason in left_out)


@pytest.mark.parametrize(
    ("expected", "printed", "same"),
    [
        ("RMSE 0.0251 m", "RMSE   0.02512 m\n", True),
        ("RMSE 0.0251 m", "RMSE 0.0271 m", False),
        ("rank 3 of 3", "rank 2 of 3", False),
        ("took ... s\nloss 1.2e-3", "took 5 s of 8 s\n\nloss 1.21e-03\n", True),
        ("loss 1.2e-3", "loss 1.4e-03", False),
        ("y[k-1]  -0.5", "y[k-2] -0.5", False),
        ("value -0.5", "value 0.5", False),
        ("a b", "a c", False),
    ],
)
def test_output_is_compared(expected, printed, same):
    assert (differences(expected, printed) == []) is same


def test_blocks_of_a_page():
    text = (
        '<!-- given: run1.csv, record -->\n```python\nx = 1\n```\n\n```text\n1\n```\n<!-- not run: no such machine -->\n'
        '```sh\nfail\n```\nwords\n```text\nno output\n```\n<!-- exit 2 -->\n```toml title="a.toml"\n```\n'
    )
    one, two, three = blocks(text)
    assert (one.given, one.prints, one.line) == (["run1.csv", "record"], "1\n", 2)
    assert (two.not_run, two.prints) == ("no such machine", None)
    assert (three.title, three.exits) == ("a.toml", 2)
