"""A first spec for a data file: what `orthaug init` tells of it, and writes."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tomlkit

from orthaug._base.errors import InputError
from orthaug._base.folders import whole_file
from orthaug._base.lines import counted, percent
from orthaug.data.readers import read_record
from orthaug.data.record import Channel, Record
from orthaug.data.steps import STEPS
from orthaug.data.survey import Column, Survey, survey
from orthaug.selection.first_orders import FirstModel, first_model

FILLED = 3
"""Rows of a gap that the spec's step `fill` reconstructs at most."""
TRAINED = 0.75  # share of the rows; the rest is a test
_TESTED = 30  # rows of a test at least
_LISTED = 12  # columns in a message


@dataclass(frozen=True, eq=False)
class Roles:
    """Which columns of a file are inputs, which outputs, and the sampling time [s] where a person said it."""

    inputs: tuple[Column, ...]
    outputs: tuple[Column, ...]
    sampling_time: float | None = None


@dataclass(frozen=True, eq=False)
class Draft:
    """A spec as text, with the account of what was seen."""

    spec: str
    account: str


def look(path: Path) -> Survey:
    """The columns of a file.

    Raises:
        InputError: a file that cannot be read or holds no numbers.
    """
    return survey(path)


def assign(found: Survey, inputs: str | None, outputs: str | None, sampling_time: float | None = None) -> Roles | None:
    """Columns by names separated by commas; where nothing is given by what the names say; None if that is open.

    Raises:
        InputError: columns that are not there, twice, constant or the time.
    """
    if inputs is None and outputs is None:
        known = found.roles()
        return None if known is None else Roles(tuple(known[0]), tuple(known[1]), sampling_time)
    if inputs is None or outputs is None:
        return None
    chosen = [[found.find(name) for name in _names(text)] for text in (inputs, outputs)]
    both = [*chosen[0], *chosen[1]]
    if not chosen[1]:
        raise InputError(f"{found.path}: no output is named; give --outputs, a column or several separated by commas.")
    for column in both:
        if both.count(column) > 1:
            raise InputError(f"{found.path}: column '{column.header}' is named twice among inputs and outputs.")
        if column is found.clock.column:
            raise InputError(f"{found.path}: column '{column.header}' is the time; it is no channel.")
    return Roles(tuple(chosen[0]), tuple(chosen[1]), sampling_time)


def question(found: Survey) -> str:
    """What to give where the columns do not say what they are."""
    names = [c.header for c in found.signals]
    some = ", ".join(names[:_LISTED]) + (f" and {len(names) - _LISTED} more" if len(names) > _LISTED else "")
    first = f'"{names[0]}"' if len(names) > 1 else '""'
    return (
        f"{found.path}: the names of the columns do not tell inputs from outputs: {some}. Say both, separated by "
        f'commas, such as --inputs {first} --outputs "{names[-1]}" (--inputs "" for none); columns that are not named '
        "are left out."
    )


def draft(found: Survey, roles: Roles, out: Path) -> Draft:
    """A spec for a file that runs, for the place `out`, and the account.

    Raises:
        InputError: too few rows, or channels without a row where all have a value.
    """
    rows, missing = _extent(roles)
    cut = round(TRAINED * rows)
    cut = cut if rows - cut >= _TESTED else rows
    record = _record(found, roles, cut, missing)
    model = first_model(record)
    if model is None:
        raise InputError(
            f"{found.path}: {len(record)} usable rows are too few for a first model of these channels, or the inputs "
            "are combinations of each other. Give more rows, or fewer inputs."
        )
    named = (_channel_names(roles.inputs), _channel_names(roles.outputs))
    text = _spec(found, roles, out, rows, cut, missing, named, model)
    return Draft(text, _account(found, roles, rows, missing, cut, model))


def write_spec(found: Draft, out: Path, *, force: bool = False) -> None:
    """The spec, once it has been opened with its data as `orthaug fit` would."""
    from orthaug.commands.opening import open_job

    with whole_file(out, force=force) as partial:
        partial.write_text(found.spec, encoding="utf-8")
        if partial.parent == out.resolve().parent and partial != out:
            try:
                open_job(partial)
            except InputError as error:
                told = str(error).removeprefix(f"{partial}: ")
                raise InputError(f"{out}: a spec for these columns would be refused: {told}") from None


