"""The part of the page for the model: forms, the text of the spec, and the result of its check."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

from nicegui import ui

from orthaug._base.lines import percent
from orthaug.commands.app import spec_text
from orthaug.commands.app.session import Session
from orthaug.commands.app.widgets import (
    button,
    card,
    choice,
    field,
    label_widget,
    note,
    number,
    redrawn,
    sentence,
    table,
    text,
)

_TERMS = ("baseline", "terms")
_PHYSICS = {"terms": "a sum of terms", "motion": "equations of motion"}
_MOTION = {"states": "States", "parameters": "Parameters"}
_LEARNERS = {"mlp": "a network", "terms": "a sum of terms", "none": "none: physics alone"}
_FOCUS = {
    "auto": "automatic",
    "prediction": "one step ahead",
    "simulation": "the free run",
}
_MULTIPLE = 1e5  # % from which a change is given in words
_ROUNDING = 1e-7  # % below which it counts as none
_STRUCTURES = {
    "orthogonal": "orthogonal",
    "additive": "additive",
    "orthogonal-penalty": "penalty on the overlap",
    "baseline-penalty": "penalty on θ − θ⁰",
}


class ModelView:
    """The view of a session's spec, as forms and as text."""

    def __init__(self, session: Session) -> None:
        self.session = session
        self._wrong: dict[str, ui.element] = {}

    def draw(self) -> None:
        with ui.element("div").classes("columns wide-left"):
            with ui.element("div").classes("stack"):
                with card("Physics"):
                    self.physics = ui.element("div")
                with card("Learner and training"):
                    self.learner = ui.element("div")
                hint = (
                    "The forms write this text, and a change of the text changes the forms. "
                    "All keys: orthaug schema keys."
                )
                with card("Spec", hint):
                    self.editor = ui.textarea("spec in TOML", value=self.session.spec).classes(
                        "editor"
                    )
                    self.editor.props(
                        "outlined stack-label spellcheck=false autocapitalize=off autogrow "
                        "debounce=250"
                    )
                    self.editor.on_value_change(
                        lambda event: self.session.write(event.value or "", "editor")
                    )
            with card("Check", classes="sticky"):
                self.check = ui.element("div")
        self.follow_spec("")
        self.follow_check()

    def follow_spec(self, author: str) -> None:
        """Update the forms after a change of the text, and the text after a change in a form."""
        if author != "editor" and self.editor.value != self.session.spec:
            self.editor.set_value(self.session.spec)
        if author != "form":
            content = self.session.content()
            if content or not self.session.spec.strip():
                self._draw_physics(content)
                self._draw_learner(content)

    def follow_data(self) -> None:
        """Show the first step while there is no spec."""
        if not self.session.spec.strip():
            self._draw_physics({})

    def _draw_physics(self, content: Mapping[str, Any]) -> None:
        self._wrong.clear()
        with redrawn(self.physics):
            if not content:
                begin = self.session.first_step.removesuffix(".")
                text(f"{begin}, or write a spec in the field below.", "p", "hint")
                return
            source, kind = _source_of(content), spec_text.kind_of_physics(content)
            if not source:
                choice("written as", _PHYSICS, kind, self.session.choose_physics)
            if kind == "motion":
                self._draw_motion(content)
                return
            if source:
                where = f"{source.get('kind', 'source')} {source.get('file', '')}".strip()
                words = f"Physics from a file ({where}), written in the spec below."
                text(words, "p", "hint")
                return
            outputs = spec_text.names(spec_text.section(content, "data"), "outputs")
            text(
                " and ".join(f"{name}[k] = Σ parameter · regressor" for name in outputs),
                "p",
                "hint formula",
            )
            for i, term in enumerate(spec_text.rows_of(self.session.spec, _TERMS)):
                self._draw_term(i, term, several=len(outputs) > 1)
            button("Add a term", self._add)

    def _draw_term(self, index: int, term: Mapping[str, Any], *, several: bool) -> None:
        keys = ("parameter", "regressor", *(("output",) if several else ()), "initial", "unit")
        with label_widget(
            ui.element("div").classes("entry term").props("role=group"), f"term {index + 1}"
        ):
            with ui.element("div").classes("fields grow"):
                for key in keys:
                    wide = "" if key in ("parameter", "regressor") else "short"
                    change = partial(
                        self.session.edit, "form", spec_text.with_field, _TERMS, index, key
                    )
                    field(key, term.get(key), change, classes=f"{wide} {key}")
            remove = partial(self.session.edit, "more terms", spec_text.without_row, _TERMS, index)
            label_widget(button("Remove", remove), f"Remove term {index + 1}")

    def _add(self) -> None:
        taken = {
            str(term.get("parameter")) for term in spec_text.rows_of(self.session.spec, _TERMS)
        }
        name = next(name for i in range(1, 1000) if (name := f"p{i}") not in taken)
        data = spec_text.section(self.session.content(), "data")
        inputs, outputs = spec_text.names(data, "inputs"), spec_text.names(data, "outputs")
        row = {"parameter": name, "regressor": f"{[*inputs, *outputs, 'u'][0]}[k-1]**2"}
        row |= {"output": outputs[0]} if len(outputs) > 1 else {}
        self.session.edit("more terms", spec_text.with_row, _TERMS, row)

    def _draw_motion(self, content: Mapping[str, Any]) -> None:
        motion = spec_text.section(content, "motion")
        equation = "next" if motion.get("integrator") == "discrete" else "derivative"
        keys = {
            "states": (equation, "start", "unit"),
            "parameters": ("initial", "unit", "min", "max"),
        }
        for part, own in keys.items():
            text(_MOTION[part], "h3")
            for name, row in spec_text.section(motion, part).items():
                if isinstance(row, Mapping):
                    self._draw_quantity(("motion", part, name), row, own)
            button(f"Add a {part[:-1]}", partial(self._add_quantity, part, own[0]))
        text("Outputs", "h3")
        with ui.element("div").classes("fields"):
            for name, value in spec_text.section(motion, "outputs").items():
                if not isinstance(value, Mapping):
                    field(f"{name} =", value, self._value("motion", "outputs", name))
        self._wrong["outputs"] = ui.element("div")
        text("Start values", "h3")
        with ui.element("div").classes("fields"):
            self.starts = button("Estimate from the data", self.session.estimate_starts)
            self.starting = ui.element("div").classes("grow")
        self.follow_work()

    def _draw_quantity(
        self, path: Sequence[str], row: Mapping[str, Any], keys: Sequence[str]
    ) -> None:
        """Draw a state or a parameter, with what is wrong with it below."""
        kind, name = path[1][:-1], path[2]
        with label_widget(
            ui.element("div").classes("entry term").props("role=group"), f"{kind} {name}"
        ):
            with ui.element("div").classes("fields grow"):
                field(
                    "name",
                    name,
                    lambda new: self.session.edit("more terms", spec_text.with_name, path, new),
                    classes="short",
                )
                for key in keys:
                    label = f"d{name}/dt" if key == "derivative" else key
                    wide = {"derivative": "regressor", "next": "regressor", "start": "medium"}
                    field(
                        label, row.get(key), self._value(*path, key), classes=wide.get(key, "short")
                    )
                if kind == "state":
                    made = ui.checkbox("learner added", value=bool(row.get("learned")))
                    made.on_value_change(partial(self._set_learned, path))
                    label_widget(made, "learner added")
                self._wrong[name] = ui.element("div").classes("grow")
            remove = partial(self.session.edit, "more terms", spec_text.with_value, path, None)
            label_widget(button("Remove", remove), f"Remove {kind} {name}")

    def _set_learned(self, path: Sequence[str], event: Any) -> None:
        self.session.edit(
            "form", spec_text.with_value, (*path, "learned"), True if event.value else None
        )

    def _add_quantity(self, part: str, key: str) -> None:
        taken = spec_text.section(self.session.content(), "motion", part)
        name = next(name for i in range(1, 1000) if (name := f"{part[0]}{i}") not in taken)
        row = {key: 1.0 if part == "parameters" else "0"}
        self.session.edit("more terms", spec_text.with_value, ("motion", part, name), row)

    def follow_work(self) -> None:
        """Show how the estimation of start values goes."""
        session = self.session
        if "motion" not in session.content() or self.starting.is_deleted:
            return
        self.starts.set_enabled(session.starting is None)
        with redrawn(self.starting):
            if session.starting is not None:
                took = time.monotonic() - session.starting
                note(f"Fitting the physics alone to short segments · {took:.0f} s", "busy")
            elif session.start_trouble:
                note(sentence(session.start_trouble), "bad")
            else:
                hint = "The physics alone is fitted to segments that lengthen; Undo takes it back."
                text(hint, "p", "hint")

    def _show_wrong(self) -> None:
        """Show under a state, parameter or output what the check refuses about it."""
        session = self.session
        why = session.refused if not session.checking and "motion: " in session.refused else ""
        for name, place in self._wrong.items():
            if place.is_deleted:
                continue
            own = f"'{name}'" in why if name != "outputs" else "the output" in why
            with redrawn(place):
                if own:
                    text(sentence(why.partition("motion: ")[2]), "p", "wrong")

    def _value(self, *path: str) -> Callable[[str], None]:
        """Return a callback that stores the value of a field under a key."""
        return lambda checked: self.session.edit(
            "form", spec_text.with_value, path, spec_text.read(path[-1], checked)
        )

    def _draw_learner(self, content: Mapping[str, Any]) -> None:
        learner, training = (
            spec_text.section(content, "learner"),
            spec_text.section(content, "training"),
        )
        moves = "motion" in content or bool(_source_of(content))
        with redrawn(self.learner):
            if not content:
                text("A learner finds what the physics lacks.", "p", "hint")
                return
            kind = str(learner.get("kind", "mlp"))
            with ui.element("div").classes("fields"):
                choice("learner", _LEARNERS, kind, self._set_kind)
                if kind == "mlp":
                    hidden = learner.get("hidden", [16])
                    field(
                        "neurons", spec_text.field_text(hidden), self._set_hidden, classes="short"
                    )
                if kind == "terms":
                    field(
                        "highest degree",
                        learner.get("degree"),
                        self._value("learner", "degree"),
                        classes="short",
                    )
                seen = learner.get("inputs")
                change = self._value("learner", "inputs")
                field(
                    "what it sees",
                    spec_text.field_text(seen),
                    change,
                    hint="all that the physics reads",
                )
            with ui.element("div").classes("fields"):
                structure = str(spec_text.section(content, "structure").get("kind", "orthogonal"))
                choice("structure", _STRUCTURES, structure, self._value("structure", "kind"))
                choice(
                    "trained on",
                    _FOCUS,
                    _focus_of(training, moves=moves),
                    self._value("training", "focus"),
                )
                for label, key, hint in (
                    ("starts", "restarts", "1"),
                    ("iterations", "iterations", ""),
                ):
                    field(
                        label,
                        training.get(key),
                        self._value("training", key),
                        classes="short",
                        hint=hint,
                    )

    def _set_kind(self, kind: str) -> None:
        spec = spec_text.with_value(self.session.spec, ("learner", "kind"), kind)
        learner = spec_text.section(self.session.content(), "learner")
        if kind == "terms" and not {"terms", "degree"} & set(learner):
            spec = spec_text.with_value(spec, ("learner", "degree"), 2)
        self.session.write(spec, "learner")

    def _set_hidden(self, value: str) -> None:
        try:
            hidden = [int(part) for part in value.replace(";", ",").split(",") if part.strip()]
        except ValueError:
            ui.notify(
                "Neurons are whole numbers, such as 16, or 8, 8 for two layers.", type="warning"
            )
            return
        self.session.edit("form", spec_text.with_value, ("learner", "hidden"), hidden or None)

    def follow_check(self) -> None:
        """Show the result of checking the present spec."""
        session = self.session
        self._show_wrong()
        with redrawn(self.check):
            if not session.spec.strip():
                text(
                    "Rank, units, what the learner could imitate of the physics, and possible "
                    "biases.",
                    "p",
                    "hint",
                )
                return
            if session.checking:
                note("Checking …", "busy")
            elif session.refused:
                note(sentence(session.refused), "bad")
            else:
                note("This spec can be trained.", "good")
            checked = None if session.checked is None else session.checked["check"]
            stale = session.checking or session.stale
            if checked is not None:
                if stale:
                    text("As the spec was before:", "p", "hint")
                with ui.element("div").classes("stale" if stale else ""):
                    _units((session.checked or {})["units"], moves=bool(checked.get("motion")))
                    _findings(checked, (session.checked or {})["bias"])
            elif session.checking and session.checked is not None:
                text(
                    "The equations are simulated to find which parameters they determine; this "
                    "takes a while.",
                    "p",
                    "hint",
                )


