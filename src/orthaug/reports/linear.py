"""Results of `orthaug linearize`."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np

from orthaug._base.content import ByName, Content, Flag, Number, Numbers, Whole
from orthaug._base.errors import Warning
from orthaug.analysis.linear_view import Linearization, LinearView, Pole, phase_of
from orthaug.analysis.measured_response import MeasuredResponse
from orthaug.reports.result import ResultHeader

Rows = list[Numbers]
Intervals = list[list[Numbers]]


class PoleResult(Content):
    """A pole of the sampled system, and in continuous time."""

    real: Number
    imaginary: Number
    magnitude: Number
    magnitude_ci95: Numbers | None
    continuous_real: Number
    continuous_imaginary: Number
    natural_frequency: Number
    natural_frequency_ci95: Numbers | None
    hertz: Number
    hertz_ci95: Numbers | None
    damping: Number
    damping_ci95: Numbers | None
    time_constant: Number

    @classmethod
    def of(cls, pole: Pole) -> PoleResult:
        """Return the result of a view's pole."""
        s = pole.s
        own = {name: getattr(pole, name) for name in cls.model_fields if hasattr(pole, name)}
        own = {
            name: list(value) if isinstance(value, tuple) else value for name, value in own.items()
        }
        parts = {"real": pole.z.real, "imaginary": pole.z.imag}
        parts |= {
            "continuous_real": None if s is None else s.real,
            "continuous_imaginary": None if s is None else s.imag,
        }
        return cls.model_validate(own | parts)


class ContinuousResult(Content):
    """The system in continuous time; without one the reason."""

    method: str | None
    reason: str | None
    states: list[str] | None
    a: Rows | None
    b: Rows | None
    c: Rows | None
    d: Rows | None
    dead_time: Numbers | None


class GainResult(Content):
    """∂y/∂u at rest; null where the system integrates."""

    output: str
    input: str
    unit: str
    value: Number
    ci95: Numbers | None


class ResponseResult(Content):
    """The frequency response from an input to an output, over the point's frequencies."""

    output: str
    input: str
    unit: str
    magnitude: Numbers
    magnitude_low: Numbers | None
    magnitude_high: Numbers | None
    phase: Numbers
    phase_low: Numbers | None
    phase_high: Numbers | None


class MatricesResult(Content):
    """A, B, C, D, and the 95 % intervals of their entries."""

    a: Rows
    b: Rows
    c: Rows
    d: Rows
    a_ci95: Intervals | None
    b_ci95: Intervals | None
    c_ci95: Intervals | None
    d_ci95: Intervals | None


class LinearPointResult(Content):
    """The linear system at a point of rest."""

    absent: ClassVar = frozenset({"time_unit"})

    at: ByName
    outputs: ByName
    outside: Flag
    stable: Flag
    states: list[str]
    matrices: MatricesResult
    poles: list[PoleResult]
    poles_at_zero: Whole
    time_unit: str | None = None
    """The unit of time, where the equations are not in s."""
    static_gain: list[GainResult]
    continuous: ContinuousResult
    frequency: Numbers
    response: list[ResponseResult]
    median_difference_db: Number
    median_difference_deg: Number
    warnings: list[Warning]


class MeasuredPairResult(Content):
    """The frequency response of one pair from the data."""

    output: str
    input: str
    magnitude: Numbers
    phase: Numbers
    coherence: Numbers


class MeasuredResponseResult(Content):
    """The frequency response from the data, without the model."""

    method: str
    averages: Number
    frequency: Numbers
    response: list[MeasuredPairResult]


class LinearizeResult(ResultHeader):
    """The result of `orthaug linearize`."""

    sampling_time: Number
    inputs: list[str]
    output_names: list[str]
    held: str
    points: list[LinearPointResult]
    measured: MeasuredResponseResult | None
    warnings: list[Warning]

    @classmethod
    def of(cls, found: Linearization) -> LinearizeResult:
        """Return the result of what `linearize` returns."""
        first = found[0]
        return cls.model_validate(
            {
                "sampling_time": first.sampling_time,
                "inputs": list(first.inputs),
                "output_names": list(first.outputs),
                "held": found.held,
                "points": [_point(view, found) for view in found],
                "measured": None
                if found.measured is None
                else _measured_entry(found.measured, first),
                "warnings": list(found.warnings),
            }
        )


