"""Fields of results: plain numbers and lists for JSON, read from the objects of the library."""

from __future__ import annotations

import json
import math
from functools import reduce
from operator import getitem
from typing import Annotated, Any, ClassVar, Self

import numpy as np
from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    SerializerFunctionWrapHandler,
    ValidationError,
    model_serializer,
)

from orthaug._base.checks import finite_or_none


def _number(value: Any) -> Any:
    """Return a float, or None where it is not finite: JSON has no NaN."""
    if isinstance(value, float | int | np.number):
        return finite_or_none(float(value))
    return value


def _plain(value: Any) -> Any:
    """Return NumPy's values as Python's own numbers and lists."""
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else value


Number = Annotated[float | None, BeforeValidator(_number)]
Whole = Annotated[int, BeforeValidator(_plain)]
Flag = Annotated[bool, BeforeValidator(_plain)]
Numbers = Annotated[list[Number], BeforeValidator(_plain)]
Wholes = Annotated[list[int], BeforeValidator(_plain)]
ByName = dict[str, Number]


def plain(value: object) -> Any:
    """Return a value for JSON: NumPy's as Python's own, tuples as lists, None for NaN and ∞."""
    if isinstance(value, dict):
        return {name: plain(entry) for name, entry in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return plain(value.tolist())
    if isinstance(value, list | tuple):
        return [plain(entry) for entry in value]
    return finite_or_none(value) if isinstance(value, float) else value


class Content(BaseModel):
    """A table of a result, read from an object's attributes or from JSON."""

    model_config = ConfigDict(from_attributes=True, populate_by_name=True, frozen=True)

    absent: ClassVar[frozenset[str]] = frozenset()
    """Keys that are left out where they hold None; all others are written as null."""

    @model_serializer(mode="wrap")
    def _without_absent(self, handler: SerializerFunctionWrapHandler):
        return {
            key: value
            for key, value in handler(self).items()
            if value is not None or key not in self.absent
        }

    @classmethod
    def from_json(cls, text: str) -> Self:
        """Return the result that a text has; a null in place of a number that is NaN is NaN."""
        content = json.loads(text)
        try:
            return cls.model_validate(content)
        except ValidationError as error:
            for place in (e["loc"] for e in error.errors() if e["input"] is None):
                *path, last = place
                reduce(getitem, path, content)[last] = math.nan
        return cls.model_validate(content)

    def content(self) -> dict[str, Any]:
        """Return the result as dictionaries, lists, text, numbers and None."""
        return plain(self.model_dump(by_alias=True, warnings=False))

    def to_json(self) -> str:
        """Return the content as text; never NaN."""
        return json.dumps(self.content(), indent=1, ensure_ascii=False, allow_nan=False)