def _findings(checked: Mapping[str, Any], bias: Sequence[Mapping[str, Any]]) -> None:
    """Draw the findings of `orthaug check`."""
    data, physics = checked["excitation"], checked["identifiability"]
    condition = "infinite" if data["condition"] is None else number(data["condition"], 3)
    rows = [
        ("parameters", ", ".join(checked["parameters"]) or "none"),
        ("usable rows", checked["rows"]),
        ("rank on these data", f"{data['rank']} of {data['columns']}, condition {condition}"),
        ("rank on any data", f"{physics['rank']} of {physics['columns']}"),
    ]
    table(("what", "found"), rows)
    for group in physics["inseparable"]:
        note(f"No data can distinguish {', '.join(group)}.", "care")
    for group in data["collinear"] if physics["identifiable"] else ():
        note(f"These data do not excite separately: {', '.join(group)}.", "care")
    if checked.get("motion"):
        text(checked["motion"]["text"], "p", "small")
    if checked["shared"]:
        text("Shared with the learner", "h3")
        text(checked["shared"]["text"], "p", "small")
        rows = [
            (", ".join(o["inputs"]), o["shared"], ", ".join(o["determined"]) or "–")
            for o in checked["shared"]["alternatives"] or ()
        ]
        if rows:
            table(("if it sees only", "shared", "determined"), rows)
    if bias:
        text("What would bias the parameters", "h3")
        hint = (
            "The bias if such a term is missing from the physics. Its size is that of the spec, "
            "or else its RMS is 1 % of the output's standard deviation."
        )
        text(hint, "p", "hint")
        rows = [(one["name"], _biases(one["percent"]), one["removed_by"] or "–") for one in bias]
        table(("suspect", "bias of each parameter", "removed by"), rows)
    for warning in checked["warnings"]:
        note(warning["text"], "care")


