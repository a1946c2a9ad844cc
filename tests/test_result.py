"""The content of result.json: every key is documented, nothing is NaN, and what was written can be read."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, NamedTuple, Union, get_args, get_origin

import numpy as np
import pytest
from test_cli import MLP, SPEC, make_project, run

from orthaug._base.errors import Warning
from orthaug.commands.schema import RESULTS, schema_of
from orthaug.reports.fields import Content, Flag, Number, Numbers, WarningResult, Whole
from orthaug.reports.result import DataResult, FitResult, ParameterResult, ScoreResult

pytestmark = pytest.mark.usefixtures("without_figures")

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


def key_of(model: type[Content], name: str) -> str:
    return model.model_fields[name].serialization_alias or name


def tables(annotation: Any, place: str) -> Iterator[tuple[str, type[Content]]]:
    """Every model in an annotation with its place; `[]` for the entries of a list, `{}` for those of a table."""
    if isinstance(annotation, type) and issubclass(annotation, Content):
        yield place or "top", annotation
        for name, field in annotation.model_fields.items():
            yield from tables(field.annotation, f"{place}.{name}" if place else name)
    elif get_origin(annotation) is Annotated:
        yield from tables(get_args(annotation)[0], place)
    elif get_origin(annotation) in (Union, UnionType):
        for inner in get_args(annotation):
            yield from tables(inner, place)
    elif get_origin(annotation) is list:
        yield from tables(get_args(annotation)[0], f"{place}[]")
    elif get_origin(annotation) is dict:
        yield from tables(get_args(annotation)[1], f"{place}{{}}")


TABLES = [
    (command, place, model) for command, top in RESULTS.items() for place, model in tables(top, "")
]


def test_every_key_is_documented():
    known, lacking = documented(), {}
    for command, place, model in TABLES:
        place = place.removeprefix("comparison[].") if command == "compare" else place
        keys = {key_of(model, name) for name in model.model_fields}
        lacking[command, place] = keys - known.get(
            f"{command}: {place}", known.get(f"fit: {place}", set())
        )
    assert {place: keys for place, keys in lacking.items() if keys} == {}, (
        "docs/result.md does not tell of these"
    )


def test_no_key_is_documented_that_is_not_there():
    places = {f"{command}: {place}" for command, place, _ in TABLES}
    assert documented().keys() - places == set()


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


def test_a_warning_is_read_with_its_code():
    warning = WarningResult.model_validate(Warning("thinned", "one row in two is kept."))
    assert warning.content() == {"code": "thinned", "text": "one row in two is kept."}


@pytest.fixture(scope="module")
def written(tmp_path_factory) -> str:
    folder = tmp_path_factory.mktemp("written")
    spec = make_project(folder, SPEC.replace('kind = "none"\n', MLP))
    assert run("fit", spec, "--out", folder / "out").code == 0
    return (folder / "out" / "result.json").read_text(encoding="utf-8")


def test_what_was_written_can_be_read(written):
    result = FitResult.model_validate_json(written)
    assert result.to_json() + "\n" == written
    assert result.parameters[0].name == "a" and result.scores["train"].prediction.rmse


def test_places_are_told_as_the_spec_names_files(written):
    """A result does not change with the folder that it was made in."""
    worst = json.loads(written)["stability"]["lipschitz"]["worst"]
    assert worst["where"].startswith("experiment 0, run.csv: line")


@pytest.mark.parametrize("command", RESULTS)
def test_the_schema_names_every_key(command):
    printed = json.loads(run("schema", command).out)
    assert printed == schema_of(command)
    assert list(printed["properties"]) == [
        key_of(RESULTS[command], name) for name in RESULTS[command].model_fields
    ]


def test_the_schema_of_another_command_is_refused():
    done = run("schema", "simulate")
    known = "fit, check, compare, split, design, select, explain, linearize, track, spec, keys"
    assert done.code == 2 and f"must be one of {known}; got 'simulate'" in done.err


def test_the_schema_knows_what_may_be_absent_and_null():
    parameter = schema_of("fit")["$defs"]["ParameterResult"]
    assert (
        parameter["required"][:4] == ["name", "unit", "initial", "value"]
        and "one_step" not in parameter["required"]
    )
    assert parameter["properties"]["std"]["anyOf"] == [{"type": "number"}, {"type": "null"}]
