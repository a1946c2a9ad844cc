"""The spec that `orthaug init` writes for a data file."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import tomlkit

from orthaug._base.lines import join_words, plural
from orthaug.commands.folder import relative
from orthaug.commands.written_motion import motion_section
from orthaug.data.angles import find_wrap
from orthaug.data.columns import Column
from orthaug.data.survey import Survey
from orthaug.physics.motion import Motion
from orthaug.selection.first_orders import FirstModel

FILLED = 3
"""Rows of a gap that the spec's step `fill` reconstructs at most."""
_REFERENCE = re.compile(r"ref(erence)?|r|set_?point|target|desired|demand|soll\w*", re.IGNORECASE)
CLEARLY = "first significant at lag {}; from here on it runs clearly better on rows held out"


@dataclass(frozen=True, eq=False)
class Roles:
    """The columns that are inputs and outputs, and the sampling time [s] that the user gave.

    `reason` is a sentence on what they were guessed from, "" where names or the user say it.
    """

    inputs: tuple[Column, ...]
    outputs: tuple[Column, ...]
    sampling_time: float | None = None
    reason: str = ""
    thinned: int = 1
    """Factor by which the rows are thinned, behind a low-pass."""
    every: int = 1
    first: int = 0
    """Rows in use, where the outputs have a value in every n-th row only, from the first one."""
    held: tuple[str, ...] = ()
    """Outputs whose sensor is slower than the rows, between whose samples the last one is held."""
    keeps: bool = False
    """True if rows without a value of an output stay: equations of motion run through them."""


def channel_names(columns: Sequence[Column]) -> list[str]:
    """Return what the channels of these columns are called."""
    return [column.name for column in columns]


def time_of(found: Survey, roles: Roles) -> str | None:
    """Return the column of instants, where its times are to be used.

    That is where its steps are uneven, or where every part has it.
    """
    clock = found.clock
    used = clock.column is not None and clock.instants and not roles.sampling_time
    return (
        clock.column.header if used and clock.column and (clock.steady or not clock.even) else None
    )


def steps_of(found: Survey, roles: Roles) -> list[tuple[str, dict[str, Any]]]:
    """Return the preparation that the data need.

    Angles that wrap go on, spikes of other outputs are replaced, and uneven instants resampled
    onto a grid.
    """
    wraps = {column.name: find_wrap(column.values) for column in roles.outputs}
    steps: list[tuple[str, dict[str, Any]]] = [
        ("unwrap", {"period": wrap.period, "channels": [name]})
        for name, wrap in wraps.items()
        if wrap is not None
    ]
    spiky = [one for one in roles.outputs if one.spikes and wraps[one.name] is None]
    if spiky:
        threshold = min(column.threshold for column in spiky)
        steps += [
            ("outliers", {"threshold": threshold}),
            ("fill", {"most": FILLED, "method": "pchip"}),
        ]
    if roles.held:
        steps.append(("repeats", {"channels": list(roles.held)}))
    if time_of(found, roles) and not found.clock.even:
        steps.append(("resample", {"sampling_time": found.clock.step}))
    if roles.thinned > 1:
        steps.append(("decimate", {"factor": roles.thinned}))
    return steps


def wrapped_text(steps: list[tuple[str, dict[str, Any]]]) -> list[str]:
    """Return a line on each angle that a step unwraps."""
    return [
        f"{join_words(keys['channels'])}: an angle that wraps at {keys['period']:.10g}; the step "
        "`unwrap` lets it go on"
        for kind, keys in steps
        if kind == "unwrap"
    ]


def step_of(found: Survey, roles: Roles) -> float:
    """Return the seconds between rows: as given, as in the file, or 1."""
    return roles.sampling_time or found.clock.step or 1.0


def gap_text(rows: int) -> str:
    """Return the number of rows that lack a value, in words."""
    return f"{plural(rows, 'row')} lack{'s' if rows == 1 else ''} a value"


def spec_text(
    found: Survey,
    roles: Roles,
    out: Path,
    rows: int,
    cut: int,
    gaps: str,
    named: tuple[list[str], list[str]],
    model: FirstModel,
    motion: Motion | None = None,
    controlled: Sequence[str] = (),
) -> str:
    """Return the spec with comments; `gaps` says which rows will be left out, "" for none.

    `controlled` are inputs that a controller seems to set. The physics is `motion`, or else the
    first model.
    """
    document = tomlkit.document()
    document.add(
        tomlkit.comment(
            f"Written by orthaug init from {found.path.name}. Run: orthaug fit {out.name}"
        )
    )
    document.add(
        tomlkit.comment("Every key: orthaug schema keys. This is a first draft to be improved.")
    )
    if roles.reason:
        document.add(tomlkit.comment("Inputs and outputs are guessed by what predicts what."))
    document.add("data", _data(found, roles, out, rows, cut, gaps, named))
    document.add(tomlkit.nl())
    learner = tomlkit.table()
    learner.add("kind", "mlp")
    learner.add("hidden", [8])
    if motion is None:
        linear = "linear difference equations, to be replaced by what you know"
        document.add(tomlkit.comment(f"The physics: {linear} ([motion]: equations of motion)."))
        document.add("baseline", _baseline(named, model))
        sees = "the lags that the physics reads; [lags] gives it more, learner.inputs fewer"
        learner["hidden"].comment(f"sees {sees}")
    else:
        document.add(tomlkit.comment("The physics: equations of motion, for you to change."))
        document.add("motion", motion_section(motion))
        learner.add("inputs", list(motion.inputs if motion.learned[0] else motion.names_of_states))
    if motion is None or any(motion.learned):
        document.add("learner", learner)
    training = tomlkit.table()
    training.add("restarts", 3)
    document.add("training", training)
    if controlled:
        document.add(tomlkit.nl())
    for line in _controller_lines(found, roles, controlled):
        document.add(tomlkit.comment(line))
    return tomlkit.dumps(document)