def _source_of(content: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the section [physics.source] of a spec; empty where there is none."""
    return spec_text.section(content, "physics", "source")


def _units(units: Sequence[tuple[str, str, str | None]], *, moves: bool) -> None:
    """Show where the spec's units differ from those that the regressors imply.

    Both are written in one way here.
    """
    for name, given, asked in units:
        if asked is not None and given not in (asked, ""):
            note(
                f"Unit of {name}: the spec says {given}, output and regressor require {asked}.",
                "care",
            )
    wanted = [
        f"{name} in {asked}"
        for name, given, asked in units
        if asked not in (None, "1") and not given
    ]
    if wanted:
        text(f"Units, from those of the channels: {', '.join(wanted)}.", "p", "hint")
    bare = [name for name, given, _ in units if moves and not given]
    if bare:
        text(
            f"No unit is given for {', '.join(bare)}, and the channels do not determine it.",
            "p",
            "hint",
        )


def _focus_of(training: Mapping[str, Any], *, moves: bool) -> str:
    """Return the focus that a spec's section asks for, or its default."""
    ahead = "prediction" if training.get("horizon", 1) != 1 else "auto"
    return str(training.get("focus", "simulation" if moves else ahead))


def _biases(percents: Mapping[str, float | None]) -> str:
    """Return all biases on a line that breaks between the parameters only."""
    return ", ".join(f"{name}\u00a0{_percent(value)}" for name, value in percents.items())


def _percent(value: float | None) -> str:
    """Return a change in per cent.

    Near zero the change is a multiple of the parameter, and no number is of use.
    """
    if value is None:
        return "–"
    if abs(value) >= _MULTIPLE:
        return f"{'+' if value > 0 else '−'}\u00a0many\u00a0times"
    return percent(0.0 if abs(value) < _ROUNDING else value / 100, sign="+").replace(" ", "\u00a0")