def gain_unit(view: LinearView, i: int, j: int) -> str:
    """Return the unit of output i over that of input j."""
    upper, lower = view.units.get(view.outputs[i], ""), view.units.get(view.inputs[j], "")
    if not lower:
        return upper
    wrapped = [f"({unit})" if set(unit) & set(" /*·") else unit for unit in (upper or "1", lower)]
    return "/".join(wrapped)


def _point(view: LinearView, found: Linearization) -> dict[str, object]:
    agreement = found.agreement(view)
    return {
        "at": view.point.values,
        "outputs": view.point.outputs,
        "outside": view.point.outside,
        "stable": view.stable,
        "states": list(view.states),
        "matrices": _matrices(view),
        "poles": [PoleResult.of(pole) for pole in view.poles],
        "poles_at_zero": view.at_zero,
        "time_unit": None if view.time_unit == "s" else view.time_unit,
        "static_gain": [_gain(view, i, j) for i, j in np.ndindex(*view.d.shape)],
        "continuous": _continuous(view),
        "frequency": [] if view.bode is None else view.bode.frequency,
        "response": []
        if view.bode is None
        else [_response(view, i, j) for i, j in np.ndindex(*view.d.shape)],
        "median_difference_db": None if agreement is None else agreement.decibel,
        "median_difference_deg": None if agreement is None else agreement.degrees,
        "warnings": list(view.warnings),
    }


def _matrices(view: LinearView) -> dict[str, object]:
    n, found = view.system.states, {}
    parts = {"a": np.s_[:n, :n], "b": np.s_[:n, n:], "c": np.s_[n:, :n], "d": np.s_[n:, n:]}
    for name, part in parts.items():
        found[name] = view.system.matrix[part].tolist()
        found[f"{name}_ci95"] = (
            None if view.matrix_ci95 is None else view.matrix_ci95[part].tolist()
        )
    return found


def _pair(view: LinearView, i: int, j: int) -> dict[str, object]:
    return {"output": view.outputs[i], "input": view.inputs[j], "unit": gain_unit(view, i, j)}


def _gain(view: LinearView, i: int, j: int) -> dict[str, object]:
    return _pair(view, i, j) | {
        "value": None if view.gain is None else view.gain[i, j],
        "ci95": None if view.gain_ci95 is None else view.gain_ci95[i, j],
    }


def _continuous(view: LinearView) -> dict[str, Any]:
    found = view.continuous
    if isinstance(found, str):
        return dict.fromkeys(ContinuousResult.model_fields) | {"reason": found}
    own = {name: getattr(found.system, name).tolist() for name in "abcd"}
    return own | {
        "method": found.method,
        "reason": None,
        "states": list(found.states),
        "dead_time": found.dead_time,
    }


def _response(view: LinearView, i: int, j: int) -> dict[str, object]:
    bode = view.bode
    assert bode is not None
    fields = _pair(view, i, j)
    for name, band in (("magnitude", bode.magnitude_ci95), ("phase", bode.phase_ci95)):
        fields[name] = getattr(bode, name)[:, i, j]
        fields[f"{name}_low"] = None if band is None else band[:, i, j, 0]
        fields[f"{name}_high"] = None if band is None else band[:, i, j, 1]
    return fields


def _measured_entry(measured: MeasuredResponse, view: LinearView) -> dict[str, object]:
    phases = phase_of(measured.value)
    pairs = [
        {
            "output": view.outputs[i],
            "input": view.inputs[j],
            "magnitude": np.abs(measured.value[:, i, j]),
            "phase": phases[:, i, j],
            "coherence": measured.coherence[:, i],
        }
        for i, j in np.ndindex(*view.d.shape)
    ]
    return {
        "method": measured.method,
        "averages": measured.averages,
        "frequency": measured.frequency,
        "response": pairs,
    }
