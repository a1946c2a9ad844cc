"""What `orthaug explain` tells."""

from __future__ import annotations

from orthaug.reports.fields import Content, Flag, Number, WarningResult, Whole
from orthaug.reports.result import Headed


class ExplainingTermResult(Content):
    """A term to add to the physics."""

    parameter: str
    expression: str
    kind: str
    on: str | None
    width: Number
    added_to: str
    coefficient: Number
    unit: str | None
    std: Number
    share: Number
    alone: Number
    rivals: list[str]


class SingleTermResult(Content):
    """A term as the only one."""

    name: str
    expression: str
    added_to: str
    share: Number


class MovedParameterResult(Content):
    """A parameter now, and with the terms in the physics."""

    name: str
    unit: str
    value: Number
    value_with: Number


class ExplainResult(Headed):
    """What `orthaug explain` tells."""

    found: Flag
    share: Number
    noise: Number
    p: Number
    points: Whole
    terms: list[ExplainingTermResult]
    singles: list[SingleTermResult]
    parameters: list[MovedParameterResult]
    spec: str | None
    text: str
    warnings: list[WarningResult]