def _names(text: str) -> list[str]:
    return [name.strip() for name in text.split(",") if name.strip()]


def _channel_names(columns: Sequence[Column]) -> list[str]:
    return [column.name for column in columns]


def _extent(roles: Roles) -> tuple[int, int]:
    """Rows up to the last value of any channel, and how many of them lack one."""
    columns = [*roles.inputs, *roles.outputs]
    rows = max(column.filled for column in columns)
    there = np.ones(rows, dtype=bool)
    for column in columns:
        own = np.zeros(rows, dtype=bool)
        own[: len(column.values)] = np.isfinite(column.values[:rows])
        there &= own
    return rows, int((~there).sum())


def _record(found: Survey, roles: Roles, cut: int, missing: int) -> Record:
    """The training rows."""
    inputs, outputs = ([Channel(c.name, c.unit, c.header) for c in group] for group in (roles.inputs, roles.outputs))
    options: dict[str, Any] = {"rows": (0, cut), "missing": "skip" if missing or not found.clock.even else "error"}
    options["prepare"] = [STEPS.declare(kind, keys) for kind, keys in _steps(found, roles)]
    if not found.clock.even:
        options["time"] = _time(found, roles)
    return read_record(found.path, inputs=inputs, outputs=outputs, **options)


def _time(found: Survey, roles: Roles) -> str | None:
    """The column of instants in seconds, where there is one that is to be used."""
    clock = found.clock
    return clock.column.header if clock.column is not None and clock.instants and not roles.sampling_time else None


def _steps(found: Survey, roles: Roles) -> list[tuple[str, dict[str, Any]]]:
    """Preparation that the data need: spikes of outputs replaced, uneven instants put onto a grid."""
    steps: list[tuple[str, dict[str, Any]]] = []
    if any(column.spikes for column in roles.outputs):
        threshold = min(column.threshold for column in roles.outputs)
        steps += [("outliers", {"threshold": threshold}), ("fill", {"most": FILLED, "method": "pchip"})]
    if _time(found, roles) and not found.clock.even:
        steps.append(("resample", {"sampling_time": found.clock.step}))
    return steps


def _step(found: Survey, roles: Roles) -> float:
    return roles.sampling_time or found.clock.step or 1.0


def _account(found: Survey, roles: Roles, rows: int, missing: int, cut: int, model: FirstModel) -> str:
    """What was seen, a line each."""
    step = f"{roles.sampling_time:g} s, as given" if roles.sampling_time else str(found.clock)
    if roles.sampling_time is None and found.clock.step is None:
        step += "; 1 s is written: change it"
    lines = [f"{found.path.name}: {rows} rows, {len(found.columns)} columns", f"sampling time: {step}"]
    for kind, columns in (("input", roles.inputs), ("output", roles.outputs)):
        lines += [f"{kind:<7}{as_seen(column, spikes=kind == 'output')}" for column in columns]
    used = {id(c) for c in (*roles.inputs, *roles.outputs, found.clock.column)}
    for column in (c for c in found.columns if id(c) not in used):
        why = column.unusable or ("constant" if column.constant else "not named")
        lines.append(f"left out: {column.header} ({why})")
    for column, delay, order in zip(roles.inputs, model.delays, model.persistence, strict=True):
        lines.append(f"{column.name} excites {_order(order)}; {_delay(delay)}")
    if missing:
        filled = any(kind == "fill" for kind, _ in _steps(found, roles))
        lines.append(f"{_lacking(missing)} and will be left out, with all windows that touch them")
        if filled:
            lines[-1] = f"{_lacking(missing)}: gaps of up to {FILLED} rows are filled, longer ones left out"
    for name, late, seen in zip(_channel_names(roles.inputs), model.orders.nk, model.delays, strict=True):
        if seen is not None and seen != late:
            lines.append(f"the spec takes {name} from lag {late} on, which runs as well or better with as few lags")
    size, errors = model.orders, ", ".join(percent(error, 3) for error in model.free_run)
    told = "one step ahead" if not roles.inputs else "in free run"
    lines.append(f"first physics: linear, {size}{', with a constant' if model.offset else ''}; {told} its error")
    lines[-1] += f" on rows held out is {errors} of the output's standard deviation"
    lines.append("test: " + (f"rows {cut} to {rows}" if cut < rows else "none, for there are few rows"))
    return "\n".join(lines)


