"""Linear views as text: what `orthaug linearize` prints."""

from __future__ import annotations

from typing import Any

import numpy as np

from orthaug._base.lines import estimate_cells, fold, table
from orthaug.analysis.linear_system import Continuous
from orthaug.analysis.linear_view import COHERENT, Linearization, LinearView, Pole
from orthaug.reports.linear import gain_unit

_MOST = 8  # states of matrices that are printed; result.json has all
_FEWEST = 10  # frequencies from data that a median needs
_HELD = {
    "zero": "inputs that --at does not name are held at 0",
    "mean": "inputs that --at does not name are held at their means over the data",
    "found": "inputs that --at does not name take the values that this point requires",
}


def linear_text(found: Linearization) -> str:
    """Return all operating points as text, each with gains, poles and matrices.

    The response from data, and warnings, follow.
    """
    blocks = []
    for i, view in enumerate(found):
        head = "operating point" if len(found) == 1 else f"operating point {i + 1} of {len(found)}"
        outside = ", outside of the training data" if view.point.outside else ""
        blocks.append([f"{head}: {_point_text(view)} ({_stability(view)}{outside})"])
        if i == 0 and found.held in _HELD:
            blocks[0].append(_HELD[found.held])
        blocks += [
            _gains(view),
            _poles(view),
            *_matrices(view),
            _continuous(view),
            _agreement(found, view),
        ]
        blocks.append([f"warning: {warning.text}" for warning in view.warnings])
    if all(view.system.moved is not None for view in found):
        blocks.append(
            [
                "Numbers after ± and in brackets are 95 % (delta method, joint covariance of θ "
                "and weights)."
            ]
        )
    blocks.append([f"warning: {warning.text}" for warning in found.warnings])
    return "\n\n".join("\n".join(fold(lines)) for lines in blocks if lines)


def _stability(view: LinearView) -> str:
    if view.stable:
        return "stable"
    largest = max(pole.magnitude for pole in view.poles)
    return "not stable" if largest > 1 + 1e-9 else "at the limit of stability"


def _point_text(view: LinearView) -> str:
    named = view.point.outputs | view.point.values
    order = [*view.inputs, *(name for name in named if name not in view.inputs)]
    return ", ".join(f"{name} = {named[name] + 0.0:.6g}{_unit(view, name)}" for name in order)


def _unit(view: LinearView, name: str) -> str:
    unit = view.units.get(name, "")
    return f" {unit}" if unit else ""


def _gains(view: LinearView) -> list[str]:
    if not view.inputs:
        return ["no inputs: no gains and no frequency response"]
    if view.gain is None:
        return ["static gain: none, because a pole at 1 integrates"]
    rows = [["static gain", "value", "95 % interval", "unit"]]
    for i, j in np.ndindex(*view.gain.shape):
        ends = None if view.gain_ci95 is None else view.gain_ci95[i, j]
        name, unit = f"{view.outputs[i]} / {view.inputs[j]}", gain_unit(view, i, j)
        rows.append([name, *_with_interval(float(view.gain[i, j]), ends), unit])
    return table(rows)


def _poles(view: LinearView) -> list[str]:
    between = "95 % interval"
    rows = [["pole z", "magnitude", between, "frequency", between, "", "damping", between]]
    for pole in view.poles:
        if pole.z.imag < 0:
            continue  # its conjugate is listed
        magnitude = _with_interval(pole.magnitude, pole.magnitude_ci95)
        hertz, spread = _with_interval(pole.hertz, pole.hertz_ci95)
        damping, damping_spread = _with_interval(pole.damping, pole.damping_ci95)
        rate = "–"
        if pole.natural_frequency is not None:
            rate = f"{pole.natural_frequency:.5g} 1/{view.time_unit}"
        last = (
            damping_spread
            if pole.time_constant is None
            else f"time constant {pole.time_constant:.5g} {view.time_unit}"
        )
        unit = "" if pole.hertz is None else f" {view.frequency_unit}"
        rows.append([_z(pole), *magnitude, f"{hertz}{unit}", spread, rate, damping, last])
    lines = table(rows) if len(rows) > 1 else []
    if view.at_zero:
        times = "once" if view.at_zero == 1 else f"{view.at_zero} times"
        lines.append(f"pole 0, {times}: dead time, and past inputs in the state")
    return lines or ["no poles"]


