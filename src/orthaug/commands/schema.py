"""Output of `orthaug schema`: the keys of a spec in words, JSON schemas of specs and results."""

from __future__ import annotations

import re
from importlib.resources import files
from pathlib import Path

from orthaug._base.content import Content
from orthaug.reports.benchmark import BenchmarkResult
from orthaug.reports.explanation import ExplainResult
from orthaug.reports.failure import FailureResult
from orthaug.reports.linear import LinearizeResult
from orthaug.reports.recovery import RecoverResult
from orthaug.reports.result import CheckResult, CompareResult, DesignResult, FitResult, SplitResult
from orthaug.reports.selection import SelectResult
from orthaug.reports.tracking import TrackResult

RESULTS: dict[str, type[Content]] = {
    "fit": FitResult,
    "check": CheckResult,
    "compare": CompareResult,
    "split": SplitResult,
    "design": DesignResult,
    "recover": RecoverResult,
    "select": SelectResult,
    "explain": ExplainResult,
    "linearize": LinearizeResult,
    "track": TrackResult,
    "benchmark": BenchmarkResult,
    "error": FailureResult,
}
"""Contents of results by command, and of an error of any command with `--json`."""


def schema_of(command: str) -> dict[str, object]:
    """Return the JSON schema of what a command writes."""
    return RESULTS[command].model_json_schema(mode="serialization")


def keys_of_a_spec() -> str:
    """Return docs/spec.md: a wheel has it beside this file, a checkout in its folder docs."""
    carried = files("orthaug.commands").joinpath("spec.md")
    page = carried if carried.is_file() else Path(__file__).parents[3] / "docs" / "spec.md"
    return re.sub("<!--.*-->\n", "", page.read_text(encoding="utf-8")).rstrip()


def schema_of_a_spec() -> dict[str, object]:
    """Return the JSON schema of a spec: keys, types, limits and defaults."""
    from orthaug.commands.spec import Spec

    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **Spec.model_json_schema()}
