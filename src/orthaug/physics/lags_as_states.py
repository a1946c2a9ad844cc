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

from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass, replace

from orthaug._base.errors import InputError
from orthaug.data.expressions import Lag, parse, with_names
from orthaug.data.regressors import Lags, Layout, in_order
from orthaug.physics.baseline import Baseline, regressor_of
from orthaug.physics.motion import Motion
from orthaug.physics.parameters import PhysicalParameter, PhysicsMap, check_baseline
from orthaug.physics.states import Output, State

_MOST_STATES = 64
_LONGEST_SUM = 400  # characters: an expression has at most 500


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
        InputError: physics of a function, of too many lags, or with names that a motion cannot
            have; what lagged physics refuses.
    """
    if baseline.function is not None:
        raise InputError(
            "lagged physics of a Python function is no motion: declare its terms, or leave the "
            "learner's `states` out."
        )
    baseline.check_channels(outputs, inputs)
    if physics is not None:
        of_p = [term if term.fixed else replace(term, initial=None) for term in baseline.terms]
        check_baseline(physics, Baseline.from_terms(of_p, dict(baseline.constants)))
    seen = None if learner_inputs is None else tuple(learner_inputs)
    layout, features = regressor_of(baseline, lags, seen, tuple(outputs), tuple(inputs))
    constants = dict(baseline.constants)
    read = [lag for text in further for lag in parse(text, constants).lags]
    all_lags = in_order((*layout, *read), outputs, inputs)
    advanced = tuple(dict.fromkeys(lag.channel for lag in all_lags if lag.lag == 0))
    taken = {*baseline.names_taken, *(() if physics is None else physics.names)}
    names = _names_of(all_lags, outputs, inputs, advanced, taken)
    theta, define = _definitions_of(physics, taken | {*names.values()})
    equations: dict[str, str] = {}
    for output in outputs:
        terms = _terms_of(baseline, output, names, theta)
        equations[output] = _sum_of(terms, output, define, taken | {*names.values()})
    states = [
        *(State(name, equations[name], name, learned=True) for name in outputs),
        *(
            State(name, names[Lag(lag.channel, lag.lag - 1)], _start(lag, outputs))
            for lag, name in names.items()
            if name != lag.channel
        ),
    ]
    if len(states) > _MOST_STATES:
        raise InputError(
            f"beside a learner with `states` every earlier sample is a state: {len(states)} here, "
            f"and at most {_MOST_STATES} are possible. Write the physics with fewer lags, or leave "
            "the learner's `states` out."
        )
    own = (
        [PhysicalParameter(p.name, p.initial, p.unit, p.min, p.max) for p in baseline.parameters]
        if physics is None
        else physics.parameters
    )
    try:
        motion = Motion.from_equations(
            states,
            [Output(name, name) for name in outputs],
            own,
            inputs,
            constants=constants,
            define=define,
            integrator="discrete",
        )
    except InputError as error:
        raise InputError(
            f"lagged physics beside a learner with `states` is written as a motion: {error}"
        ) from None
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
            name = _free_name(f"{channel}_{lag - last}", taken)
            taken.add(name)
            names[Lag(channel, lag)] = name
    return names


def _free_name(name: str, taken: Container[str]) -> str:
    """Return a name, with underscores behind it where it is taken."""
    while name in taken:
        name += "_"
    return name


def _definitions_of(
    physics: PhysicsMap | None, taken: set[str]
) -> tuple[dict[str, str], dict[str, str]]:
    """Return the names of θ in the motion, and the definitions of θ by physical parameters."""
    theta: dict[str, str] = {}
    define: dict[str, str] = {}
    for name, given in (
        () if physics is None else zip(physics.theta_names, physics.expressions, strict=True)
    ):
        if str(given) == name:  # θ that is a physical parameter itself
            continue
        clashes = physics is not None and name in physics.names
        theta[name] = _free_name(name, taken) if clashes else name
        define[theta[name]] = str(given)
    return theta, define


def _terms_of(
    baseline: Baseline, output: str, names: Mapping[Lag, str], theta: Mapping[str, str]
) -> list[str]:
    """Return the summands of an output's next sample; what is fixed is a number."""
    constants = dict(baseline.constants)
    found = []
    for term in baseline.terms:
        if term.output in (None, output):
            factor = with_names(parse(term.regressor, constants), names)
            factor = factor if factor.isidentifier() else f"({factor})"
            own = theta.get(term.parameter, term.parameter)
            found.append(
                f"{float(term.initial or 0.0)!r}*{factor}" if term.fixed else f"{own}*{factor}"
            )
    return found or ["0.0"]


def _sum_of(terms: Sequence[str], output: str, define: dict[str, str], taken: set[str]) -> str:
    """Return a sum, in parts that `define` takes where it is too long for one expression."""
    if len(" + ".join(terms)) <= _LONGEST_SUM:
        return " + ".join(terms)
    parts: list[list[str]] = [[]]
    for term in terms:
        if parts[-1] and len(" + ".join([*parts[-1], term])) > _LONGEST_SUM:
            parts.append([])
        parts[-1].append(term)
    named = []
    for i, part in enumerate(parts, 1):
        name = _free_name(f"{output}_part{i}", taken | {*define})
        define[name] = " + ".join(part)
        named.append(name)
    return " + ".join(named)


def _start(lag: Lag, outputs: Sequence[str]) -> str | None:
    """Return the first guess of a state that holds an earlier sample: the first one of an output.

    Starts are estimated; an input's earlier samples begin at zero.
    """
    return lag.channel if lag.channel in outputs else None
