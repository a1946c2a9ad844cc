"""The measure that the options of `orthaug split` declare. The registry says which option belongs to which kind."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, get_origin

from orthaug._base.checks import check_choice
from orthaug._base.errors import InputError, KeyedError
from orthaug._base.registry import Key, keys_of, resolve
from orthaug.inference.kinds import MEASURES
from orthaug.inference.measure_files import MeasurePlace
from orthaug.inference.measures import Measure


def read_measure(kind: str, given: Mapping[str, Sequence[str]], place: MeasurePlace) -> Measure:
    """The measure of a kind from the values `given` to each option.

    Raises:
        InputError: an unknown kind, an option of another kind or without what it needs, files that do not fit.
    """
    check_choice(kind, MEASURES, "--measure")
    values = {}
    for option, texts in given.items():
        owned = MEASURES.kind_with(option)
        if not texts or owned is None:
            continue
        owner, key = owned
        if owner != kind:
            raise InputError(f"--{option}: belongs to --measure {owner}; found --measure {kind}.")
        values[key.name] = _read(key, option, texts)
    try:
        return resolve(MEASURES.declare(kind, values), place)
    except KeyedError as error:
        raise InputError(f"--{_option_of(kind, error.key)}{error.words}.") from None


def split_place(model: Any, record: Any) -> MeasurePlace:
    """The place of a saved model's measure: files relative to the working folder, and the training data."""
    return MeasurePlace(Path(), [str(lag) for lag in model.form.used], record, model.form.first_row)


def _option_of(kind: str, name: str) -> str:
    key = keys_of(MEASURES[kind]).get(name)
    return (key.option if key else None) or name


def _read(key: Key, option: str, texts: Sequence[str]) -> Any:
    """The value of a key: limits by raw lag for a mapping, the texts themselves otherwise."""
    if get_origin(key.type) is not Mapping:
        return tuple(texts)
    limits: dict[str, tuple[float, float]] = {}
    for text in texts:
        lag, equals, both = text.partition("=")
        try:
            low, high = (float(limit) for limit in both.split(":"))
        except ValueError:
            equals = ""
        if not equals:
            raise InputError(f"--{option}: found '{text}'; expected a raw lag and its limits, such as 'u[k]=-0.6:0.6'.")
        if lag.strip() in limits:
            raise InputError(f"--{option}: {lag.strip()} is given twice.")
        limits[lag.strip()] = (low, high)
    return limits
