"""Lagged physics as a discrete motion, whose states are its lags.

    y_k = Σ θ_i φ_i(y_{k−1} … y_{k−n}, u_{k−1} … u_{k−m})

is a motion of the states `y`, `y_1` = y[k−1], … and `u_1` = u[k−1], …, of which each takes the
place of the one before it after a sample:

    y⁺ = Σ θ_i φ_i,    y_1⁺ = y,    u_1⁺ = u,    u_2⁺ = u_1

So lagged physics has what only motions have: a learner with states of its own. θ is then that of
the free run. A state follows from the samples before it: of an input with a present sample, u_k,
the motion's input is the one of the row after, so that u_k is its last sample.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from orthaug._base.errors import InputError
from orthaug.data.expressions import Lag, parse, with_names
from orthaug.data.regressors import Lags, Layout, in_order
from orthaug.physics.baseline import Baseline, regressor_of
from orthaug.physics.motion import Motion
from orthaug.physics.parameters import PhysicalParameter, PhysicsMap
from orthaug.physics.states import Output, State


@dataclass(frozen=True)
class LaggedMotion:
    """A motion that is lagged physics, what the learner sees in it, and its names of raw lags."""

    motion: Motion
    learner_inputs: tuple[str, ...]
    names: Mapping[Lag, str]
    advanced: tuple[str, ...]
    """The inputs that have to come a row earlier, by `prepare(record, Shift(name, -1))`."""

    def named(self, expression: str) -> str:
        """Return an expression of lags as one of states and inputs: `y[k-2]*u[k-1]` is `y_1 * u`.

        Raises:
            InputError: it reads a lag that the motion does not have.
        """
        return with_names(parse(expression, dict(self.motion.constants)), self.names)


def motion_of_lags(
    baseline: Baseline,
    lags: Lags | None,
    learner_inputs: Sequence[str] | None,
    outputs: Sequence[str],
    inputs: Sequence[str],
    *,
    physics: PhysicsMap | None = None,
    further: Sequence[str] = (),
) -> LaggedMotion:
    """Return lagged physics as a discrete motion with a learner in the equation of every output.

    Args:
        lags: of the learner; None for those of the physics.
        learner_inputs: expressions of lags that it sees; None for all lags.
        physics: physical parameters of which θ are functions; None for θ itself.
        further: expressions of lags that the motion has to have a name for.

    Raises:
        InputError: physics of a function.
    """
    if baseline.function is not None:
        raise InputError(
            "lagged physics of a Python function is no motion: declare its terms, or leave the "
            "learner's `states` out."
        )
    seen = None if learner_inputs is None else tuple(learner_inputs)
    layout, features = regressor_of(baseline, lags, seen, tuple(outputs), tuple(inputs))
    constants = dict(baseline.constants)
    read = [lag for text in further for lag in parse(text, constants).lags]
    all_lags = in_order((*layout, *read), outputs, inputs)
    advanced = tuple(dict.fromkeys(lag.channel for lag in all_lags if lag.lag == 0))
    names = _names_of(all_lags, outputs, inputs, advanced, {*baseline.names, *constants})
    states = [
        *(State(name, _next_output(baseline, name, names), name, learned=True) for name in outputs),
        *(
            State(name, names[Lag(lag.channel, lag.lag - 1)], _start(lag, outputs))
            for lag, name in names.items()
            if name != lag.channel
        ),
    ]
    own = (
        [PhysicalParameter(p.name, p.initial, p.unit, p.min, p.max) for p in baseline.parameters]
        if physics is None
        else physics.parameters
    )
    fixed = {term.parameter: float(term.initial or 0.0) for term in baseline.terms if term.fixed}
    of_p = [] if physics is None else zip(physics.theta_names, physics.expressions, strict=True)
    motion = Motion.from_equations(
        states,
        [Output(name, name) for name in outputs],
        own,
        inputs,
        constants=constants | fixed,
        define={name: str(expression) for name, expression in of_p},
        integrator="discrete",
    )
    shown = tuple(with_names(expression, names) for expression in features.entries)
    return LaggedMotion(motion, shown, names, advanced)


def _names_of(
    lags: Layout,
    outputs: Sequence[str],
    inputs: Sequence[str],
    advanced: Sequence[str],
    taken: set[str],
) -> dict[Lag, str]:
    """Return the name of every lag down to the deepest of each channel: `y`, `y_1`, `y_2`."""
    names: dict[Lag, str] = {}
    taken = taken | {*outputs, *inputs}
    for channel in (*outputs, *inputs):
        last = 0 if channel in advanced else 1
        names[Lag(channel, last)] = channel
        deepest = max((lag.lag for lag in lags if lag.channel == channel), default=last)
        for lag in range(last + 1, deepest + 1):
            name = f"{channel}_{lag - last}"
            while name in taken:
                name += "_"
            taken.add(name)
            names[Lag(channel, lag)] = name
    return names


def _next_output(baseline: Baseline, output: str, names: Mapping[Lag, str]) -> str:
    """Return the equation of an output's next sample."""
    constants = dict(baseline.constants)
    terms = [
        f"{term.parameter}*{_factor(with_names(parse(term.regressor, constants), names))}"
        for term in baseline.terms
        if term.output in (None, output)
    ]
    return " + ".join(terms) or "0.0"


def _factor(text: str) -> str:
    """Return an expression as a factor of a product."""
    return text if text.isidentifier() else f"({text})"


def _start(lag: Lag, outputs: Sequence[str]) -> str | None:
    """Return the first guess of a state that holds an earlier sample: the first one of an output.

    Starts are estimated; an input's earlier samples begin at zero.
    """
    return lag.channel if lag.channel in outputs else None