def _controller_lines(found: Survey, roles: Roles, controlled: Sequence[str]) -> list[str]:
    """Return how to declare the controller that seems to set inputs; nothing for none."""
    if not controlled:
        return []
    set_by_it, output = controlled[0], channel_names(roles.outputs)[0]
    used = {id(column) for column in (*roles.inputs, *roles.outputs)}
    named = [c.name for c in found.signals if _REFERENCE.fullmatch(c.name)]
    unused = [c.name for c in found.signals if id(c) not in used and c.name in named]
    reference = next(iter([*unused, *named]), "reference")
    return [
        f"Past outputs predict {join_words(controlled)}, as under feedback. Beside equations of "
        "motion",
        "([motion] instead of [baseline]) the controller can be declared, so that the loop is "
        "simulated:",
        "[controller]",
        f'output = "{set_by_it}"  # then it is no input of [data]',
        f'reference = "{reference}"  # an input of [data] instead',
        f'measured = "{output}"',
        "Kp = 1.0  # also Ki, Kd, filter: gains of a PID; or equations, or a transfer function",
    ]


def _data(
    found: Survey,
    roles: Roles,
    out: Path,
    rows: int,
    cut: int,
    gaps: str,
    named: tuple[list[str], list[str]],
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
        data["sampling_time"].comment("s; no column gives it: change it" if unknown else "s")
    for key, names in zip(("inputs", "outputs"), named, strict=True):
        data.add(key, names)
    apart = found.experiment_column([*roles.inputs, *roles.outputs])
    if apart is not None:
        data.add("experiment", apart.header)
        data["experiment"].comment("its rows of one number are an experiment")
    uneven = time is not None and not clock.even
    if gaps or uneven or roles.every > 1 or roles.keeps:
        data.add("missing", "keep" if roles.keeps else "skip")
        sampled = f"one row in {roles.every} has every output" if roles.every > 1 else ""
        sampled = "held samples are none" if roles.held else sampled
        data["missing"].comment(gaps or sampled or "nothing is interpolated across gaps")
    for name, part in (("train", [roles.first, cut]), ("tests", [cut, rows])):
        if part[0] == part[1]:
            continue
        entry = tomlkit.inline_table()
        pieces = row_ranges(found, *part)
        rows_of = [list(piece) for piece in pieces]
        entry.update({"files": [file], "rows": rows_of if len(pieces) > 1 else rows_of[0]})
        if roles.every > 1:
            entry.update({"every": roles.every})
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
        if kind == "resample":
            step["step"].comment("difference equations need it, [motion] under rk4 does not")
        steps.append(step)
    if len(steps):
        data.add("prepare", steps)
    return data


def _baseline(named: tuple[list[str], list[str]], model: FirstModel) -> Any:
    inputs, outputs = named
    terms, orders = [], model.orders
    comments = {}
    for name, nk, seen, unsure in zip(
        inputs, orders.nk, model.delays, model.undetermined, strict=True
    ):
        if seen != nk:
            why = (
                "the data do not determine its first lag, so this is a guess"
                if unsure
                else "no lag of it is significant, so this is a guess"
                if seen is None
                else CLEARLY.format(seen)
            )
            comments[f"{name}[k-{nk}]" if nk else f"{name}[k]"] = why
    for number, output in enumerate(outputs):
        own = f"_{output}" if len(outputs) > 1 else ""
        found = [(f"a{i}{own}", f"{output}[k-{i}]") for i in range(1, orders.na + 1)]
        found += [
            (f"a{i}_{outputs[j]}{own}", f"{outputs[j]}[k-{i}]")
            for to, j in model.across
            if to == number
            for i in range(1, orders.na + 1)
        ]
        for name, nb, nk in zip(inputs, orders.nb, orders.nk, strict=True):
            by = f"_{name}" if len(inputs) > 1 else ""
            found += [
                (f"b{lag}{by}{own}", f"{name}[k-{lag}]" if lag else f"{name}[k]")
                for lag in range(nk, nk + nb)
            ]
        found += [(f"offset{own}", "1")] if model.offset else []
        for parameter, regressor in found:
            term = tomlkit.table()
            term.add(
                "parameter", f"{parameter}_" if parameter in (*inputs, *outputs) else parameter
            )
            term.add("regressor", regressor)
            if regressor in comments:
                term["regressor"].comment(comments[regressor])
            if own:
                term.add("output", output)
            terms.append(term)
    array = tomlkit.aot()
    for term in terms:
        array.append(term)
    baseline = tomlkit.table(is_super_table=True)
    baseline.add("terms", array)
    return baseline


def row_ranges(found: Survey, start: int, stop: int) -> list[tuple[int, int]]:
    """Return half-open ranges of rows, cut where the time begins anew."""
    ends = [start, *(row for row in found.clock.restarts if start < row < stop), stop]
    return list(pairwise(ends))
