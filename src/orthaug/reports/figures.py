"""Figures from Python: those of the result folders, and `fit.plot` on given matplotlib axes."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from textwrap import fill
from typing import Any

import numpy as np

from orthaug._base.checks import check_choice, check_type
from orthaug._base.errors import InputError
from orthaug._base.lines import estimate_cells, with_unit
from orthaug.analysis.linear_view import Linearization
from orthaug.data.record import Record
from orthaug.fitting.estimates import Estimate
from orthaug.fitting.recursive import Recursive
from orthaug.models.response import Response
from orthaug.reports.drawing import (
    BLUE,
    BOTTOM,
    GREEN,
    GREY,
    ORANGE,
    SIZE,
    TOP,
    Axes,
    Figure,
    axes_for,
    new_figure,
    outline,
    rule_axes,
)
from orthaug.reports.learned_part import LearnedPart, curve_limits, learned_of
from orthaug.reports.linear import gain_unit
from orthaug.reports.result import CheckResult, CompareResult, FitResult

_OF_RESPONSES = ("output", "residual", "components")
_OF_VIEWS = ("bode", "poles")
_LEAST_SPAN = 1e-300


def plot(
    what: Response | Linearization | Recursive | Estimate | FitResult | CheckResult | CompareResult,
    kind: str | None = None,
    *,
    title: str | None = None,
    path: str | os.PathLike | None = None,
) -> Figure:
    """Return a matplotlib figure; also written as a PNG where there is a `path`.

    Args:
        what: a response, of `model.simulate` or `model.predict`; what `linearize` returns; a
            `Recursive`, for θ over time; a fit, for the overview of `fit.plot()`; or the `result`
            of `fit_spec` or `compare`.
        kind: of a response "output" (measured and model; the default), "residual" or "components"
            (physics and learner); of linear views "bode" (the default) or "poles"; of a fit
            "overview" (the default) or a figure of `fit.plot`, such as "learned". A result has one
            figure: the biases by suspected terms of a fit, or the comparison.
        title: of the figure of a response or of a `Recursive`; by default what kind it is.
        path: PNG file to write; a file of that name is replaced.

    Raises:
        InputError: nothing that has a figure, an unknown kind, outputs that were not measured, a
            path that cannot be written.
    """
    wanted = (
        "a Response, such as model.simulate(record), what linearize gives, a Recursive, a fit, or "
        "the `result` of fit_spec or compare"
    )
    check_type(
        what,
        Response | Linearization | Recursive | Estimate | FitResult | CheckResult | CompareResult,
        "what",
        wanted,
    )
    kinds = _OF_VIEWS if isinstance(what, Linearization) else _OF_RESPONSES
    kinds = ("overview", *dir(FitPlots(what))) if isinstance(what, Estimate) else kinds
    kind = check_choice(kinds[0] if kind is None else kind, kinds, "`kind`")
    check_type(title, str | None, "title", "text")
    check_type(path, str | os.PathLike | None, "path", "a file's name")
    if path is not None and Path(path).suffix.lower() != ".png":
        raise InputError(f"{path}: figures are written as PNG; give a name that ends in .png.")
    figure = _draw(what, kind, title)
    if path is not None:
        from orthaug.reports import plots

        try:
            plots.save(figure, Path(path))
        except OSError as error:
            raise InputError(f"{path}: cannot be written ({error.strerror}).") from None
    return figure


def _draw(what: Any, kind: str, title: str | None) -> Figure:
    from orthaug.reports import finding_plots, linear_plots, plots

    if isinstance(what, Estimate):
        return _draw_fit(FitPlots(what), kind)
    if isinstance(what, Linearization):
        if kind == "bode" and not what[0].inputs:
            raise InputError(
                "the model has no inputs, so that it has no frequency response to draw."
            )
        return linear_plots.bode_figure(what) if kind == "bode" else linear_plots.poles_figure(what)
    if isinstance(what, Recursive):
        alarms = [alarm.time for alarm in what.alarms]
        return plots.tracking_figure(
            what.history, what.fitted.form.baseline.parameters, alarms, title
        )
    if isinstance(what, CompareResult):
        return plots.comparison_figure(what.comparison)
    if not isinstance(what, Response):
        if not what.bias:
            raise InputError(
                "this result has no suspects, so that there is no figure of their biases."
            )
        return finding_plots.bias_figure(what.bias)
    if kind == "residual" and any(trajectory.measured is None for trajectory in what.trajectories):
        raise InputError("the outputs of this response were not measured; it has no residual.")
    horizon = "free run" if what.horizon is None else f"{what.horizon}-step prediction"
    draw = {
        "output": plots.output_figure,
        "residual": plots.residual_figure,
        "components": plots.components_figure,
    }
    return draw[kind](what, horizon if title is None else title)


def _draw_fit(plots: FitPlots, kind: str) -> Figure:
    """Return the overview of a fit, or one of its figures."""
    if kind == "overview":
        return plots()
    figure = getattr(plots, kind)().get_figure(root=True)
    assert figure is not None
    return figure


@dataclass(frozen=True)
class FitPlots:
    """Figures of `fit`: `plot()` is an overview, `plot.free_run()` and so on are single ones.

    Each of these draws on `ax`, or on new axes, and returns the axes. Settings of matplotlib stay
    as they are. New axes belong to pyplot where that is in use, as in notebooks.
    """

    fit: Estimate

    def __repr__(self) -> str:
        return f"FitPlots({', '.join(f'{kind}()' for kind in dir(self))})"

    def __dir__(self) -> list[str]:
        """Return the kinds of figures, which completion lists."""
        return sorted(n for n in vars(type(self)) if not n.startswith("_") and n != "fit")

    def __call__(self, record: Record | None = None) -> Figure:
        """Return an overview: free run and its residual, parameters, and the learned part.

        Without a learner the gain over frequency is in the place of the learned part, if the model
        has inputs and a point of rest.

        Args:
            record: that of the free run, with the model's channels; None for that of training.

        Raises:
            InputError: a fit without a usable model, other channels.
        """
        learns = self.fit.learns
        figure = new_figure(2 * SIZE[0], 2 * (SIZE[1] + TOP + BOTTOM))
        axes = figure.subplot_mosaic([["run", "run"], ["residual", "residual"], ["left", "right"]])
        for axis in axes.values():
            rule_axes(axis)
        self.free_run(record, ax=axes["run"])
        if self.fit.model.fitting(self._record(record), need_outputs=False).outputs:
            self.residuals(record, kind="free_run", ax=axes["residual"])
            axes["residual"].sharex(axes["run"])
        else:
            axes["residual"].remove()
        self.parameters(ax=axes["left"])
        try:
            (self.learned if learns else self.bode)(ax=axes["right"])
        except InputError as error:  # no learned part, no inputs, or no point of rest
            axes["right"].set_axis_off()
            axes["right"].text(0.5, 0.5, fill(str(error), 40), ha="center", va="center")
        return figure

    def free_run(
        self,
        record: Record | None = None,
        *,
        output: str | None = None,
        experiment: int = 0,
        ax: Axes | None = None,
    ) -> Axes:
        """Draw measured output, free run, and free run without the learner, over time [s].

        Args:
            record: any with the model's channels; None for that of training.
            output: its name; None for the first.
            experiment: its number in the record.

        Raises:
            InputError: no such output or experiment; a fit without a usable model.
        """
        response, i = self._response("simulate", record, output, experiment)
        axis = self._outputs(response, i, experiment, "free run", ax)
        if self.fit.learns:
            alone = self.fit.model.physics_only.simulate(self._record(record)).trajectories[
                experiment
            ]
            limits = axis.get_ylim()
            time = alone.time(response.sampling_time)
            drawn = outline(time, alone.model[:, i])
            axis.plot(
                *drawn, color=ORANGE, linewidth=0.9, zorder=1.5, label="model without its learner"
            )
            axis.set_ylim(*limits)  # a diverging run of physics does not set the limits
            axis.legend(fontsize="small", frameon=False)
        return axis

    def one_step(
        self,
        record: Record | None = None,
        *,
        output: str | None = None,
        experiment: int = 0,
        ax: Axes | None = None,
    ) -> Axes:
        """Draw measured output and the prediction one step ahead, over time [s].

        Arguments as `free_run`.
        """
        response, i = self._response("predict", record, output, experiment)
        return self._outputs(response, i, experiment, "one step ahead", ax)

    def residuals(
        self,
        record: Record | None = None,
        *,
        kind: str = "one_step",
        output: str | None = None,
        experiment: int = 0,
        ax: Axes | None = None,
    ) -> Axes:
        """Draw measured less model over time [s]; `kind` is one_step or free_run.

        Other arguments as `free_run`.

        Raises:
            InputError: as `free_run`; outputs that were not measured.
        """
        check_choice(kind, ("one_step", "free_run"), "`kind`")
        verb = "predict" if kind == "one_step" else "simulate"
        response, i = self._response(verb, record, output, experiment)
        trajectory, channel = response.trajectories[experiment], response.outputs[i]
        if trajectory.measured is None:
            raise InputError("the outputs of this record were not measured; there is no residual.")
        axis = axes_for(ax)
        error = trajectory.measured[:, i] - trajectory.model[:, i]
        axis.plot(
            *outline(trajectory.time(response.sampling_time), error),
            color=BLUE,
            linewidth=0.7,
        )
        axis.axhline(0.0, color=GREY, linewidth=0.8)
        axis.set(
            xlabel="time [s]",
            ylabel=f"residual of {channel.label}",
            title=f"residual, {_words(kind)}",
        )
        return axis

    def learned(
        self, feature: str | None = None, *, output: str | None = None, ax: Axes | None = None
    ) -> Axes:
        """Draw the learned part over one input of the learner: means with the cloud, or the curve.

        The curve, all else at its median, is drawn where the data can move the input alone; a band
        is its 95 % interval, dashed outside of the range of the training data.

        Args:
            feature: one of the learner's inputs; None for the one that explains most.
            output: which learned part; None for the first.

        Raises:
            InputError: a fit without a learner; names that it does not have.
        """
        part = self._learned_part()
        feature = check_choice(
            part.rank()[0] if feature is None else feature, part.features, "`feature`"
        )
        bare = [name.partition(" [")[0] for name in part.names]
        i = 0 if output is None else bare.index(check_choice(output, bare, "`output`"))
        own, axis = part.seen[:, part.features.index(feature)], axes_for(ax)
        axis.plot(
            own,
            part.values[:, i],
            ".",
            color=GREY,
            markersize=2,
            alpha=0.6,
            label="at the training data",
        )
        curve = None if part.is_tied(feature) else part.curve(feature)
        if curve is None:
            centres, means = part.means(feature)
            axis.plot(
                centres, means[:, i], "o-", color=GREEN, markersize=3, linewidth=1.0, label="mean"
            )
        else:
            values = curve.learned[:, i]
            axis.plot(curve.along, values, "--", color=GREEN, linewidth=0.9)
            inside = np.where(curve.inside, values, np.nan)
            axis.plot(
                curve.along,
                inside,
                color=GREEN,
                linewidth=1.6,
                label="learned, all else at its median",
            )
            if curve.half is not None:
                half = curve.half[:, i]
                axis.fill_between(
                    curve.along, values - half, values + half, color=GREEN, alpha=0.2, linewidth=0
                )
            axis.set_ylim(*curve_limits(curve, i, part.values[:, i]))
        unit = part.units[part.features.index(feature)]
        axis.set(
            xlabel=with_unit(feature, unit),
            ylabel=f"learned part of {part.names[i]}",
        )
        axis.legend(fontsize="small", frameon=False)
        return axis

    def parameters(self, *, ax: Axes | None = None) -> Axes:
        """Draw the 95 % interval of every parameter, in per cent of the estimate.

        Values and limits are written above.

        A parameter without an interval, or with the estimate 0, is a hollow point.
        """
        table, axis = self.fit.parameters, axes_for(ax)
        place = np.arange(len(table))[::-1]
        for y, (name, row) in zip(place, table.to_dict("index").items(), strict=True):
            ends = np.array([row["ci95_low"], row["ci95_high"]])
            known = bool(np.isfinite(ends).all())
            if known and row["value"]:
                share = 100 * (ends - row["value"]) / abs(row["value"])
                axis.plot(share, [y, y], "|-", color=GREEN, markersize=10, linewidth=2)
            value, _, low, high = estimate_cells(row["value"], row["std"], ends.tolist())
            reach = f"  [{low}, {high}]" if known else ", no interval"
            label = f"{name} = {value}{' ' * bool(row['unit'])}{row['unit']}{reach}"
            axis.plot(
                [0.0],
                [y],
                "o",
                color=GREEN,
                markerfacecolor=GREEN if known and row["value"] else "none",
            )
            axis.annotate(
                label, (0.0, y), (0, 9), textcoords="offset points", ha="center", fontsize="small"
            )
        axis.axvline(0.0, color=GREY, linewidth=0.8, zorder=0)
        axis.set_yticks(place, [str(name) for name in table.index])
        axis.set(xlabel="distance from the estimate [%]", title="parameters, 95 % intervals")
        reach = 1.2 * max(np.abs(axis.get_xlim()))
        axis.set_xlim(-reach, reach)
        axis.set_ylim(-0.6, len(table) - 0.2)
        return axis

    def bode(
        self,
        *,
        input: str | None = None,
        output: str | None = None,
        phase: bool = False,
        ax: Axes | None = None,
    ) -> Axes:
        """Draw the gain over frequency [Hz] about an operating point, with its 95 % band.

        With `phase` the phase in degrees.

        Raises:
            InputError: a model without inputs or without a point of rest, names that it does not
                have.
        """
        from orthaug.analysis.linearization import linearize

        view = linearize(self.fit)[0]
        if view.bode is None:
            raise InputError(
                "the model has no inputs, so that it has no frequency response to draw."
            )
        i = _place(output, view.outputs, "`output`")
        j = _place(input, view.inputs, "`input`")
        value, band = (
            (view.bode.phase, view.bode.phase_ci95)
            if phase
            else (view.bode.magnitude, view.bode.magnitude_ci95)
        )
        axis = axes_for(ax)
        axis.plot(view.bode.frequency, value[:, i, j], color=BLUE, linewidth=1.2)
        if band is not None:
            axis.fill_between(
                view.bode.frequency, *band[:, i, j].T, color=BLUE, alpha=0.25, linewidth=0
            )
        axis.set_xscale("log")
        if not phase:
            axis.set_yscale("log")
        unit = gain_unit(view, i, j)
        what = "phase [°]" if phase else with_unit("gain", unit)
        axis.set(
            xlabel=f"frequency [{view.frequency_unit}]",
            ylabel=what,
            title=f"from {view.inputs[j]} to {view.outputs[i]}",
        )
        return axis

    def _record(self, record: Record | None) -> Record:
        check_type(record, Record | None, "record", "a Record, or None for that of training")
        return self.fit.problem.record if record is None else record

    def _response(
        self, verb: str, record: Record | None, output: str | None, experiment: int
    ) -> tuple[Response, int]:
        """Return the response on a record, and the index of the output that is drawn."""
        given = self._record(record)
        if not self.fit.status.ok:
            raise InputError(f"training failed ({self.fit.status.code}); there is nothing to draw.")
        count = len(given.experiments)
        if (
            isinstance(experiment, bool)
            or not isinstance(experiment, int)
            or not 0 <= experiment < count
        ):
            raise InputError(
                f"`experiment` must be a number from 0 to {count - 1}; got {experiment!r}."
            )
        i = _place(output, [channel.name for channel in self.fit.model.outputs], "`output`")
        return getattr(self.fit.model, verb)(given), i

    def _outputs(
        self, response: Response, i: int, experiment: int, what: str, ax: Axes | None
    ) -> Axes:
        trajectory, channel, axis = (
            response.trajectories[experiment],
            response.outputs[i],
            axes_for(ax),
        )
        time = trajectory.time(response.sampling_time)
        if trajectory.measured is not None:
            axis.plot(
                *outline(time, trajectory.measured[:, i]),
                color=GREY,
                linewidth=2.4,
                label="measured",
            )
        axis.plot(*outline(time, trajectory.model[:, i]), color=BLUE, linewidth=0.9, label="model")
        if trajectory.measured is not None:  # the measured range, for a run that leaves all bounds
            span = [np.nanmin(trajectory.measured[:, i]), np.nanmax(trajectory.measured[:, i])]
            margin = 0.5 * max(span[1] - span[0], _LEAST_SPAN)
            low, high = axis.get_ylim()
            axis.set_ylim(max(low, span[0] - margin), min(high, span[1] + margin))
        axis.set(xlabel="time [s]", ylabel=channel.label, title=what)
        axis.legend(fontsize="small", frameon=False)
        return axis

    def _learned_part(self) -> LearnedPart:
        part = learned_of(self.fit, self.fit.problem.record) if self.fit.status.ok else None
        if part is None:
            raise InputError("nothing was learned beside the physics; there is nothing to draw.")
        return part


def _place(name: str | None, names: Any, what: str) -> int:
    return 0 if name is None else list(names).index(check_choice(name, tuple(names), what))


def _words(kind: str) -> str:
    return "one step ahead" if kind == "one_step" else "free run"