def _z(pole: Pole) -> str:
    if abs(pole.z.imag) <= 1e-9 * pole.magnitude:
        return f"{pole.z.real:.6g}"
    return f"{pole.z.real:.6g} ± {pole.z.imag:.6g}i"


def _matrices(view: LinearView) -> list[list[str]]:
    n, (ny, nu) = view.system.states, view.d.shape
    if n > _MOST or nu > _MOST or ny > _MOST:
        return [[f"A {n} × {n}, B {n} × {nu}, C {ny} × {n}, D {ny} × {nu}: in result.json (--out)"]]
    std = view.system.std
    half = None if std is None else (view.matrix_ci95[..., 1] - view.system.matrix)  # type: ignore[index]
    names = [f"δ{name}" for name in (*view.states, *view.inputs)]
    rows = [["sampled", *names]]
    for i, name in enumerate((*view.states, *view.outputs)):
        label = f"δ{name} next" if i < n else f"δ{name}"
        cells = [
            _cell(view.system.matrix[i, j], None if half is None else half[i, j])
            for j in range(n + nu)
        ]
        rows.append([label, *cells])
    return [
        [f"Ts = {view.sampling_time:.6g} {view.time_unit}; rows of [A B] and [C D]:", *table(rows)]
    ]


def _cell(value: float, half: float | None) -> str:
    shown, spread, _, _ = estimate_cells(value, half)
    return shown if not half else f"{shown} ± {spread}"


def _continuous(view: LinearView) -> list[str]:
    found = view.continuous
    if not isinstance(found, Continuous):
        return [f"no system in continuous time: {found}"]
    how = {
        "equations": "from the equations",
        "zoh": "by the matrix logarithm",
        "tustin": "by Tustin's rule",
    }
    if view.inputs:
        how["zoh"] = "for inputs held between samples"
    n, (ny, nu) = found.system.states, found.system.d.shape
    lines = [f"in continuous time, {how[found.method]}:"]
    if n > _MOST or nu > _MOST or ny > _MOST:
        return [f"in continuous time, {how[found.method]}: {n} states, in result.json (--out)"]
    rows = [["", *(f"δ{name}" for name in (*found.states, *view.inputs))]]
    for i, name in enumerate((*found.states, *view.outputs)):
        label = f"d/dt δ{name}" if i < n else f"δ{name}"
        rows.append([label, *(f"{value:.6g}" for value in found.system.matrix[i])])
    lines += table(rows)
    late = [
        f"{name} {dead:.6g} {view.time_unit}"
        for name, dead in zip(view.inputs, found.dead_time, strict=True)
        if dead > 0
    ]
    return [*lines, *([f"dead time of inputs: {', '.join(late)}"] if late else [])]


def _agreement(found: Linearization, view: LinearView) -> list[str]:
    if found.measured is None:
        return []
    how = "whole periods of the input" if found.measured.method == "periods" else "Welch's spectra"
    agreement = found.agreement(view)
    if agreement is None or agreement.points < _FEWEST:
        few = "no" if agreement is None else f"only {agreement.points}"
        return [
            f"data alone ({how}) give {few} points of the response with a coherence of "
            f"{COHERENT} or more"
        ]
    return [
        f"against data alone ({how}, {agreement.points} points of coherence {COHERENT} or "
        f"more): median difference {agreement.decibel:.2g} dB and {agreement.degrees:.2g} "
        "degrees"
    ]


def _with_interval(value: float | None, ends: Any) -> list[str]:
    """Return a value and its interval with equal decimals; no text where there is no interval."""
    shown, _, low, high = estimate_cells(value, None, ends)
    return [shown, "" if ends is None else f"[{low}, {high}]"]
