"""`linearize`: where a model rests with its inputs held, and what linear system it is there."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from orthaug._base.checks import Matrix, Vector, check_choice, check_type
from orthaug._base.errors import InputError, Warning
from orthaug._base.lines import percent
from orthaug.analysis.amplitude_dependence import amplitude_warnings
from orthaug.analysis.linear_steps import (
    difference_widths,
    one_sided,
    slope_along,
    slope_at,
    step_of,
    unrest_along,
)
from orthaug.analysis.linear_system import METHODS, Continuous, System, convert_to_continuous
from orthaug.analysis.linear_view import Bode, Linearization, LinearView, bode_of, gain_of, poles_of
from orthaug.analysis.measured_response import measured_response
from orthaug.analysis.operating_points import OperatingPoint, Search, operating_points, parse_point
from orthaug.data.record import Record
from orthaug.fitting.estimates import Estimate
from orthaug.models.model import Model
from orthaug.physics.parameters import time_unit

_POINTS = 400  # of the frequency grid
_DECADES = 3  # below Nyquist's frequency at least
_BELOW = 10  # times below the slowest pole
_LOWEST = 1e-5  # of Nyquist's frequency
_STEEP = 0.1  # of its matrix: what differences may change before a kink is reported
_WIDE = 0.5  # standard error of ln G beyond which the delta method is rough


class _Spread(NamedTuple):
    """Cov(c, w) = root rootᵀ, of θ alone where the learner is `frozen`."""

    root: Float[np.ndarray, "n r"]
    freedom: float
    frozen: bool


def linearize(
    model: Model | Estimate,
    at: str | Mapping[str, float] | None = None,
    record: Record | None = None,
    *,
    frequencies: Any = None,
    continuous: str = "zoh",
) -> Linearization:
    """Return the model about its points of rest as linear systems, with 95 % intervals.

    Args:
        model: a fitted model; of a fit the record is that of training.
        at: inputs that are held, and outputs or states that are fixed, `"force=0, position=1"` or a
            mapping. Inputs that nobody names are 0, or their means over the record; with outputs or
            states fixed, they are looked for.
        record: measured data whose own frequency response is put beside.
        frequencies: of the frequency response [Hz]; by default 400 up to Nyquist's, on a
            logarithmic grid.
        continuous: how a lagged model is converted to continuous time, zoh or tustin.

    Raises:
        InputError: no point of rest, a name that the model does not have, a record that does not
            fit.

    Examples:
        >>> import orthaug as oa
        >>> u = [1.0, 2.0, 0.0, 3.0, 1.0, 0.0]
        >>> y = [0.0, 0.5, 1.25, 0.625, 1.8125, 1.40625]  # 0.5 (y[k-1] + u[k-1])
        >>> record = oa.Record.from_arrays(u=u, y=y)
        >>> physics = oa.Baseline.from_terms([oa.Term("a", "y[k-1]"), oa.Term("b", "u[k-1]")])
        >>> round(linearize(oa.estimate(record, physics, learner=None))[0].poles[0].z.real, 6)
        0.5
    """
    kinds = Model | Estimate
    check_type(model, kinds, "model", "a fitted model, or what estimate returns")
    check_type(record, Record | None, "record", "a Record, or None")
    check_choice(continuous, METHODS, "`continuous`")
    fit = None if isinstance(model, Model) else model
    if fit is not None:
        record = fit.problem.record if record is None else record
        model = fit.model
    assert isinstance(model, Model)
    if record is not None:
        record = model.fitting(record, need_outputs=False)
    frequency = _frequencies(frequencies, model.sampling_time)
    step, given = step_of(model), parse_point(at)
    held = moving = np.zeros(len(model.inputs))
    if record is not None and record.inputs:
        inputs = np.concatenate([experiment.inputs for experiment in record.experiments])
        held, moving = inputs.mean(axis=0), inputs.std(axis=0)
    outputs = [channel.name for channel in model.outputs]
    search = Search.of(step, model, outputs, given, held)
    points, warnings = operating_points(search)
    spread, of_spread = _spread(model, fit)
    warnings += of_spread
    if step.smooth:
        text = (
            "a spline through the record has no step: the sampled system is that of straight "
            "lines between samples, the frequency response that of the equations."
        )
        warnings.append(Warning("hold_replaced", text))
    views = tuple(
        _view(model, search, point, spread, frequency, continuous, moving) for point in points
    )
    measured = None if record is None else measured_response(record)
    return Linearization(views, measured, _held_clause(search, given, record), tuple(warnings))


def _held_clause(search: Search, given: Mapping[str, float], record: Record | None) -> str:
    """Return a clause on the source of inputs that nobody fixed."""
    if all(name in given for name in search.step.inputs):
        return "given"
    if search.free[len(search.step.rest) :].any():
        return "found"
    return "zero" if record is None else "mean"


def _frequencies(given: object, step: float) -> Vector | None:
    if given is None:
        return None
    try:
        found = np.array(given, dtype=float).reshape(-1)
    except (TypeError, ValueError, OverflowError):
        found = np.zeros(0)
    nyquist = 0.5 / step
    if (
        not len(found)
        or not np.isfinite(found).all()
        or np.any(found <= 0)
        or np.any(found > nyquist * (1 + 1e-9))
    ):
        raise InputError(
            f"`frequencies` must be numbers above 0 up to half the sampling rate, {nyquist:.6g} Hz."
        )
    return found


def _spread(model: Model, fit: Estimate | None) -> tuple[_Spread | None, list[Warning]]:
    """Return the covariance to take intervals from, and what is to be said of it."""
    joint, nt = model.statistics.joint(len(model.theta)), len(model.theta)
    if not model.form.differentiable:
        text = (
            "the learner has no derivatives (a function from another toolbox): finite "
            "differences replace them, and there are no intervals."
        )
        return None, [Warning("no_intervals", text)]
    if fit is not None and fit.std_kind == "none":
        text = (
            "the errors of the fit are correlated over too much of the record for standard errors; "
            "there are no intervals."
        )
        return None, [Warning("no_intervals", text)]
    if fit is not None and fit.plain_covariance is not None and not fit.learns:
        assert fit.covariance is not None
        return _Spread(_root(fit.covariance), float(fit.freedom), False), []
    if joint is not None and model.numbers.tilt is None:
        root = joint.root()
        if np.isfinite(root).all():
            return _Spread(root, model.statistics.freedom, False), []
    covariance = None if fit is None else fit.covariance
    if fit is not None and covariance is not None and np.isfinite(covariance).all() and nt:
        text = (
            "there is no joint covariance with the learner's weights; intervals are those of "
            "θ, with the learner frozen."
        )
        spread = _Spread(_root(covariance), float(fit.freedom), True)
        return spread, [Warning("learner_frozen", text)]
    text = (
        "the model has no covariance (an ensemble, or trained elsewhere); there are no intervals."
    )
    return None, [Warning("no_intervals", text)]


def _root(covariance: Matrix) -> Matrix:
    """Return R with `R Rᵀ` = the covariance."""
    values, vectors = np.linalg.eigh(covariance)
    return vectors * np.sqrt(np.maximum(values, 0.0))


def _view(
    model: Model,
    search: Search,
    point: OperatingPoint,
    spread: _Spread | None,
    frequency: Vector | None,
    method: str,
    moving: Vector,
) -> LinearView:
    sampled = _system(search, point, spread, model.sampling_time)
    warnings, step = _kinks(search, point, sampled), search.step
    freedom = np.inf if spread is None else spread.freedom
    names = step.states
    if step.ends == 2:
        sampled = _without_next(sampled)
        text = (
            "inputs run straight between samples: the sampled states are those of the motion "
            "less B₁ times the input."
        )
        warnings.append(Warning("shifted_states", text))
    own: System | None = None
    if step.continuous:
        own = _system(search, point, spread, None)
        found: Continuous | str = Continuous(own, np.zeros(len(step.inputs)), "equations", names)
    else:
        found = convert_to_continuous(sampled, method, step.memory, names)
    poles = poles_of(sampled, own, freedom)
    unit = time_unit((one.unit for one in model.estimated[0]), model.time_column)
    if not warnings or warnings[0].code != "kink":
        warnings += amplitude_warnings(
            search, point, sampled, own, poles, model.deviation, moving, unit
        )
    if any(
        pole.magnitude_ci95 and pole.magnitude_ci95[0] < 1 < pole.magnitude_ci95[1]
        for pole in poles
    ):
        text = (
            "the 95 % interval of a pole contains magnitude 1: the stability of the point is "
            "not certain."
        )
        warnings.append(Warning("stability_not_sure", text))
    gain, gain_ci95 = gain_of(sampled, freedom)
    bode, smooth = None, step.smooth
    if step.inputs:
        grid = _grid(poles, model.sampling_time) if frequency is None else frequency
        bode = bode_of(own if smooth and own is not None else sampled, grid, freedom)
        warnings += _rough(bode)
    units = model.units | step.units
    outputs = tuple(channel.name for channel in model.outputs)
    modes = sampled.modes.at_zero
    seen = (point, sampled, found, poles, modes, gain, gain_ci95, bode, names, step.inputs, outputs)
    return LinearView(*seen, units, freedom, tuple(warnings), smooth, unit)


def _system(
    search: Search, point: OperatingPoint, spread: _Spread | None, time: float | None
) -> System:
    """Return the matrices of a step of `time`, or of the equations, and their covariance."""
    step, numbers, field = search.step, search.numbers, time is None
    width = difference_widths(search.size, point.inputs)
    matrix = np.asarray(slope_at(step, field, numbers, point.rest, point.inputs, width))
    if not np.isfinite(matrix).all():
        raise InputError(
            f"the model has no finite derivative at {point}; give another operating point."
        )
    moved = None
    if spread is not None:
        weights = [] if spread.frozen else [np.asarray(numbers.weights)]
        unknowns = np.concatenate([np.asarray(numbers.theta), *weights])
        ne, root = len(point.rest), spread.root
        change = np.asarray(unrest_along(step, numbers, point.rest, point.inputs, unknowns, root))
        rows = [*range(ne), *(ne + i for i in point.slopes.outputs)]
        along = point.slopes.follow(change[rows])
        moved = np.asarray(
            slope_along(
                step,
                field,
                numbers,
                point.rest,
                point.inputs,
                unknowns,
                (along[:ne], along[ne:], root),
            )
        )
        moved = np.where(np.isfinite(moved), moved, 0.0)
    return System(matrix, len(step.states), time, moved)


def _without_next(system: System) -> System:
    """Return the system without inputs of the next sample: `z = x − B₁ u` (first-order hold)."""

    def rewritten(matrix: Matrix, moved: Matrix | None = None) -> Matrix:
        """Return the matrices, or their change `moved`, in the new state."""
        n = system.states
        nu = (matrix.shape[1] - n) // 2
        a, b1, c = matrix[:n, :n], matrix[:n, n + nu :], matrix[n:, :n]
        first = matrix if moved is None else moved
        found = first[:, : n + nu].copy()
        if moved is None:
            return found + np.block([[np.zeros((n, n)), a @ b1], [np.zeros((len(c), n)), c @ b1]])
        da, db1, dc = moved[:n, :n], moved[:n, n + nu :], moved[n:, :n]
        added = [[np.zeros((n, n)), da @ b1 + a @ db1], [np.zeros((len(c), n)), dc @ b1 + c @ db1]]
        return found + np.block(added)

    moved = None
    if system.moved is not None:
        moved = np.array([rewritten(system.matrix, one) for one in system.moved]).reshape(
            len(system.moved), *_shape(system)
        )
    return System(rewritten(system.matrix), system.states, system.step, moved)


def _shape(system: System) -> tuple[int, int]:
    n = system.states
    return len(system.matrix), n + (system.matrix.shape[1] - n) // 2


def _kinks(search: Search, point: OperatingPoint, system: System) -> list[Warning]:
    """Return warnings where differences give another slope than the derivative.

    The view then holds in no neighbourhood of the point.
    """
    if not search.step.form.differentiable:
        return []
    width, n = difference_widths(search.size, point.inputs), system.states
    sides, full = map(
        np.asarray, one_sided(search.step, search.numbers, point.rest, point.inputs, width)
    )
    unit = full[:n] / full[:n, None]  # entries in sizes of the states
    apart = np.abs(sides[:, :, :n] - system.a) * unit
    if np.all(apart <= _STEEP * np.abs(system.a * unit).max(initial=1e-300)):
        return []
    text = (
        "the slope changes abruptly at this point, within a thousandth of the training data's "
        "size (such as dry friction at rest): the linear system holds for smaller movements "
        "only."
    )
    return [Warning("kink", text)]


def _grid(poles: Any, step: float) -> Vector:
    nyquist = 0.5 / step
    slow = [pole.hertz / _BELOW for pole in poles if pole.hertz]
    lowest = min([nyquist * 10.0**-_DECADES, *slow])
    return np.geomspace(max(lowest, _LOWEST * nyquist), nyquist, _POINTS)


def _rough(bode: Bode) -> list[Warning]:
    if bode.magnitude_ci95 is None:
        return []
    with np.errstate(all="ignore"):
        wide = np.log(bode.magnitude_ci95[..., 1] / bode.magnitude_ci95[..., 0]) > 4 * _WIDE
    share = float(np.mean(wide))
    if share < 0.05:
        return []
    text = (
        f"at {percent(share)} of the frequencies the band is so wide that the delta method is "
        "only approximate."
    )
    return [Warning("wide_band", text)]
