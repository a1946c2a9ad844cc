"""The text of a first spec: what `orthaug init` writes for the columns of a file and a linear model of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tomlkit

from orthaug._base.lines import counted
from orthaug.commands.folder import relative
from orthaug.data.columns import Column
from orthaug.data.survey import Survey
from orthaug.selection.first_orders import FirstModel

FILLED = 3
"""Rows of a gap that the spec's step `fill` reconstructs at most."""
_CLEARLY = "first significant at lag {}; from here on it runs clearly better on rows held out"


@dataclass(frozen=True, eq=False)
class Roles:
    """Which columns of a file are inputs, which outputs, and the sampling time [s] where a person said it."""

    inputs: tuple[Column, ...]
    outputs: tuple[Column, ...]
    sampling_time: float | None = None


def channel_names(columns: Sequence[Column]) -> list[str]:
    """What the channels of these columns are called."""
    return [column.name for column in columns]


def time_of(found: Survey, roles: Roles) -> str | None:
    """The column of instants, where there is one that is to be used: uneven steps, or such as every part has."""
    clock = found.clock
    used = clock.column is not None and clock.instants and not roles.sampling_time
    return clock.column.header if used and clock.column and (clock.steady or not clock.even) else None


def steps_of(found: Survey, roles: Roles) -> list[tuple[str, dict[str, Any]]]:
    """Preparation that the data need: spikes of outputs replaced, uneven instants put onto a grid."""
    steps: list[tuple[str, dict[str, Any]]] = []
    if any(column.spikes for column in roles.outputs):
        threshold = min(column.threshold for column in roles.outputs)
        steps += [("outliers", {"threshold": threshold}), ("fill", {"most": FILLED, "method": "pchip"})]
    if time_of(found, roles) and not found.clock.even:
        steps.append(("resample", {"sampling_time": found.clock.step}))
    return steps


def step_of(found: Survey, roles: Roles) -> float:
    """Seconds between rows: as given, as the file tells, or 1."""
    return roles.sampling_time or found.clock.step or 1.0


def lacking(rows: int) -> str:
    """So many rows lack a value, in words."""
    return f"{counted(rows, 'row')} lack{'s' if rows == 1 else ''} a value"


def spec_text(
    found: Survey,
    roles: Roles,
    out: Path,
    rows: int,
    cut: int,
    gaps: str,
    named: tuple[list[str], list[str]],
    model: FirstModel,
) -> str:
    """The spec with comments; `gaps` says which rows will be left out, "" for none."""
    document = tomlkit.document()
    document.add(tomlkit.comment(f"Written by orthaug init from {found.path.name}. Run: orthaug fit {out.name}"))
    document.add(tomlkit.comment("Every key: orthaug schema keys. What is written here is a start, not a verdict."))
    document.add("data", _data(found, roles, out, rows, cut, gaps, named))
    document.add(tomlkit.nl())
    document.add(
        tomlkit.comment(
            "The physics: linear difference equations, to be replaced by what you know ([motion]: equations of motion)."
        )
    )
    document.add("baseline", _baseline(named, model))
    learner = tomlkit.table()
    learner.add("kind", "mlp")
    learner.add("hidden", [8])
    learner["hidden"].comment("sees the lags that the physics reads; [lags] gives it more, `inputs` fewer")
    document.add("learner", learner)
    training = tomlkit.table()
    training.add("restarts", 3)
    document.add("training", training)
    return tomlkit.dumps(document)


def _data(
    found: Survey, roles: Roles, out: Path, rows: int, cut: int, gaps: str, named: tuple[list[str], list[str]]
) -> Any:
    file, clock = relative(found.path, out.resolve().parent), found.clock
    data = tomlkit.table()
    time = time_of(found, roles)
    if time is not None:
        data.add("time", time)
        data["time"].comment(f"{'every' if clock.even else 'mostly every'} {clock.step:g} s")
    else:
        data.add("sampling_time", step_of(found, roles))
        unknown = clock.step is None and not roles.sampling_time
        data["sampling_time"].comment("s; no column tells it: change it" if unknown else "s")
    for key, names in zip(("inputs", "outputs"), named, strict=True):
        data.add(key, names)
    uneven = time is not None and not clock.even
    if gaps or uneven:
        data.add("missing", "skip")
        data["missing"].comment(gaps or "nothing is interpolated across gaps")
    for name, part in (("train", [0, cut]), ("tests", [cut, rows])):
        if part[0] == part[1]:
            continue
        entry = tomlkit.inline_table()
        entry.update({"files": [file], "rows": part})
        if name == "train":
            data.add("train", entry)
        else:
            data.add(tomlkit.key(["tests", "last"]), entry)
    channels = tomlkit.table(is_super_table=True)
    for column in (*roles.inputs, *roles.outputs):
        entry = tomlkit.inline_table()
        entry.update({"column": column.header} if column.header != column.name else {})
        entry.update({"unit": column.unit} if column.unit else {})
        if entry:
            channels.add(tomlkit.key(column.name), entry)
    if len(channels):
        data.add("channels", channels)
    steps = tomlkit.aot()
    for kind, keys in steps_of(found, roles):
        step = tomlkit.table()
        step.update({"step": kind, **keys})
        steps.append(step)
    if len(steps):
        data.add("prepare", steps)
    return data


def _baseline(named: tuple[list[str], list[str]], model: FirstModel) -> Any:
    inputs, outputs = named
    terms, orders = [], model.orders
    told = {}
    for name, nk, seen in zip(inputs, orders.nk, model.delays, strict=True):
        if seen != nk:
            why = "no lag of it is significant, so this is a guess" if seen is None else _CLEARLY.format(seen)
            told[f"{name}[k-{nk}]" if nk else f"{name}[k]"] = why
    for output in outputs:
        own = f"_{output}" if len(outputs) > 1 else ""
        found = [(f"a{i}{own}", f"{output}[k-{i}]") for i in range(1, orders.na + 1)]
        for name, nb, nk in zip(inputs, orders.nb, orders.nk, strict=True):
            by = f"_{name}" if len(inputs) > 1 else ""
            found += [(f"b{lag}{by}{own}", f"{name}[k-{lag}]" if lag else f"{name}[k]") for lag in range(nk, nk + nb)]
        found += [(f"offset{own}", "1")] if model.offset else []
        for parameter, regressor in found:
            term = tomlkit.table()
            term.add("parameter", f"{parameter}_" if parameter in (*inputs, *outputs) else parameter)
            term.add("regressor", regressor)
            if regressor in told:
                term["regressor"].comment(told[regressor])
            if own:
                term.add("output", output)
            terms.append(term)
    array = tomlkit.aot()
    for term in terms:
        array.append(term)
    baseline = tomlkit.table(is_super_table=True)
    baseline.add("terms", array)
    return baseline
