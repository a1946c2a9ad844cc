"""The results of all commands, and their JSON schemas."""

from __future__ import annotations

from typing import Any

from orthaug.reports.explanation import ExplainResult
from orthaug.reports.fields import Content
from orthaug.reports.linear import LinearizeResult
from orthaug.reports.result import CheckResult, CompareResult, DesignResult, FitResult, SplitResult
from orthaug.reports.selection import SelectResult
from orthaug.reports.tracking import TrackResult

RESULTS: dict[str, type[Content]] = {
    "fit": FitResult,
    "check": CheckResult,
    "compare": CompareResult,
    "split": SplitResult,
    "design": DesignResult,
    "select": SelectResult,
    "explain": ExplainResult,
    "linearize": LinearizeResult,
    "track": TrackResult,
}
"""By command."""


def schema_of(command: str) -> dict[str, Any]:
    """The JSON schema of what a command writes."""
    return RESULTS[command].model_json_schema(mode="serialization")
