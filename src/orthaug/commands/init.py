"""A first spec for a data file: `orthaug init` describes the file, and writes the spec."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool

from orthaug._base.errors import InputError, MissingSampleError
from orthaug._base.folders import whole_file
from orthaug._base.lines import first_words, join_words, percent, plural
from orthaug.analysis.closed_loop import Feedback, feedback_in
from orthaug.commands.draft_spec import (
    FILLED,
    Roles,
    channel_names,
    gap_text,
    row_ranges,
    spec_text,
    steps_of,
    time_of,
    wrapped_text,
)
from orthaug.data.channels import Channel
from orthaug.data.columns import Column
from orthaug.data.gaps import filled_record, held_rows, regular_rows
from orthaug.data.headers import is_time
from orthaug.data.preparation import STEPS
from orthaug.data.readers import read_record
from orthaug.data.record import Record
from orthaug.data.survey import Survey, survey
from orthaug.data.wild import data_warnings
from orthaug.physics.systems import System
from orthaug.selection.first_orders import (
    FITTED,
    LOOKED_AT,
    MOST_DELAY,
    FirstModel,
    first_model,
    free_run_errors,
    restarted_error,
)
from orthaug.selection.roles import guess_roles

Names = str | Sequence[str]  # columns, several in a text separated by commas
TRAINED = 0.75  # share of the rows; the rest is a test
_TESTED = 30  # rows of a test at least
_POWER = 0.95  # of an output, within its band
_CLEARLY_LESS = 0.7  # of the error of a free run: with it fewer rows are taken
_LOST = 10.0  # error over the output's deviation, of a free run that leaves it
_SHORTEST_RUN = 5  # rows after which runs of fewer rows start again
_CLOSE = 0.05  # error over the output's deviation: no thinning is looked for below it
_LISTED = 12  # columns in a message


@dataclass(frozen=True, eq=False)
class Draft:
    """A spec as text, with a description of the file."""

    spec: str
    account: str


def look(path: Path) -> Survey:
    """Return the columns of a file.

    Raises:
        InputError: a file that cannot be read or holds no numbers.
    """
    return survey(path)


def assign(
    found: Survey,
    inputs: Names | None,
    outputs: Names | None,
    sampling_time: float | None = None,
) -> Roles | None:
    """Return the columns by name; where none are given, by the meaning of their names.

    Where the names leave that open, by what predicts what in the data; None if that is open, too.

    Raises:
        InputError: columns that are not there, twice, constant or the time.
    """
    if inputs is None and outputs is None:
        known = found.roles()
        if known is not None:
            return Roles(tuple(known[0]), tuple(known[1]), sampling_time)
        guessed = None if found.contradicted else guess_roles(found.signals)
        if guessed is None:
            return None
        return Roles(guessed.inputs, guessed.outputs, sampling_time, str(guessed))
    named = {"input": inputs, "output": outputs}
    chosen = [
        None if n is None else columns_of(found, n, kind, sampling_time)
        for kind, n in named.items()
    ]
    if outputs is not None and not chosen[1]:
        raise InputError(
            f"{found.path}: no output is named; give --outputs, a column or several separated "
            "by commas."
        )
    both = [column for group in chosen for column in group or ()]
    for column in both:
        if both.count(column) > 1:
            raise InputError(
                f"{found.path}: column '{column.header}' is named twice among inputs and outputs."
            )
    if chosen[0] is None or chosen[1] is None:
        return None
    if not found.same_lengths(both):
        listing = ", ".join(f"'{c.header}' {c.filled}" for c in both)
        raise InputError(
            f"{found.path}: the columns have unequal lengths: {listing} rows. Name those of "
            "one run."
        )
    return Roles(tuple(chosen[0]), tuple(chosen[1]), sampling_time)


def columns_of(
    found: Survey, names: Names, kind: str, sampling_time: float | None = None
) -> list[Column]:
    """Return the columns of these names; a text may hold several, separated by commas.

    Args:
        kind: "input" or "output", what they are to be.
        sampling_time: in s, where a person gave it.

    Raises:
        InputError: a column that is not there, has no numbers that vary, or is the time.
    """
    headers = {column.header for column in found.columns}
    columns = []
    for text in (names,) if isinstance(names, str) else names:
        parts = (part.strip() for part in ((text,) if text.strip() in headers else text.split(",")))
        columns += [found.find(name) for name in parts if name]
    for column in columns:
        _check_no_time(found, column, kind, sampling_time)
    return columns


def _check_no_time(found: Survey, column: Column, kind: str, sampling_time: float | None) -> None:
    """Raise InputError where the time is named as a channel.

    An input may rise as evenly where the time is known otherwise.
    """
    place, refused = f"{found.path}: column '{column.header}'", found.looks_like_time(column)
    if column is found.clock.column and found.clock.by_name:
        raise InputError(f"{place} is the time; it is no channel.")
    if column is found.clock.column and (kind == "output" or sampling_time is None):
        remedy = (
            "it is no output"
            if kind == "output"
            else "if it is an input, give --sampling-time, the step in s"
        )
        raise InputError(
            f"{place} rises by {found.clock.step:g} s in each row, as time does; {remedy}."
        )
    if refused is not None and (kind == "output" or is_time(column.titled)):
        raise InputError(
            f"{place} {refused.reason}; it is no "
            f"{'channel' if is_time(column.titled) else 'output'}."
        )


def question(found: Survey, inputs: Names | None = None, outputs: Names | None = None) -> str:
    """Return what the user has to give where the columns do not show their roles.

    `inputs` and `outputs` are what was given.

    Raises:
        InputError: no column could be a channel, or none is left for an output.
    """
    kinds = {"input": inputs, "output": outputs}
    given = {
        id(c): c for kind, names in kinds.items() for c in columns_of(found, names or "", kind)
    }
    free = [c for c in found.signals if id(c) not in given]
    if not found.signals or (outputs is None and not free):
        raise InputError(f"{found.path}: {_no_output_reason(found, _join(inputs))}")
    some = first_words([c.header for c in found.signals], _LISTED)
    output = free.pop() if outputs is None else None
    rows = next((c.filled for c in (output, *given.values()) if c is not None), 0)
    alike = [c.header for c in free if c.filled == rows] or [c.header for c in free]
    named = ",".join(alike[:_LISTED]) if outputs is not None else alike[0] if alike else ""
    into = named if inputs is None else _join(inputs)
    proposed = (
        f'--inputs "{into}" --outputs "{_join(outputs) if output is None else output.header}"'
    )
    others, clock = list_unused(found, [*found.signals]), found.clock.column
    apart = f" No channels: {others}." if others else ""
    if inputs is None and outputs is None and not free:
        taken = f" {clock.header} is taken for the time." if clock else ""
        return (
            f"{found.path}: only {some} varies, so there is no pair of an input and an output."
            f'{taken}{apart} Give both with --inputs and --outputs, or --inputs "" '
            f'--outputs "{some}" where nothing drives it.'
        )
    said = "the names of the columns do not show which are inputs and which outputs"
    if inputs is not None or outputs is not None:
        said = f"only {'inputs' if outputs is None else 'outputs'} are named"
    none = ' (--inputs "" for none)' if inputs is None and named else ""
    return (
        f"{found.path}: {said}: {some}. Give both, separated by commas, such as "
        f"{proposed}{none}; columns that are not named are left out.{apart}"
    )


def _join(names: Names | None) -> str | None:
    """Return the names as a person would write them."""
    return names if names is None or isinstance(names, str) else ",".join(names)


def _no_output_reason(found: Survey, inputs: str | None) -> str:
    """Return the reason why no column is left for an output."""
    rows = plural(max(column.filled for column in found.columns), "row")
    others = list_unused(found, [*found.signals])
    if not found.signals:
        return (
            f"no column can be a channel, {rows}: {others}. A first model needs an output that "
            "varies over some dozens of rows."
        )
    text = (
        f"every possible channel is already an input ({inputs}), so no column is left for an output"
    )
    return f"{text}; left out: {others}." if others else f"{text}."


def list_unused(found: Survey, used: Sequence[Column]) -> str:
    """Return a list of the unused columns, except the time, with the reasons."""
    apart = {id(c) for c in (*used, found.clock.column)}
    others = [f"{c.header} ({found.why_not(c)})" for c in found.columns if id(c) not in apart]
    return first_words(others, _LISTED)


def draft(found: Survey, roles: Roles, out: Path, system: System | None = None) -> Draft:
    """Return a spec that runs on a file, for the place `out`, and a description of the file.

    Its physics is the system, with initial values from the file, or else linear lags.

    Raises:
        InputError: too few rows, or channels without a row where all have a value.
    """
    found = found.beside([*roles.inputs, *roles.outputs])
    roles = _with_sampled_rows(roles, motion=system is not None)
    rows, missing = _extent(roles)
    cut = round(TRAINED * (rows - roles.first) / roles.every) * roles.every + roles.first
    cut = cut if rows - cut >= _TESTED * roles.every else rows
    record, lost = _record(found, roles, (roles.first, cut), missing)
    fed = feedback_in(record)
    model = first_model(record, direct=not fed)
    if model is None:
        raise InputError(
            f"{found.path}: {len(record)} usable rows are too few for a first model of these "
            "channels, or the inputs are combinations of each other. Give more rows, or fewer "
            "inputs."
        )
    whole, measured = model, record
    # A low-pass of zero phase lets fed-back inputs answer disturbances before these occur
    if system is None and not missing and not fed:
        roles, record, model = _thinned(found, roles, cut, rows, record, model)
    named = (channel_names(roles.inputs), channel_names(roles.outputs))
    wild = (
        f"{plural(lost, 'training row')} in longer gaps or runs of wild samples "
        f"{'is' if lost == 1 else 'are'} left out"
    )
    gaps = gap_text(missing) if missing else wild if lost else ""
    motion = None if system is None else system.motion(record)
    errors = None
    if cut < rows:
        with suppress(InputError):  # the last rows may lack samples, and then have no score
            test, _ = _record(found, roles, (cut, rows), missing)
            errors = free_run_errors(record, test, model)
    text = spec_text(
        found, roles, out, rows, cut, gaps, named, model, motion, [one.name for one in fed]
    )
    return Draft(
        text,
        _account(
            found,
            roles,
            rows,
            missing,
            cut,
            model,
            errors,
            wild if lost and not missing else "",
            [
                *_thinning(roles, whole, model),
                *_feedback(fed),
                *(w.text for w in data_warnings(measured)),
            ],
        ),
    )


def _thinned(
    found: Survey,
    roles: Roles,
    cut: int,
    rows: int,
    record: Record,
    model: FirstModel,
) -> tuple[Roles, Record, FirstModel]:
    """Return the roles, the record and its model with fewer rows where that runs clearly better.

    Of outputs that move slowly beside the sampling, neighbouring lags hardly differ: what least
    squares find in them one step ahead is noise.
    """
    best = roles, record, model
    error, restarted = float(np.mean(model.free_run)), model.restarted
    factor, rank = _slowness(record), (True, np.inf)
    for by in sorted({factor // 4, factor // 2, factor}):
        if by < 2 or rows - cut < _TESTED * by or error < _CLOSE:
            continue
        fewer = replace(roles, thinned=by)
        with suppress(InputError):
            own = _record(found, fewer, (roles.first, cut), 0)[0]
            other = first_model(own, direct=True)
            if other is None or not record.inputs or (other.restarted and not restarted):
                continue
            least = float(np.mean(other.free_run))
            if restarted is not None:  # as long a time after which runs start again
                least = restarted_error(own, other, max(restarted // by, _SHORTEST_RUN))
            placed = bool(other.restarted), float(np.mean(other.free_run))
            if least < _CLEARLY_LESS * error and placed < rank:
                best, rank = (fewer, own, other), placed
    return best


def _slowness(record: Record) -> int:
    """Return the factor by which rows may be thinned: 20 times the band of the outputs is left.

    The band has 95 % of the power of each output.
    """
    longest = max(record.experiments, key=len)
    n, bands = len(longest), []
    for y in longest.outputs.T:
        power = np.abs(np.fft.rfft((y - y.mean()) * np.hanning(n))) ** 2
        share = np.cumsum(power) / max(float(power.sum()), 1e-300)
        bands.append(max(int(np.searchsorted(share, _POWER)), 1) / n)
    return int(1 / (20 * max(bands)))


def _feedback(found: Sequence[Feedback]) -> list[str]:
    """Return a line on inputs that follow past outputs; none where no input does."""
    if not found:
        return []
    names = join_words([one.name for one in found])
    return [
        f"past outputs predict {names}: the data were probably recorded under feedback, which "
        "`orthaug check` explains. No input acts in its own row, for that is the controller's way"
    ]


def _thinning(roles: Roles, whole: FirstModel, model: FirstModel) -> list[str]:
    """Return a line on why rows are thinned; none where they are not."""
    if roles.thinned == 1:
        return []
    slow = f"the outputs move slowly beside the sampling: rows are thinned by {roles.thinned}"
    if whole.restarted:
        return [f"{slow} (decimate), with which free runs of the same time are clearly better"]
    errors = [percent(float(np.mean(one.free_run)), 3) for one in (model, whole)]
    return [
        f"{slow} (decimate), with which the error of the free run is {errors[0]} instead of "
        f"{errors[1]} on the last {percent(1 - FITTED)} of the training rows, fitted to those "
        "before"
    ]


def write_spec(found: Draft, out: Path, *, force: bool = False) -> None:
    """Write the spec, after opening it with its data as `orthaug fit` does."""
    from orthaug.commands.opening import open_job

    with whole_file(out, force=force) as partial:
        partial.write_text(found.spec, encoding="utf-8")
        if partial.parent == out.resolve().parent and partial != out:
            try:
                open_job(partial)
            except InputError as error:
                reason = str(error).removeprefix(f"{partial}: ")
                raise InputError(
                    f"{out}: a spec for these columns would not be accepted: {reason}"
                ) from None


def _extent(roles: Roles) -> tuple[int, int]:
    """Return the number of rows up to the last value of any channel, and of those that lack one."""
    columns = [*roles.inputs, *roles.outputs]
    rows = max(column.filled for column in columns)
    return rows, int((~_complete(columns, rows))[roles.first :: roles.every].sum())


def _complete(columns: Sequence[Column], rows: int) -> Bool[np.ndarray, "rows"]:
    """Return the rows in which every column has a value."""
    there = np.ones(rows, dtype=bool)
    for column in columns:
        own = np.zeros(rows, dtype=bool)
        own[: len(column.values)] = np.isfinite(column.values[:rows])
        there &= own
    return there


def _with_sampled_rows(roles: Roles, *, motion: bool) -> Roles:
    """Return the roles with the rows in use, where outputs lack values beside complete inputs.

    Equations of motion run through all of them. Lags need rows with all outputs: every n-th, where
    the slowest sensor gives a value in these.
    """
    rows = max(column.filled for column in (*roles.inputs, *roles.outputs))
    there = _complete(roles.outputs, rows)
    sampled = [held_rows(column.values[:rows]) for column in roles.outputs]
    held = tuple(c.name for c, own in zip(roles.outputs, sampled, strict=True) if own is not None)
    if there.all() and not held:
        return roles
    if motion:
        keeps = bool(_complete(roles.inputs, rows).all())
        return replace(roles, keeps=keeps, held=held if keeps else ())
    for own in sampled:
        if own is not None:
            there &= np.isin(np.arange(rows), np.arange(own.start, rows, own.step))
    kept = regular_rows(there)
    return roles if kept is None else replace(roles, every=kept.step, first=kept.start)


def _record(found: Survey, roles: Roles, rows: tuple[int, int], missing: int) -> tuple[Record, int]:
    """Return a range of rows, and how many are left out because a sample is missing."""
    inputs, outputs = (
        [Channel(c.name, c.unit, c.header) for c in group]
        for group in (roles.inputs, roles.outputs)
    )
    options: dict[str, Any] = {
        "rows": row_ranges(found, *rows),
        "missing": "skip" if missing or not found.clock.even or roles.every > 1 else "error",
        "every": roles.every,
    }
    if roles.keeps:
        options["missing"] = "keep"
    apart = found.experiment_column([*roles.inputs, *roles.outputs])
    options["experiment"] = None if apart is None else apart.header
    options["prepare"] = [STEPS.declare(kind, keys) for kind, keys in steps_of(found, roles)]
    if not found.clock.even:
        options["time"] = time_of(found, roles)
    try:
        record = read_record(found.path, inputs=inputs, outputs=outputs, **options)
        record = filled_record(record)  # a motion runs through gaps
    except MissingSampleError:  # more samples in a row were wild than a gap is filled over
        record = read_record(
            found.path, inputs=inputs, outputs=outputs, **{**options, "missing": "skip"}
        )
    return record, record.missing


def _account(
    found: Survey,
    roles: Roles,
    rows: int,
    missing: int,
    cut: int,
    model: FirstModel,
    errors: Sequence[float] | None,
    wild: str,
    notes: Sequence[str] = (),
) -> str:
    """Return the description of the file, a line for each finding."""
    step = f"{roles.sampling_time:g} s, as given" if roles.sampling_time else str(found.clock)
    if roles.sampling_time is None and found.clock.step is None:
        step += "; the spec has 1 s: change it"
    horizon = f"; {found.note}" if found.note else ""
    lines = [
        f"{found.path.name}: {rows} rows, {len(found.columns)} columns{horizon}",
        f"sampling time: {step}",
    ]
    if found.clock.restarts:
        where = first_words([str(row) for row in found.clock.restarts], _LISTED)
        lines.append(f"the time begins anew in row {where}: the rows between are experiments")
    for kind, columns in (("input", roles.inputs), ("output", roles.outputs)):
        lines += [f"{kind:<7}{as_seen(column, spikes=kind == 'output')}" for column in columns]
    used = {id(c) for c in (*roles.inputs, *roles.outputs, found.clock.column)}
    doubtful = [one for one in found.clock.refused if one.signal or id(one.column) in used]
    if roles.reason:
        lines.append(
            f"inputs and outputs are guessed: {roles.reason}; where that is wrong, choose them "
            "(--inputs, --outputs)"
        )
    lines[2:2] = [f"not the time: column '{one.column.header}' {one.reason}" for one in doubtful]
    apart = found.experiment_column([*roles.inputs, *roles.outputs])
    if apart is not None:
        used.add(id(apart))
        count = len(np.unique(apart.finite))
        lines.append(f"{apart.header} numbers {count} experiments; their rows are read apart")
    if roles.sampling_time is None:
        used.add(id(found.clock.faulty))  # the line of the sampling time names its fault
    for column in (c for c in found.columns if id(c) not in used):
        lines.append(f"left out: {column.header} ({found.why_not(column)})")
    for column, delay, order, unsure in zip(
        roles.inputs, model.delays, model.persistence, model.undetermined, strict=True
    ):
        excites = f"excites {_order(order)}; {_delay(delay, unsure, order)}"
        if column.one_way:
            excites = (
                f"only {column.one_way} from row to row: such rows show a static relation, and "
                "hardly how it settles. For a static one write terms of lag 0, without past outputs"
            )
        lines.append(f"{column.name} {excites}")
    if roles.every > 1:
        lines.append(
            f"one row in {roles.every} has a value of every output: these rows are used. A "
            "[motion] can run through the others"
        )
    lines += wrapped_text(steps_of(found, roles))
    if roles.held:
        names = join_words(roles.held)
        lines.append(
            f"{names}: a slower sensor, whose last value is held: repeats are no samples, and the "
            "motion runs through them"
        )
    if missing and roles.keeps:
        lines.append(f"{gap_text(missing)} of an output and stay: the motion runs through them")
    elif missing:
        kinds = [kind for kind, _ in steps_of(found, roles)]
        filled = "fill" in kinds
        lines.append(f"{gap_text(missing)} and will be left out, with all windows that touch them")
        if filled:
            lines[-1] = (
                f"{gap_text(missing)}: gaps of up to {FILLED} rows are filled, longer ones left out"
            )
        elif "resample" in kinds:
            lines[-1] = f"{gap_text(missing)}: resampling interpolates what is missing shortly"
    lines += [wild] if wild else []
    lines += notes
    for name, late, seen in zip(
        channel_names(roles.inputs), model.orders.nk, model.delays, strict=True
    ):
        if seen is not None and seen != late:
            lines.append(
                f"the spec takes {name} from lag {late} on, which runs clearly better on the last "
                f"{percent(1 - FITTED)} of the training rows, fitted to those before"
            )
    horizon = "one step ahead" if not roles.inputs else "in free run"
    names = channel_names(roles.outputs)
    others = {names[i]: [names[j] for to, j in model.across if to == i] for i in dict(model.across)}
    past = "".join(
        f", {name} with the past of {join_words(own)} too" for name, own in others.items()
    )
    physics = f"linear, {model.orders}{', with a constant' if model.offset else ''}{past}"
    if errors is None:
        errors = model.free_run
        where = f"the last {percent(1 - FITTED)} of rows 0 to {cut}, fitted to those before"
    else:
        where = f"the test rows {cut} to {rows}, fitted to rows 0 to {cut} one step ahead"
    shown = ", ".join(percent(error, 3) for error in errors)
    lines.append(
        f"first physics: {physics}; its free run diverges: the error is over {_LOST:g} times the "
        f"output's standard deviation on {where}"
        if max(errors) > _LOST
        else f"first physics: {physics}; its error {horizon} is {shown} of the output's standard "
        f"deviation on {where}"
    )
    own = model.free_run if roles.inputs and model.restarted is None else ()
    if own and max(own) < _CLEARLY_LESS * max(errors):
        shown = ", ".join(percent(error, 3) for error in own)
        lines.append(
            f"fitted to the free run, as `orthaug fit` does where that is better, its error "
            f"is {shown} on the last {percent(1 - FITTED)} of rows 0 to {cut}"
        )
    if model.restarted is not None:
        shown = ", ".join(percent(error, 3) for error in model.free_run)
        lines.append(
            "longer runs do not follow the data, so the orders come from runs of "
            f"{model.restarted} rows, each from measured outputs on. The error of such "
            f"runs is {shown} on the last {percent(1 - FITTED)} of the training rows"
        )
    if cut - missing > LOOKED_AT:
        lines.append(
            f"delays and orders are estimated from {LOOKED_AT} of these rows, in windows "
            "spread over them"
        )
    lines.append(
        "test: " + (f"rows {cut} to {rows}" if cut < rows else "none, because there are few rows")
    )
    return "\n".join(lines)


def _delay(delay: int | None, undetermined: bool, order: int) -> str:
    from orthaug.selection.first_orders import PERSISTENCE

    if undetermined:
        return (
            "several lags of it act together, and the data do not determine the first: a dead "
            "time is not seen"
        )
    if delay is None:
        if order < PERSISTENCE:
            return (
                "no lag of it is significant by itself, for its neighbouring lags are alike: the "
                "input may act nevertheless"
            )
        return "no lag of it is significant"
    last = (
        ", the largest that is tried: the true one may be later, or earlier where it acts weakly"
        if delay >= MOST_DELAY
        else ""
    )
    return f"beside the outputs' past it is first significant at lag {delay}{last}"


def _order(order: int) -> str:
    from orthaug.selection.first_orders import PERSISTENCE

    return f"up to order {order}" + (
        " or more" if order >= PERSISTENCE else ": few lags can be distinguished"
    )


def as_seen(column: Column, *, spikes: bool) -> str:
    """Return a channel in words: its range, and what is unusual about it."""
    low, high = float(column.finite.min()), float(column.finite.max())
    text = f"{column.name}" + (
        f" = column '{column.header}'" if column.header != column.name else ""
    )
    text += f": {low:.4g} to {high:.4g} {column.unit}".rstrip()
    if column.missing:
        text += f"; {plural(column.missing, 'cell')} missing"
    if spikes and column.spikes:
        text += (
            f"; {plural(column.spikes, 'sample')} far from all neighbours, which the spec replaces"
        )
    for value, count in column.limits:
        text += f"; {plural(count, 'row')} at {value:.4g}, perhaps a limit of sensor or actuator"
    if column.quantum is not None:
        moves = (
            f", while it moves by {column.movement:.2g} from row to row"
            if column.quantum > column.movement and not column.switched
            else ""
        )
        text += f"; in steps of {column.quantum:.3g}{moves}"
    return text
