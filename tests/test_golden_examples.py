"""Golden numbers of the examples, on short records; see test_golden.py."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest
from test_golden import assert_golden, specs

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"
SHORTENED = {"data", "training", "validation", "engine", "design"}


@pytest.mark.parametrize("spec", specs("example"))
@pytest.mark.usefixtures("golden_folder", "without_figures")
def test_an_example(spec):
    assert_golden(spec)


def test_every_example_has_its_numbers():
    copies = {
        spec.values[0].stem.removeprefix("example_"): spec.values[0] for spec in specs("example")
    }
    assert set(copies) == {path.stem for path in EXAMPLES.glob("*.toml")}
    for name, copy in copies.items():
        sections = [
            tomllib.loads(path.read_text(encoding="utf-8"))
            for path in (EXAMPLES / f"{name}.toml", copy)
        ]
        kept = [
            {key: value for key, value in one.items() if key not in SHORTENED} for one in sections
        ]
        assert kept[0] == kept[1], name
