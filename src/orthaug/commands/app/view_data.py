"""The part of the page for data: a file, its columns, its curves, and the steps that clean it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import MISSING, fields
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any

from nicegui import ui

from orthaug._base.errors import InputError
from orthaug._base.lines import with_unit
from orthaug.commands.app import spec_text
from orthaug.commands.app.session import Session
from orthaug.commands.app.widgets import (
    button,
    card,
    choice,
    curves_figure,
    field,
    label_widget,
    note,
    plot,
    redrawn,
    refuse,
    sentence,
    table,
    text,
)
from orthaug.data.preparation import STEPS
from orthaug.data.record import check_step

_STEPS = ("data", "prepare")
_LISTED = 40  # columns
# Beginnings of lines on columns, which the page shows elsewhere
_COLUMNS = ("input ", "output ")
_DRAFT = ("first physics", "test:")  # of lines on a spec for the file
_OFFERED = 5  # specs of earlier work
_USES = {"": "leave out", "input": "input", "output": "output"}
_SUMMARIES = {
    "detrend": "take out mean or trend",
    "lowpass": "low-pass filter",
    "highpass": "high-pass filter",
    "decimate": "keep each n-th row, filtered",
    "resample": "put onto an even grid",
    "outliers": "mark outliers (Hampel)",
    "repeats": "mark repeated samples",
    "limits": "mark samples at a limit",
    "fill": "fill short gaps",
    "shift": "shift an input in time",
}
_FIRST = {"factor": 2, "samples": 1}  # what a step begins with where it has no default
_LABELS = {
    "cutoff": "cutoff in Hz",
    "sampling_time": "step in s",
    "most": "rows at most",
    "window": "rows each side",
}
_CUTOFF = 0.1  # the first cutoff, as a share of the sampling frequency
_KNOWN = "CSV, TSV, TXT, DAT, Parquet, Excel, MATLAB, NumPy or HDF5; it stays on this machine"
_DROP = """
<label class="drop" id="drop">
  <input type="file" id="dropped" class="unseen" accept="{endings}">
  <span class="drop-title">Drop a data file here, or choose one</span>
  <span class="hint" id="drop-message" role="status">{message}</span>
  <progress id="drop-bar" max="1" value="0" hidden aria-label="file taken in"></progress>
