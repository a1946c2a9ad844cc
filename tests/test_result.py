"""The content of result.json: every key is documented, nothing is NaN, and what was written can be read."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from test_cli import MLP, SPEC, make_project, run

from orthaug._base.content import Content, Flag, Number, Numbers, Whole
from orthaug.analysis.fit_findings import ParameterResult, ScoreResult
from orthaug.reports.result import DataResult, FitResult

pytestmark = pytest.mark.usefixtures("without_figures")

COMMANDS = [
    *("fit", "check", "compare", "split", "design", "recover", "select", "explain", "linearize"),
    *("track", "error"),
]
DOCUMENT = Path(__file__).resolve().parents[1] / "docs" / "result.md"


def documented() -> dict[str, set[str]]:
    """The keys of each place in the tables of docs/result.md."""
    places: dict[str, set[str]] = {}
    for line in DOCUMENT.read_text(encoding="utf-8").splitlines():
        if not line.startswith("| ") or line.startswith("| where"):
            continue
        where, keys = line.strip("| ").split(" | ", maxsplit=1)
        command, _, rest = where.rpartition(": ")
        for place in re.findall(r"`([^`]+)`", rest) or ["top"]:
            places[f"{command.strip('`') or 'fit'}: {place}"] = set(
                re.findall(r"`([a-z_0-9]+)`", keys)
            )
    return places


@cache
def schema(command: str) -> dict[str, Any]:
    return json.loads(run("schema", command).out)


def tables(
    node: dict[str, Any], place: str, known: dict[str, Any]
) -> Iterator[tuple[str, set[str]]]:
    """Every object of a schema with its keys; `[]` for the entries of a list, `{}` for those of a table."""
    node = known[node["$ref"].rpartition("/")[2]] if "$ref" in node else node
    if "properties" in node:
        yield place or "top", set(node["properties"])
    for name, inner in node.get("properties", {}).items():
        yield from tables(inner, f"{place}.{name}" if place else name, known)
    for inner in node.get("anyOf", []):
        yield from tables(inner, place, known)
    for key, mark in (("items", "[]"), ("additionalProperties", "{}")):
        if isinstance(node.get(key), dict):
            yield from tables(node[key], place + mark, known)


@cache
def places() -> list[tuple[str, str, set[str]]]:
    """Command, place and keys."""
    return [
        (command, place, keys)
        for command in COMMANDS
        for place, keys in tables(schema(command), "", schema(command)["$defs"])
    ]


def test_every_key_is_documented():
    known, lacking = documented(), {}
    for command, place, keys in places():
        place = place.removeprefix("comparison[].") if command == "compare" else place
        lacking[command, place] = keys - known.get(
            f"{command}: {place}", known.get(f"fit: {place}", set())
        )
    assert {place: keys for place, keys in lacking.items() if keys} == {}, (
        "docs/result.md does not tell of these"
    )


def test_no_key_is_documented_that_is_not_there():
    there = {f"{command}: {place}" for command, place, _ in places()}
    assert documented().keys() - there == set()


def test_what_json_cannot_hold_is_null():
    class Each(Content):
        number: Number
        numbers: Numbers
        whole: Whole
        flag: Flag | None

    class Given(NamedTuple):
        number: float = np.float64("inf")
        numbers: Any = np.array([1.0, np.nan])
        whole: Any = np.int64(3)
        flag: Any = np.bool_(True)

    each = Each.model_validate(Given())
    assert each.content() == {"number": None, "numbers": [1.0, None], "whole": 3, "flag": True}
    assert Each.model_validate_json(each.to_json()) == each


def test_a_null_in_place_of_a_number_is_read_as_not_a_number():
    @dataclass(frozen=True)
    class Inner:
        p: float
        name: str

    class Outer(Content):
        inner: list[Inner]
        found: Inner | None

    made = Outer(inner=[Inner(0.5, "a"), Inner(math.inf, "b")], found=Inner(np.float64("nan"), "c"))
    assert made.content() == {
        "inner": [{"p": 0.5, "name": "a"}, {"p": None, "name": "b"}],
        "found": {"p": None, "name": "c"},
    }
    read = Outer.from_json(made.to_json())
    assert read.inner[0] == made.inner[0] and math.isnan(read.inner[1].p)
    assert read.found is not None and math.isnan(read.found.p)
    with pytest.raises(ValueError, match="name"):
        Outer.from_json('{"inner": [{"p": 1.0}], "found": null}')


def test_a_score_that_no_output_has_is_null_as_a_whole():
    class Given(NamedTuple):
        rmse: Any = np.array([0.5, np.nan])
        nrmse: Any = np.array([np.nan, np.nan])
        fit: Any = np.array([np.inf, 1.0])

    content = ScoreResult.model_validate(Given()).content()
    assert content == {"rmse": [0.5, None], "nrmse": None, "fit": [None, 1.0]}


def test_keys_that_are_there_only_at_times():
    parameter = {"name": "a", "unit": "", "initial": 0.0, "value": np.nan}
    always = dict.fromkeys(("value", "std", "ci95", "bias", "ci95_with_bias"))
    assert ParameterResult.model_validate(parameter).content() == parameter | always
    assert DataResult(train=[]).content() == {"train": []}


@pytest.fixture(scope="module")
def written(tmp_path_factory) -> str:
    folder = tmp_path_factory.mktemp("written")
    spec = make_project(folder, SPEC.replace('kind = "none"\n', MLP))
    assert run("fit", spec, "--out", folder / "out").code == 0
    return (folder / "out" / "result.json").read_text(encoding="utf-8")


def test_what_was_written_can_be_read(written):
    result = FitResult.from_json(written)
    assert result.to_json() + "\n" == written
    assert result.parameters[0].name == "a" and result.scores["train"].prediction.rmse


def test_places_are_reported_as_the_spec_names_files(written):
    """A result does not change with the folder that it was made in."""
    worst = json.loads(written)["stability"]["lipschitz"]["worst"]
    assert worst["where"].startswith("experiment 0, run.csv: line")


def test_the_schema_has_what_was_written(written):
    """Every key of result.json, at every place; tables whose keys are names of the spec aside."""

    def check(value: Any, node: dict[str, Any]) -> int:
        node = schema("fit")["$defs"][node["$ref"].rpartition("/")[2]] if "$ref" in node else node
        if "anyOf" in node and value is not None:
            (node,) = [one for one in node["anyOf"] if one.get("type") != "null"][:1]
            return check(value, node)
        if "properties" in node:
            assert value.keys() <= node["properties"].keys() and value.keys() >= {*node["required"]}
            return 1 + sum(check(inner, node["properties"][key]) for key, inner in value.items())
        return sum(check(inner, node["items"]) for inner in value or []) if "items" in node else 0

    assert check(json.loads(written), schema("fit")) > 20


def test_the_schema_of_another_command_is_refused():
    done = run("schema", "simulate")
    known = ", ".join((*COMMANDS[:-1], "benchmark", "error", "spec", "keys"))
    assert done.code == 2 and f"must be one of {known}; got 'simulate'" in done.err


def test_the_schema_knows_what_may_be_absent_and_null():
    parameter = schema("fit")["$defs"]["ParameterResult"]
    assert (
        parameter["required"][:4] == ["name", "unit", "initial", "value"]
        and "one_step" not in parameter["required"]
    )
    assert parameter["properties"]["std"]["anyOf"] == [{"type": "number"}, {"type": "null"}]