def _lacking(rows: int) -> str:
    return f"{counted(rows, 'row')} lack{'s' if rows == 1 else ''} a value"


def _delay(delay: int | None) -> str:
    if delay is None:
        return "no lag of it is significant"
    return f"beside the outputs' past it is first significant at lag {delay}"


def _order(order: int) -> str:
    from orthaug.selection.first_orders import PERSISTENCE

    return f"up to order {order}" + (" or more" if order >= PERSISTENCE else ": few lags can be told apart")


def as_seen(column: Column, *, spikes: bool) -> str:
    """A channel in words: range, and what is odd about it."""
    low, high = float(column.finite.min()), float(column.finite.max())
    text = f"{column.name}" + (f" = column '{column.header}'" if column.header != column.name else "")
    text += f": {low:.4g} to {high:.4g} {column.unit}".rstrip()
    if column.missing:
        text += f"; {counted(column.missing, 'cell')} missing"
    if spikes and column.spikes:
        text += f"; {counted(column.spikes, 'sample')} far from all neighbours, which the spec replaces"
    for value, count in column.limits:
        text += f"; {counted(count, 'row')} at {value:.4g}, perhaps a limit of sensor or actuator"
    if column.quantum is not None:
        text += f"; in steps of {column.quantum:.3g}"
    return text


def _spec(
    found: Survey,
    roles: Roles,
    out: Path,
    rows: int,
    cut: int,
    missing: int,
    named: tuple[list[str], list[str]],
    model: FirstModel,
) -> str:
    """The spec with comments."""
    document = tomlkit.document()
    document.add(tomlkit.comment(f"Written by orthaug init from {found.path.name}. Run: orthaug fit {out.name}"))
    document.add(tomlkit.comment("Every key: orthaug schema keys. What is written here is a start, not a verdict."))
    document.add("data", _data(found, roles, out, rows, cut, missing, named))
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
    training.add(
        tomlkit.comment('focus = "simulation"  # trains on the free run: slower, better where noise is on the sensor')
    )
    document.add("training", training)
    return tomlkit.dumps(document)


def _data(
    found: Survey, roles: Roles, out: Path, rows: int, cut: int, missing: int, named: tuple[list[str], list[str]]
) -> Any:
    file, clock = _relative(found.path, out), found.clock
    data = tomlkit.table()
    time = _time(found, roles)
    if time is not None:
        data.add("time", time)
        data["time"].comment(f"instants in s, {'every' if clock.even else 'mostly every'} {clock.step:g}")
    else:
        data.add("sampling_time", _step(found, roles))
        unknown = clock.step is None and not roles.sampling_time
        data["sampling_time"].comment("s; no column tells it: change it" if unknown else "s")
    for key, names in zip(("inputs", "outputs"), named, strict=True):
        data.add(key, names)
    uneven = time is not None and not clock.even
    if missing or uneven:
        data.add("missing", "skip")
        data["missing"].comment(_lacking(missing) if missing else "nothing is interpolated across gaps")
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
    for kind, keys in _steps(found, roles):
        step = tomlkit.table()
        step.update({"step": kind, **keys})
        steps.append(step)
    if len(steps):
        data.add("prepare", steps)
    return data


def _relative(path: Path, out: Path) -> str:
    """The data file as the spec at `out` names it."""
    try:
        return Path(os.path.relpath(path.resolve(), out.resolve().parent)).as_posix()
    except ValueError:  # on another drive
        return path.resolve().as_posix()


def _baseline(named: tuple[list[str], list[str]], model: FirstModel) -> Any:
    inputs, outputs = named
    terms, orders = [], model.orders
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
            if own:
                term.add("output", output)
            terms.append(term)
    array = tomlkit.aot()
    for term in terms:
        array.append(term)
    baseline = tomlkit.table(is_super_table=True)
    baseline.add("terms", array)
    return baseline
