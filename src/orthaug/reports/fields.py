"""Fields of results: plain numbers and lists for JSON, read from the objects of the library."""

from __future__ import annotations

import json
from typing import Annotated, Any, ClassVar

import numpy as np
from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    SerializerFunctionWrapHandler,
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

    def content(self) -> dict[str, Any]:
        """Return the result as dictionaries, lists, text, numbers and None."""
        return self.model_dump(mode="json", by_alias=True)

    def to_json(self) -> str:
        """Return the content as text; never NaN."""
        return json.dumps(self.content(), indent=1, ensure_ascii=False, allow_nan=False)


class IntervalsResult(Content):
    """Source of the intervals of a fit of chosen terms, in a word and in a sentence."""

    source: str
    text: str


class WarningResult(Content):
    """A `Warning`: a `code` for programs and a sentence for the reader."""

    code: str
    text: str
