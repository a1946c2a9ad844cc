"""The parts of the page to read the report, and to take away spec, model and code."""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path

from nicegui import ui

from orthaug.commands.app.session import Session
from orthaug.commands.app.spec_text import files
from orthaug.commands.app.widgets import (
    button,
    card,
    choice,
    field,
    label_widget,
    link,
    note,
    redrawn,
    text,
)

_REPORTS = {"report.html": "of the fit", "comparison.html": "of the comparison"}
_FILES = (
    ("spec", "spec.toml", "Spec", "the command line gives the same numbers"),
    ("fit", "model.zip", "Model", "for orthaug simulate, predict, linearize, track"),
    ("fit", "report.html", "Report", "one file, needs no network"),
    ("fit", "result.json", "Numbers", "result.json"),
    ("fit", "result.zip", "The whole fit", "result folder"),
    ("compare", "comparison.zip", "The whole comparison", "result folder"),
)
_TARGETS = {
    "c": "C99 without libraries",
    "casadi": "CasADi, for optimisation and MPC",
    "numpy": "Python with NumPy alone",
    "control": "python-control",
    "onnx": "ONNX",
    "fmu": "FMU, for simulators",
    "latex": "LaTeX",
}


class ReportView:
    """The view of report.html."""

    def __init__(self, session: Session) -> None:
        self.session, self.shown = session, "report.html"
        self._state: object = None

    def draw(self) -> None:
        self.place = ui.element("div")
        self.follow_work()

    def follow_work(self) -> None:
        """Show the report of the last result."""
        session = self.session
        kinds = {"fit": "report.html", "compare": "comparison.html"}
        marks = {
            name: session.shown[kind] for kind, name in kinds.items() if kind in session.results
        }
        there = list(marks)
        if marks == self._state:
            return
        self._state = marks
        with redrawn(self.place):
            if not there:
                with card("Report"):
                    text(
                        "Run a fit or a comparison to see its report here.",
                        "p",
                        "hint",
                    )
                return
            self.shown = self.shown if self.shown in there else there[0]
            with ui.element("div").classes("fields report-line"):
                if len(there) > 1:
                    choice(
                        "report",
                        {name: _REPORTS[name] for name in there},
                        self.shown,
                        self._show,
                        "bare",
                    )
                link("Download", f"/session/{session.key}/get/{self.shown}")
            frame = (
                ui.element("iframe")
                .classes("report")
                .props('sandbox="allow-scripts" title="report"')
            )
            place = (
                f"/session/{session.key}/get/{self.shown}?show=true&n={session.versions['work']}"
            )
            frame.props(f'data-src="{place}"')  # page.js loads it once the frame has its width

    def _show(self, name: str) -> None:
        self.shown, self._state = name, None
        self.follow_work()


class ExportView:
    """The view of downloads, and of the export of the model as code."""

    def __init__(self, session: Session) -> None:
        self.session, self.name = session, "model"
        self._state: object = None

    def draw(self) -> None:
        with ui.element("div").classes("columns"):
            with card("Files"):
                self.files = ui.element("div")
            with card(
                "Model as code", "Needs no orthaug; each folder has a README and test vectors."
            ):
                self.code = ui.element("div")
        self.follow_work()

    def follow_work(self) -> None:
        session = self.session
        state = (
            bool(session.spec),
            tuple(session.results),
            tuple(session.exports.items()),
            self._uploaded_files(),
        )
        if state == self._state:
            return
        self._state = state
        with redrawn(self.files):
            self._draw_files()
        with redrawn(self.code):
            self._draw_code()

    def _draw_files(self) -> None:
        session = self.session
        there = {"spec" if session.spec else "", *session.results}
        files = [own for of, *own in _FILES if of in there]
        for name, label, hint in files:
            with ui.element("div").classes("entry"):
                with ui.element("div").classes("grow"):
                    text(label, "p", "strong")
                    text(hint, "p", "hint")
                link(name, f"/session/{session.key}/get/{name}")
        if not files:
            text("There is nothing to download yet.", "p", "hint")
            return
        text("The same on the command line:", "p", "small")
        text("orthaug fit spec.toml --out result", "pre")
        if beside := self._uploaded_files():
            them = "the two" if len(beside) == 1 else "them and the spec"
            named = " and ".join(", ".join(beside).rsplit(", ", 1))
            text(f"The spec names {named}: keep {them} in one folder.", "p", "hint")

    def _uploaded_files(self) -> list[str]:
        """Return the files that the spec names without a folder, since they were uploaded."""
        return [file for file in files(self.session.content()) if not Path(file).is_absolute()]

    def _draw_code(self) -> None:
        session = self.session
        if "fit" not in session.results:
            text("Train a model first.", "p", "hint")
            return
        with ui.element("div").classes("fields"):
            field("name in the code", self.name, self._rename, classes="medium")
        for target, summary in _TARGETS.items():
            why = session.exports.get(target)
            with ui.element("div").classes("entry"):
                with ui.element("div").classes("grow"):
                    text(summary, "p", "strong")
                    if why:
                        note("Writing …" if why == "…" else why, "busy" if why == "…" else "bad")
                if why == "":
                    made = link(f"{target}.zip", f"/session/{session.key}/get/{target}.zip")
                else:
                    made = label_widget(
                        button("Write", partial(session.export, target, self.name)),
                        f"Write {target}",
                    )
                    made.props("loading" if why == "…" else "")
                made.props(f"data-place={target}")

    def _rename(self, value: str) -> None:
        if re.fullmatch(r"[A-Za-z]\w{0,39}", value.strip(), re.ASCII):
            self.name = value.strip()
            self.session.exports.clear()
            self.session.mark_changed("work")
        else:
            ui.notify(
                "A name has letters, digits and underscores, and begins with a letter.",
                type="warning",
            )
