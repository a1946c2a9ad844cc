"""Result of `orthaug track`, and its text."""

from __future__ import annotations

from orthaug._base.content import Flag, Number, Whole
from orthaug._base.errors import Warning
from orthaug._base.lines import fold
from orthaug.analysis.fit_findings import ParameterResult
from orthaug.fitting.recursive import Alarm
from orthaug.reports.result import FileResult, ResultHeader
from orthaug.reports.text import parameter_table, warning_lines


class TrackResult(ResultHeader):
    """The result of `orthaug track`."""

    files: list[FileResult]
    model: str
    rows: Whole
    outside: Whole
    time: Number
    forgetting: Number
    memory: Number
    effective_rows: Number
    parameters: list[ParameterResult]
    physical_parameters: list[ParameterResult] | None
    alarms: list[Alarm]
    alarmed: Flag
    alarm_level: Number
    warnings: list[Warning]


def track_text(result: TrackResult) -> str:
    """Return rows, memory, alarms, and the parameters at the end."""
    memory = "everything" if result.memory is None else f"{result.memory:.4g} s"
    lines = [
        f"rows        {result.rows}, {result.time:g} s",
        f"memory      {memory} (forgetting {result.forgetting:.8g}), worth "
        f"{result.effective_rows:.0f} rows",
    ]
    alarms = [str(alarm) for alarm in result.alarms]
    lines += [f"alarm       {sentence}" for sentence in alarms] or ["alarm       none"]
    if alarms:
        state = "is still out of it" if result.alarmed else "has come back"
        lines.append(f"            it {state}, at {result.alarm_level:.2g} of its limit")
    blocks = [lines, parameter_table("parameter", result.parameters)]
    if result.physical_parameters:
        blocks.append(parameter_table("physical", result.physical_parameters))
    blocks.append(warning_lines(result.warnings))
    return "\n\n".join("\n".join(fold(lines)) for lines in blocks if lines)
