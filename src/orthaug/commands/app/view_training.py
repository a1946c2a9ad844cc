"""The part of the page for training: begin, follow and stop it, and its results as tables."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from functools import partial
from html import escape
from typing import Any

from nicegui import ui

from orthaug._base.lines import BIASED_INTERVAL
from orthaug._base.progress import Stage
from orthaug.commands.app.kept_results import KeptResult
from orthaug.commands.app.processes import Command, Run
from orthaug.commands.app.session import Session
from orthaug.commands.app.spec_text import names, section
from orthaug.commands.app.widgets import (
    button,
    card,
    curves_figure,
    interval_figure,
    label_widget,
    loss_figure,
    note,
    number,
    of_several,
    plot,
    redrawn,
    run_name,
    sentence,
    table,
    text,
)

_MOST = 1500  # points of a curve of the loss
_LEAST = 8  # points that are worth a curve
_KEPT_HINT = "They are kept when the server ends. Open shows one again, with its spec."
_TITLES = {"fit": "Training", "compare": "Comparison"}


class TrainingView:
    """The view of a training and of its results."""

    def __init__(self, session: Session) -> None:
        self.session = session
        self._told = 0  # losses that are drawn
        self._curve: ui.plotly | None = None
        self._state: Any = None
        self._models: list[int] = []
        self._listed: Any = None
        self._pair: Any = None
        self._boxes: dict[int, ui.checkbox] = {}

    def draw(self) -> None:
        with card(
            "Train",
            "Runs orthaug fit on the spec, or orthaug compare: physics alone and every structure.",
        ):
            with ui.element("div").classes("fields"):
                self.begin = button("Train", lambda: self.session.train("fit"), main=True)
                self.compare = button("Compare structures", lambda: self.session.train("compare"))
                self.finish = button("Stop and keep the best so far", self.session.finish)
                self.end = button("Stop", self.session.stop, classes="stop")
            self.state = ui.element("div")
            self.bar = ui.element("progress").props(
                'max=1 value=0 aria-label="progress of training"'
            )
            with ui.element("div").classes("columns beside"):
                self.losses = ui.element("div")
                self.so_far = ui.element("div")
        self.results = ui.element("div")
        with card("Results of this spec", _KEPT_HINT) as self.history:
            self.kept = ui.element("div")
            self.compared = ui.element("div")
        self.follow_work()

    def follow_check(self) -> None:
        able = (
            bool(self.session.spec.strip())
            and self.session.running is None
            and not self.session.refused
        )
        for made in (self.begin, self.compare):
            made.set_enabled(able)

    def follow_work(self) -> None:
        """Show the progress of training, and its result."""
        session, running = self.session, self.session.running
        self.follow_check()
        self.end.set_visibility(running is not None)
        self.end.set_enabled(running is not None and not running.stopping)
        # Half a comparison compares nothing
        able = running is not None and running.arguments[0] == "fit"
        self.finish.set_visibility(able)
        self.finish.set_enabled(
            running is not None
            and bool(running.progress)
            and not (running.stopping or running.ending)
        )
        shown = running or max(session.commands.values(), key=lambda c: c.began, default=None)
        with redrawn(self.state):
            if shown is None:
                text(
                    "Nothing has been trained yet." if session.spec else session.first_step,
                    "p",
                    "hint",
                )
            else:
                self._tell(shown)
        self.bar.set_visibility(running is not None)
        self._draw_losses([] if shown is None else shown.losses)
        self._draw_so_far({} if running is None else running.models)
        state = (running is None, session.spec, session.units, dict(session.shown))
        state += (list(session.verdicts), [session.curves.get(kind) for kind in _TITLES])
        if state != self._state:
            self._state = state
            self._draw_results()
        self.history.set_visibility(bool(session.kept))
        listed = (running is None, session.kept, dict(session.shown), session.spec)
        if listed != self._listed:
            self._listed = listed
            self._list_results()
        self._follow_pair()

    def _follow_pair(self) -> None:
        """Show the two results that are compared."""
        session, pair = self.session, self.session.pair
        chosen = {one.number for one in pair}
        for own, box in self._boxes.items():
            box.set_value(own in chosen)
        state = (pair, session.curves.get("pair"))
        if state == self._pair:
            return
        self._pair = state
        with redrawn(self.compared):
            if len(pair) == 2:
                _draw_pair(pair, session.curves.get("pair"))
            elif pair:
                text(f"Choose another one to compare with {pair[0].name}.", "p", "hint")

    def _draw_losses(self, losses: Sequence[tuple[Run, int, float | None]]) -> None:
        losses = losses if len(losses) >= _LEAST else []
        if len(losses) == self._told:
            return
        figure = loss_figure(losses[:: max(1, len(losses) // _MOST)])
        if self._curve is None or not losses or not self._told:
            with redrawn(self.losses):
                progress = "Loss of every run over its iterations, on a logarithmic axis."
                self._curve = plot(figure, progress) if losses else None
                self.caption = text("", "p", "hint")
        else:
            self._curve.update_figure(figure)
        if losses:
            self.caption.set_content(escape(_runs_caption({run for run, _, _ in losses})))
        self._told = len(losses)

    def _draw_so_far(self, models: Mapping[str, Mapping[str, Any]]) -> None:
        """Draw what was measured, and the free run of physics alone and of the best run so far."""
        state = [id(model) for model in models.values()]
        if state == self._models:
            return
        self._models = state
        rows: dict[str, list[dict[str, object]]] = {}
        for i, (name, model) in enumerate(models.items(), 1):
            for output, own in model["outputs"].items():
                label = f"{output} [{own['unit']}]" if own["unit"] else output
                first = {"name": "measured", "y": own["measured"], "raw": True, "entry": 0}
                row = rows.setdefault(label, [{**first, "x": model["time"]}])
                row.append({"name": name, "x": model["time"], "y": own["model"], "entry": i})
        with redrawn(self.so_far):
            if rows:
                label = "Free run on the training data, so far."
                plot(curves_figure(list(rows.items())), label)
                text(
                    f"{label[:-1]}: its first rows, with the first run while it lasts and then "
                    "the best that has ended.",
                    "p",
                    "hint",
                )

    def _tell(self, command: Command) -> None:
        progress, what = command.progress, _TITLES.get(command.arguments[0], "")
        took = f"{command.seconds:.0f} s"
        if command.running:
            now = "reading and compiling"
            if progress:
                name = run_name(Run.of(progress), of_structure=command.arguments[0] == "compare")
                name = f" ({name})" if progress.get("structure") else ""
                now = (
                    f"run {progress['run']} of {progress['runs']}{name}, iteration "
                    f"{progress['iteration']}"
                )
                now += f", loss {number(progress['loss'], 4)}"
            done = progress.get("done", 0)
            if command.stage is not None:
                step, steps = list(Stage).index(command.stage.stage) + 1, len(Stage)
                now, done = (
                    f"after the runs, {step} of {steps}: {command.stage.text}",
                    step / steps,
                )
            if command.stopping or command.ending:
                now = "stopping …" if command.stopping else "ending with the best so far …"
            note(f"{what}: {now} · {took}", "busy")
            self.bar.props(f"value={done}")
        elif command.stopping and command.code != 0:
            note(f"{what} was stopped after {took}; nothing was kept of it.", "care")
        elif command.code == 0 and command.ending:
            note(f"{what} was stopped after {took}; the best so far is kept.", "care")
        elif command.code == 0:
            note(f"{what} is done, in {command.seconds:.1f} s.", "good")
        else:
            note(f"{what} failed: {self.session.reword(command.complaint)}", "bad")

    def _draw_results(self) -> None:
        session = self.session
        with redrawn(self.results):
            kinds = (
                ("fit", "Result", "trained", _fit),
                ("compare", "Comparison", "compared", _compare),
            )
            for kind, title, done, draw in kinds:
                if (result := session.results.get(kind)) is None:
                    continue
                with card(title):
                    same = session.trained[kind] == session.spec
                    if not same:
                        note(f"The spec has changed since it was {done}.", "care")
                    if (
                        verdict := session.verdicts.get(kind)
                    ) is not None:  # that the report begins with
                        note(" ".join(verdict["sentences"]), verdict["level"])
                    _runs(session.curves.get(kind))
                    draw(result, session.units if same else {})

    def _list_results(self) -> None:
        session, shown = self.session, set(self.session.shown.items())
        fits = sum(kept.kind == "fit" for kept in session.kept)
        self._boxes.clear()
        with redrawn(self.kept):
            for kept in reversed(session.kept):
                with label_widget(
                    ui.element("div").classes("entry").props("role=group"), kept.name
                ):
                    with ui.element("div").classes("grow"):
                        what = "" if kept.kind == "fit" else " (comparison)"
                        text(f"{kept.number}. {kept.score}{what}", "p", "strong")
                        text(f"{kept.made:%Y-%m-%d %H:%M} · {kept.change}", "p", "hint")
                    if kept.kind == "fit" and fits > 1:
                        box = self._boxes[kept.number] = ui.checkbox("compare")
                        box.on_value_change(partial(self._choose, kept))
                        label_widget(box, f"compare {kept.name}")
                    made = button("Open", partial(session.show_result, kept, with_spec=True))
                    label_widget(made, f"Open {kept.name}")
                    same = (kept.kind, kept.number) in shown and kept.spec == session.spec
                    made.set_enabled(session.running is None and not same)

    def _choose(self, kept: KeptResult, event: Any) -> None:
        self.session.choose_pair(kept, bool(event.value))


def _runs(found: Mapping[str, Any] | None) -> None:
    """Draw measured outputs and free runs."""
    if found is None:
        note("Simulating the free runs …", "busy")
        return
    if "refused" in found:
        note(f"The free runs are not drawn: {found['refused']}", "care")
        return
    for part in dict.fromkeys(row["part"] for row in found["rows"]):
        rows = []
        for row in (row for row in found["rows"] if row["part"] == part):
            measured, *models = row["curves"]
            first = {**measured, "raw": True, "entry": 0}
            runs = [{**model, "entry": i} for i, model in enumerate(models)]
            rows.append((row["label"], [first, *reversed(runs)]))
            rows.append(("error", [_less(measured, run) for run in reversed(runs)]))
        names = _listed([model["name"] for model in models])
        text(f"Free run on {part}", "h3")
        plot(curves_figure(rows), f"Free run of {names} on {part}, measured, and the error.")
        text(
            f"The {len(measured['x'])} rows where {models[0]['name']} errs most; the error is what "
            "was measured less the free run. Drag to zoom.",
            "p",
            "hint",
        )


def _less(measured: Mapping[str, Any], run: Mapping[str, Any]) -> dict[str, object]:
    """Return the curve of measured less model."""
    pairs = zip(measured["y"], run["y"], strict=True)
    return {**run, "y": [None if a is None or b is None else a - b for a, b in pairs]}


def _listed(names: Sequence[str]) -> str:
    return " and ".join(", ".join(names).rsplit(", ", 1))


def _draw_pair(pair: Sequence[KeptResult], curves: Mapping[str, object] | None) -> None:
    """Draw two results beside each other."""
    read = [json.loads((one.folder / "result.json").read_text(encoding="utf-8")) for one in pair]
    models = [(one.name, result["parameters"]) for one, result in zip(pair, read, strict=True)]
    text(f"{sentence(pair[0].name)} and {pair[1].name}", "h3")
    _interval_plot(models, {})
    _runs(curves)
    _scores(
        [(one.name, result["scores"]) for one, result in zip(pair, read, strict=True)],
        "",
        "Scores of both",
    )
    _parameters("Parameters of both", models, {})


def _interval_plot(
    models: Sequence[tuple[str, Sequence[Mapping[str, Any]]]], given: Mapping[str, str]
) -> None:
    units = {row["name"]: row["unit"] for _, rows in models for row in rows if row["unit"]}
    units |= given
    if any(rows for _, rows in models):
        names = ", ".join(name for name, _ in models)
        plot(interval_figure(models, units), f"Parameters with 95 % intervals of {names}.")
        if any(row.get("ci95_with_bias") for _, rows in models for row in rows):
            hint = f"The thin bar is the {BIASED_INTERVAL}; it need not hold the estimate."
            text(hint, "p", "hint")


def _runs_caption(runs: set[Run]) -> str:
    """Return a sentence that explains the curves."""
    caption = "Each curve is a run: one training"
    if any(run.start for run in runs):
        kinds = ", ".join(sorted({run.regularization for run in runs if run.start}))
        caption += " from one start, which is a random draw of the learner's first weights"
        caption += f", with one regularization of them ({kinds})" if kinds else ""
    if of_several(runs):
        caption += ". The colour shows the structure; point at a curve for its run"
    return f"{caption}."


def _fit(result: Mapping[str, Any], units: Mapping[str, str]) -> None:
    if result["validation"]:
        text(result["validation"]["text"], "p", "strong")
    _parameters("Parameters", [("", result["parameters"])], units)
    if result["physical_parameters"]:
        _parameters("Physical parameters", [("", result["physical_parameters"])], units)
    _scores([("", result["scores"])], _output_units(result))
    if result["residuals"]:
        text(result["residuals"]["text"], "p", "small")
    for warning in result["warnings"]:
        note(warning["text"], "care")


def _parameters(
    caption: str,
    models: Sequence[tuple[str, Sequence[Mapping[str, Any]]]],
    units: Mapping[str, str],
) -> None:
    """Draw the parameters of one model, or of several by name; `units` are the implied ones."""
    named, cells = any(name for name, _ in models), []
    biased = any(row.get("bias") for _, rows in models for row in rows)
    for name, rows in models:
        for row in rows:
            own = [number(row["value"], 6), number(row["std"], 3), _interval(row["ci95"])]
            own += _bias_cells(row) if biased else []
            unit = row["unit"] or units.get(row["name"]) or "–"
            cells.append((*([name] if named else []), row["name"], *own, unit))
    head = (
        *(["model"] if named else []),
        "parameter",
        "value",
        "standard error",
        "95 % interval",
        *(["bias", BIASED_INTERVAL] if biased else []),
        "unit",
    )
    table(head, cells, caption)


def _interval(ends: Sequence[float | None] | None) -> str:
    low, high = ends or (None, None)
    return "–" if low is None and high is None else f"{number(low)} … {number(high)}"


def _bias_cells(row: Mapping[str, Any]) -> list[str]:
    """Return the bias of a parameter, and the interval that covers it."""
    bias = row.get("bias") or {"value": None, "determined": True}
    known = bias.get("determined", True)
    reach = _interval(row.get("ci95_with_bias")) if known else "not determined by these data"
    return [number(bias["value"], 3), reach]


def _output_units(result: Mapping[str, Any]) -> str:
    """Return the units of the outputs behind `RMSE`, in brackets; nothing where none has one."""
    data = section(result["spec"], "data")
    units = [
        str(section(data, "channels", name).get("unit") or "–") for name in names(data, "outputs")
    ]
    return f" [{', '.join(units)}]" if set(units) - {"–"} else ""


def _scores(
    models: Sequence[tuple[str, Mapping[str, Any]]], unit: str, caption: str = "Scores"
) -> None:
    rows = []
    for name, scores in models:
        for part, kinds in scores.items():
            one, free = kinds["prediction"], kinds["simulation"]
            own = [
                _numbers(one["nrmse"]),
                _numbers(free["nrmse"]),
                _numbers(free["rmse"]),
                _numbers(free["fit"], 4),
            ]
            rows.append((name or part, *([part] if name else []), *own))
    head = (*(("model", "part") if models and models[0][0] else ("part",)), "NRMSE, one step")
    table((*head, "NRMSE, free run", f"RMSE, free run{unit}", "FIT %, free run"), rows, caption)


def _numbers(values: Sequence[float | None] | None, digits: int = 4) -> str:
    return "–" if values is None else ", ".join(number(value, digits) for value in values)


def _compare(result: Mapping[str, Any], units: Mapping[str, str]) -> None:
    if result["chosen"]:
        text(f"Chosen on the validation part: {result['chosen']}.", "p", "strong")
    models = result["comparison"]
    _interval_plot([(row["name"], row["parameters"]) for row in models], units)
    scores = [(row["name"], row["scores"]) for row in models]
    _scores(scores, _output_units(result), "Scores of every model")
    _parameters(
        "Parameters of every model", [(row["name"], row["parameters"]) for row in models], units
    )
    weights = [f"{row['name']} {row['weights']}" for row in models]
    text(f"Weights of the learner: {', '.join(weights)}.", "p", "hint")
    for row in models:
        if row["validation"]:
            text(f"{row['name']}: {row['validation']['text']}", "p", "small")
    for kind, why in result["left_out"].items():
        text(f"Left out: {kind}: {why}", "p", "small")
    progress = [warning["text"] for warning in result["warnings"]]
    progress += [
        f"{row['name']}: {warning['text']}" for row in models for warning in row["warnings"]
    ]
    for one in dict.fromkeys(progress):
        note(one, "care")