</label>
"""


class DataView:
    """The view of a session's data."""

    def __init__(self, session: Session) -> None:
        self.session = session
        self.uses: dict[str, str] = {}
        self.step = ""
        self.kind = next(iter(STEPS))
        self._curves: Any = None
        self._apart = False
        self._drawn: tuple[Any, Any, bool] = (None, None, False)

    def draw(self) -> None:
        from orthaug.data.tables import KNOWN

        with ui.element("div").classes("columns wide-right"):
            with ui.element("div").classes("stack"):
                with card("Data file"):
                    ui.html(_DROP.format(endings=",".join(KNOWN), message=_KNOWN), sanitize=False)
                    with ui.element("div").classes("fields"):
                        self.path = ui.input("or its path on this machine").props(
                            "outlined dense stack-label"
                        )
                        self.path.classes("grow").on("keydown.enter", self.name_file)
                        button("Open", self.name_file)
                    self.status = ui.element("div")
                self.columns = card(
                    "Channels", "Choose what each column is; the spec starts from this choice."
                )
                self.cleaning = card(
                    "Preparation",
                    "These steps are applied to every part of the data, in this order.",
                )
                with self.columns:
                    self.column_rows = ui.element("div")
                    self.unfit = ui.element("div")
                with self.cleaning:
                    self.step_rows = ui.element("div")
                    self.refusal = ui.element("div")
            with card("Curves", classes="sticky"):
                self.curves = ui.element("div")
        self.follow_data()
        self.follow_spec("")

    def name_file(self) -> None:
        given = (self.path.value or "").strip().strip("\"'")
        if given:
            self.session.open_file(Path(given).expanduser().absolute())

    def follow_data(self) -> None:
        """Draw what was found in the file."""
        session, found = self.session, self.session.found
        self._draw_status()
        self.columns.set_visibility(found is not None)
        state = (session.data, found, bool(session.spec))
        if found is not None and any(a is not b for a, b in zip(state, self._drawn, strict=True)):
            self._take_uses(found)
            self._drawn = state
            self._draw_columns(found)
        with redrawn(self.unfit):
            if session.unfit:
                note(sentence(session.unfit), "bad")
        self.follow_check()

    def _draw_status(self) -> None:
        session, found = self.session, self.session.found
        self._apart = session.apart
        with redrawn(self.status):
            if session.looking:
                note(session.looking, "busy")
            elif session.trouble:
                note(session.trouble, "bad")
            elif found is not None and session.data is not None:
                lines = found["account"].splitlines() or [
                    f"{session.data.name}: {found['rows']} rows"
                ]
                text(lines[0], "p", "strong")
                with ui.element("ul").classes("account"):
                    untold = (
                        _COLUMNS
                        if session.data in self._training_files() or not session.spec
                        else (*_COLUMNS, *_DRAFT)
                    )
                    for line in [one for one in lines[1:] if not one.startswith(untold)]:
                        text(line, "li")
                if self._apart:
                    self._offer_test(found)
            elif not session.spec:
                self._offer_starts()

    def _offer_starts(self) -> None:
        """Offer the example, and earlier work."""
        button("Try it with a mass, spring and damper", self.session.try_example)
        if kept := spec_text.earlier()[:_OFFERED]:
            text("Or continue with an earlier spec:", "p", "hint")
        for place in kept:
            when = datetime.fromtimestamp(place.stat().st_mtime)
            label = f"{spec_text.kept_title(place)}, {when:%Y-%m-%d %H:%M}"
            button(label, partial(self.session.open_spec, place, kept=True), classes="wide")

    def _offer_test(self, found: Mapping[str, Any]) -> None:
        """Offer to use a file that the spec does not name as a test."""
        message, lacking = "The spec is kept as it is", self._missing_columns(found)
        if trained := self._training_files():
            message += f"; it trains on {', '.join(file.name for file in trained)}"
        if lacking:
            message += f". This file has no column {', '.join(lacking)}, which the spec reads"
        note(f"{message}. Use this file as a test of it, or start a new spec below.", "care")
        button("Use it as a test", self.session.add_test, main=not lacking)

    def _training_files(self) -> list[Path]:
        """Return the files that the spec trains on."""
        train = spec_text.section(self.session.content(), "data", "train")
        return [self.session.folder / file for file in spec_text.names(train, "files")]

    def _missing_columns(self, found: Mapping[str, Any]) -> list[str]:
        """Return the columns that the spec reads and the file lacks."""
        heads = {column["header"] for column in found["columns"]}
        return [
            column for column in spec_text.columns(self.session.content()) if column not in heads
        ]

    def _of_spec(self, found: Mapping[str, Any]) -> dict[str, str]:
        """Return the use of each column in the spec.

        Empty without a spec, or where the file lacks one of its columns.
        """
        return {} if self._missing_columns(found) else spec_text.columns(self.session.content())

    def _take_uses(self, found: Mapping[str, Any]) -> None:
        """Set the use of each column: from the spec, or as chosen, or as the file suggests."""
        data, before, _ = self._drawn
        if found is before:
            return
        if data is not self.session.data:
            self.step = ""
        inputs, outputs = found.get("inputs"), found.get("outputs")
        self.uses = {
            column["header"]: column["kind"] for column in found["columns"] if column["usable"]
        }
        if of_spec := self._of_spec(found):
            self.uses = {h: of_spec.get(h, "") for h in self.uses}
        elif inputs is not None and outputs is not None:
            self.uses = {
                h: "input" if h in inputs else "output" if h in outputs else "" for h in self.uses
            }

    def _draw_columns(self, found: Mapping[str, Any]) -> None:
        usable = [column for column in found["columns"] if column["usable"]]
        with redrawn(self.column_rows):
            for column in usable[:_LISTED]:
                with ui.element("div").classes("entry"):
                    with ui.element("div").classes("grow"):
                        text(column["header"], "p", "strong")
                        text(column["description"], "p", "hint")
                    head = column["header"]
                    choice(
                        f"use of {head}",
                        _USES,
                        self.uses[head],
                        partial(self.uses.__setitem__, head),
                        "bare",
                    )
            if found["timed"]:
                text(found["timed"], "p", "hint")
            left = [c for c in found["columns"] if not c["usable"] and not c["timed"]]
            if left:
                text(
                    "Not usable: "
                    + ", ".join(f"{c['header']} ({c['description']})" for c in left[:_LISTED]),
                    "p",
                    "hint",
                )
            if not usable:
                note(
                    "No column of this file is a signal that changes: there is nothing to fit.",
                    "bad",
                )
                return
            if found["spec"] is None and not self._of_spec(found):
                note(found["open"] or _proposal(found), "care")
            with ui.element("div").classes("fields"):
                declared = spec_text.section(self.session.content(), "data").get("sampling_time")
                step = spec_text.field_text(declared if found["step"] is None else found["step"])
                label = "sampling time in s"
                self.step_field = field(
                    label,
                    self.step,
                    partial(setattr, self, "step"),
                    classes="medium",
                    hint=step or "1",
                )
                first = found["spec"] is None and not self.session.spec
                begin = button(
                    f"Begin {'' if first else 'anew '}with these channels", self.choose, main=first
                )
                begin.props("data-place=begin")

    def choose(self) -> None:
        chosen = {
            kind: [h for h, use in self.uses.items() if use == kind] for kind in ("input", "output")
        }
        try:
            step = _seconds(self.step)
        except InputError as error:
            refuse(self.step_field, sentence(str(error)))
            return
        refuse(self.step_field, "")
        if not chosen["output"]:
            ui.notify("Choose at least one output.", type="warning")
            return
        self.session.choose(chosen["input"], chosen["output"], step)

    def follow_spec(self, author: str) -> None:
        """Draw the steps of preparation in the spec, and whether it names the file looked at."""
        if self.session.apart != self._apart:
            self._draw_status()
        if author == "steps":
            return
        self.cleaning.set_visibility(bool(self.session.spec.strip()))
        try:
            steps = spec_text.rows_of(self.session.spec, _STEPS)
        except InputError:
            return
        with redrawn(self.step_rows):
            for i, step in enumerate(steps):
                self._draw_step(i, step)
            if not steps:
                text("None yet.", "p", "hint")
            options = {kind: f"{kind}: {_SUMMARIES.get(kind, kind)}" for kind in STEPS}
            with ui.element("div").classes("fields"):
                choice("step to add", options, self.kind, partial(setattr, self, "kind"), "bare")
                button("Add", self._add)

    def _draw_step(self, index: int, step: Mapping[str, Any]) -> None:
        kind = str(step.get("step"))
        with label_widget(
            ui.element("div").classes("entry step").props("role=group"), f"step {index + 1}"
        ):
            with ui.element("div").classes("grow"):
                text(f"{index + 1}. {_SUMMARIES.get(kind, kind)}", "p", "strong")
                with ui.element("div").classes("fields"):
                    for own in fields(STEPS[kind]) if kind in STEPS else ():
                        usual = (
                            "all" if own.name == "channels" else spec_text.field_text(own.default)
                        )
                        field(
                            _LABELS.get(own.name, own.name),
                            spec_text.field_text(step.get(own.name)),
                            partial(
                                self.session.edit,
                                "steps",
                                spec_text.with_field,
                                _STEPS,
                                index,
                                own.name,
                            ),
                            classes="short",
                            hint="" if own.default is MISSING else usual,
                        )
            remove = partial(self.session.edit, "more steps", spec_text.without_row, _STEPS, index)
            label_widget(button("Remove", remove), f"Remove step {index + 1}")

    def _add(self) -> None:
        kind = self.kind
        needed = [own.name for own in fields(STEPS[kind]) if own.default is MISSING]
        first: dict[str, Any] = {name: _FIRST[name] for name in needed if name in _FIRST}
        if "cutoff" in needed:
            step = (self.session.checked or self.session.found or {}).get("step") or 1.0
            first["cutoff"] = float(f"{_CUTOFF / step:.2g}")
        if "channel" in needed:
            data = spec_text.section(self.session.content(), "data")
            first["channel"] = next(iter(spec_text.names(data, "inputs")), "")
        self.session.edit("more steps", spec_text.with_row, _STEPS, {"step": kind, **first})

    def _whole_file(self) -> tuple[str, Mapping[str, Any]]:
        """Return a file and its curves: of the checked training data or the file looked at."""
        session, checked = self.session, self.session.checked
        if checked is None:
            if session.found is None or session.data is None:
                return "", {}
            return session.data.name, session.found["curves"]
        trained = [Path(file) for file in checked["files"]]
        place = next((place for place in (session.data, *session.raw) if place in trained), None)
        return ("", {}) if place is None else (place.name, session.raw.get(place, {}))

    def follow_check(self) -> None:
        """Draw the curves of the file, and of the training data after preparation.

        Where they cannot be drawn, it shows the reason.
        """
        session, checked = self.session, self.session.checked
        with redrawn(self.refusal):
            if session.stale:
                note(sentence(session.refused), "bad")
        prepared = {} if checked is None else checked["curves"]
        whole, raw = self._whole_file()
        cleaned = bool(checked and checked["prepared"])
        step = spec_text.section(session.content(), "data").get("sampling_time")
        step = step if isinstance(step, int | float) else 1.0
        rows = []
        shown = [curve["column"] for curve in prepared.values()] or list(raw)
        for name in shown:
            drawn = []
            if name in raw:
                x = raw[name]["x"]
                if raw[name].get("untimed"):  # only the spec has its sampling time
                    x = [step * count for count in x]
                drawn = [{**raw[name], "x": x, "name": "as measured", "raw": bool(prepared)}]
            unit = ""
            for channel, curve in prepared.items():
                if curve["column"] == name:
                    message = "prepared, training" if cleaned else "training"
                    drawn.append({**curve, "name": message})
                    unit, name = curve["unit"], channel
            if drawn:
                rows.append((with_unit(name, unit), drawn))
        other = f"; {session.data.name} is not among them" if session.apart and session.data else ""
        state = (
            rows,
            cleaned,
            whole,
            other,
            checked and checked["prepared"],
            checked and checked["rows"],
        )
        if state == self._curves:
            return
        self._curves = state
        with redrawn(self.curves):
            if not rows:
                text("Choose a data file to see its curves here.", "p", "hint")
                return
            plot(
                curves_figure(rows), f"Curves of {', '.join(label for label, _ in rows)} over time."
            )
            message = f"All of {whole}"
            if prepared:
                grey = f", in grey all of {whole}" * bool(raw)
                message = (
                    f"In colour the training data{', after preparation' * cleaned}{grey}{other}"
                )
            text(f"{message}. Drag to zoom, double-click for all.", "p", "hint")
            for done in (checked or {}).get("prepared", ()):
                text(f"Done: {done}", "p", "hint")
            if checked and session.spec:
                table(("part", "rows"), list(checked["rows"].items()), "Rows that are used")


def _proposal(found: Mapping[str, Any]) -> str:
    """Return why columns are given a use before a person has chosen one."""
    if found["guess"]:
        why = f"Proposed, since {found['guess']}"
    elif any(column["kind"] for column in found["columns"]):
        why = "Proposed by the names of the columns"
    else:
        return (
            "The names of the columns do not show which are inputs and outputs: choose them here."
        )
    return f"{why}. Confirm it with the button below, or choose otherwise."


def _seconds(message: str) -> float | None:
    """Return a sampling time; None for an empty field.

    Raises:
        InputError: no positive number.
    """
    message = message.strip()
    if not message:
        return None
    try:
        step = float(message)
    except ValueError:
        raise InputError(f"it must be a number of seconds, such as 0.01; got {message}.") from None
    return check_step(step)
