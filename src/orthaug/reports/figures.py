"""Figures from Python: of responses, suspects, comparisons and linear views, as the result folders have them."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

from orthaug._base.checks import check_choice, check_type
from orthaug._base.errors import InputError
from orthaug.analysis.linear_view import Linearization
from orthaug.fitting.recursive import Recursive
from orthaug.models.response import Response
from orthaug.reports.result import CheckResult, CompareResult, FitResult

if TYPE_CHECKING:
    from orthaug.reports.drawing import Figure

_OF_RESPONSES = ("output", "residual", "components")
_OF_VIEWS = ("bode", "poles")


def plot(
    what: Response | Linearization | Recursive | FitResult | CheckResult | CompareResult,
    kind: str | None = None,
    *,
    title: str | None = None,
    path: str | os.PathLike | None = None,
) -> Figure:
    """A matplotlib figure; also written as a PNG where there is a `path`.

    Args:
        what: a response, of `model.simulate` or `model.predict`; what `linearize` returns; a `Recursive`, for θ over
            time; or the `result` of `fit_spec` or `compare`.
        kind: of a response "output" (measured and model; the default), "residual" or "components" (physics and
            learner); of linear views "bode" (the default) or "poles". A result has one figure: the biases by suspected
            terms of a fit, or the comparison.
        title: of the figure of a response or of a `Recursive`; by default what kind it is.
        path: PNG file to write; a file of that name is replaced.

    Raises:
        InputError: nothing that has a figure, an unknown kind, outputs that were not measured, a path that cannot be
            written.
    """
    wanted = (
        "a Response, such as model.simulate(record), what linearize gives, a Recursive, or the `result` of fit_spec or "
        "compare"
    )
    check_type(what, Response | Linearization | Recursive | FitResult | CheckResult | CompareResult, "what", wanted)
    kinds = _OF_VIEWS if isinstance(what, Linearization) else _OF_RESPONSES
    kind = check_choice(kinds[0] if kind is None else kind, kinds, "`kind`")
    check_type(title, str | None, "title", "text")
    check_type(path, str | os.PathLike | None, "path", "a file's name")
    if path is not None and Path(path).suffix.lower() != ".png":
        raise InputError(f"{path}: figures are written as PNG; give a name that ends in .png.")
    figure = _drawn(what, kind, title)
    if path is not None:
        from orthaug.reports import plots

        try:
            plots.save(figure, Path(path))
        except OSError as error:
            raise InputError(f"{path}: cannot be written ({error.strerror}).") from None
    return figure


def _drawn(what: Any, kind: str, title: str | None) -> Figure:
    from orthaug.reports import linear_plots, plots

    if isinstance(what, Linearization):
        if kind == "bode" and not what[0].inputs:
            raise InputError("the model has no inputs, so that it has no frequency response to draw.")
        return linear_plots.bode_figure(what) if kind == "bode" else linear_plots.poles_figure(what)
    if isinstance(what, Recursive):
        alarms = [alarm.time for alarm in what.alarms]
        return plots.tracking_figure(what.history, what.fitted.form.baseline.parameters, alarms, title)
    if isinstance(what, CompareResult):
        return plots.comparison_figure(what.comparison)
    if not isinstance(what, Response):
        if not what.bias:
            raise InputError("this result has no suspects, so that there is no figure of their biases.")
        return plots.bias_figure(what.bias)
    if kind == "residual" and any(trajectory.measured is None for trajectory in what.trajectories):
        raise InputError("the outputs of this response were not measured; it has no residual.")
    horizon = "free run" if what.horizon is None else f"{what.horizon}-step prediction"
    draw = {"output": plots.output_figure, "residual": plots.residual_figure, "components": plots.components_figure}
    return draw[kind](what, horizon if title is None else title)
