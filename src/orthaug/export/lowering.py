"""Fitted models in the intermediate form."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from orthaug._base.checks import Vector
from orthaug._base.errors import InputError
from orthaug._base.lines import with_unit
from orthaug.data.channels import Channel
from orthaug.data.expressions import Expression, Lag
from orthaug.data.preparation import MENDING
from orthaug.export.nodes import Apply, Entry, Name, Node, Number, apply, identifier, node_of, total
from orthaug.export.physics_nodes import NodesOfMotion, PhysicsNodes
from orthaug.export.program import Block, Constant, Layer, Network, Program, Scheme, Signal
from orthaug.models.beyond import FADED
from orthaug.models.dynamics import Numbers
from orthaug.models.lagged import LaggedDynamics
from orthaug.models.learners import ACTIVATIONS, Bound
from orthaug.models.model import HoldsModel, Model, model_of
from orthaug.models.motion_field import MotionField
from orthaug.models.moving import MotionDynamics
from orthaug.models.stepping import Memory


@dataclass(frozen=True, eq=False)
class FadeNodes:
    """Nodes of the intermediate results of a limited correction.

    They are the features on the range of training, the point x̄ there, and the factor of fading.
    """

    locals: tuple[tuple[str, Node], ...]
    features: tuple[Node, ...]
    """z̄ (nz,)."""
    inside: tuple[Node, ...]
    """x̄ (nx,), in the order of the points that were given."""
    share: Node | None
    """None where the correction is held."""

    @classmethod
    def of(
        cls,
        form: LaggedDynamics | MotionField,
        numbers: Numbers,
        features: Sequence[Node],
        points: Sequence[Node],
    ) -> FadeNodes:
        """Return the intermediate results for features z (nz,) of a point x (nx,)."""
        low, high = np.asarray(numbers.limits).tolist()
        found: dict[str, Node] = {}

        def name(key: str, node: Node) -> Node:
            found[key] = node
            return Name(key)

        seen = [name(f"h_seen_{i}", node) for i, node in enumerate(features)]
        inside = [
            name(f"h_inside_{i}", apply("min", apply("max", node, Number(low[i])), Number(high[i])))
            for i, node in enumerate(seen)
        ]
        over = [apply("sub", there, node) for there, node in zip(inside, seen, strict=True)]
        moved = []
        for j, (point, row) in enumerate(
            zip(points, np.asarray(numbers.pull).tolist(), strict=True)
        ):
            steps = [apply("mul", Number(by), over[i]) for i, by in enumerate(row) if by]
            moved.append(name(f"h_point_{j}", total([point, *steps])) if steps else point)
        share = None
        if form.beyond == "fade":
            halves = [(b - a) / 2 or 1.0 for a, b in zip(low, high, strict=True)]
            apart = [
                apply("div", step, Number(half * FADED))
                for step, half in zip(over, halves, strict=True)
            ]
            squares = total([apply("mul", part, part) for part in apart])
            share = name("h_share", apply("exp", apply("neg", squares)))
        return cls(tuple(found.items()), tuple(inside), tuple(moved), share)

    @property
    def symbols(self) -> dict[str, str]:
        """Names of the intermediate results for a reader, numbered from 1 like the features."""
        return {key: _read(key) for key, _ in self.locals}

    def fade(self, correction: Node) -> Node:
        """Return a correction multiplied by the factor of fading."""
        return correction if self.share is None else apply("mul", self.share, correction)


def _read(key: str) -> str:
    """Return `h_inside_0` as `inside_1`."""
    _, kind, *number = key.split("_")
    return "_".join([kind, *(str(int(i) + 1) for i in number)])


_OWN_FUNCTION = (
    "is a Python function, which no target can write; give it as expressions, or call "
    "`model.step` where Python with JAX runs"
)


def program_of(model: Model | HoldsModel, name: str = "model", digest: str = "") -> Program:
    """Return the step of a model in the intermediate form, that of the plant of a loop.

    Raises:
        InputError: physics or a learner that is a Python function, an ensemble, a hold that needs
            the whole record.
    """
    model = model_of(model).plant
    numbers = model.numbers
    if not all(np.isfinite(np.asarray(values)).all() for values in numbers[:6]):
        raise InputError("the model holds numbers that are not finite; fit it again.")
    prepared = ", ".join(done.named for done in model.prepared if done.step not in MENDING)
    return replace(_LOWERED[type(model.form)](model, name, digest), preparation=prepared)


class _Constants:
    """Named numbers of expressions, each under one name."""

    def __init__(self) -> None:
        self.found: dict[str, Constant] = {}
        self.symbols: dict[str, str] = {}

    def node(self, kind: str, name: str, value: float, meaning: str) -> Name:
        """Return the constant's node, `p_` for parameters and `c_` for others before its name.

        Another value under the same name gets a name of its own.
        """
        first = written = f"{kind}_{identifier(name)}"
        i = 2
        while written in self.found and self.found[written].value != value:
            written, i = f"{first}_{i}", i + 1
        self.found[written] = Constant(written, float(value), meaning)
        self.symbols[written] = name
        return Name(written)

    def of(self, expression: Expression) -> dict[str, Node]:
        """Return the constants of an expression of lagged channels."""
        return {
            name: self.node("c", name, value, f"constant {name}")
            for name, value in expression.constants
        }


def _lower_lagged(model: Model, name: str, digest: str) -> Program:
    form, numbers = model.form, model.numbers
    memory = Memory.of(form.layout, form.outputs, model.step_inputs)
    if form.baseline.function is not None:
        raise InputError(f"the physics {_OWN_FUNCTION}.")
    if numbers.tilt is not None:
        raise InputError(
            "the model is an ensemble, whose learner is the median of several; fit with "
            "`restarts` but without an ensemble to export it, or call `model.step` where "
            "Python with JAX runs."
        )
    channels = {channel.name: channel for channel in (*model.outputs, *model.inputs)}
    lags: dict[Lag, Node] = {lag: Entry("x", i) for i, lag in enumerate(memory.lags)}
    lags |= {Lag(channel, 0): Entry("u", i) for i, channel in enumerate(memory.inputs)}
    constants = _Constants()

    def lower_expression(expression: Expression, lags: Mapping[Lag, Node] = lags) -> Node:
        return node_of(expression, constants.of(expression), lags, dict(expression.constants))

    limited = numbers.limits is not None
    features = [lower_expression(entry) for entry in form.features.entries]
    held = (
        FadeNodes.of(form, numbers, features, [lags[lag] for lag in form.layout])
        if limited
        else None
    )
    constants.symbols |= {} if held is None else held.symbols
    sums, corrections = _weighted_terms(model, constants, lower_expression, held)
    network = None
    if form.learns:
        seen = features if held is None else held.features
        network = _network(form.bound, numbers, seen, np.arange(len(form.outputs)))
        for i, summands in enumerate(sums):
            correction = total([Entry("g", i), *corrections[i]])
            summands.append(correction if held is None else held.fade(correction))
    results = tuple(map(total, sums))
    read = (*results, *(network.features if network is not None else ()))
    defined = {} if held is None else dict(held.locals)
    # x̄ of a lag that the physics does not read would be an unused variable of C
    block = Block("output", _needed_definitions(defined, read), network, results)
    lines = tuple((_signal(channels[channel]), depth) for channel, depth in memory.depths)
    states = tuple(
        Signal(str(lag), f"{identifier(lag.channel)}_{lag.lag}", channels[lag.channel].unit)
        for lag in memory.lags
    )
    return Program(
        name=name,
        states=states,
        inputs=tuple(map(_signal, model.inputs)),
        outputs=tuple(map(_signal, model.outputs)),
        sampling_time=model.sampling_time,
        constants=tuple(constants.found.values()),
        output=block,
        lines=lines,
        following=tuple(memory.following.tolist()),
        symbols=tuple(constants.symbols.items()),
        digest=digest,
    )


def _weighted_terms(
    model: Model, constants: _Constants, written: Callable[..., Node], held: FadeNodes | None
) -> tuple[list[list[Node]], list[list[Node]]]:
    """Return the terms of the physics of each output, and those of the learner's correction.

    The latter are what the correction takes back where it is held.
    """
    form = model.form
    values = np.asarray(model.theta if held is not None else model.theta - model.theta_aux).tolist()
    effective = dict(zip(form.baseline.names, values, strict=True))
    moved = dict(zip(form.baseline.names, np.asarray(model.theta_aux).tolist(), strict=True))
    sums: list[list[Node]] = [[] for _ in form.outputs]
    corrections: list[list[Node]] = [[] for _ in form.outputs]
    units = {parameter.name: parameter.unit for parameter in form.baseline.parameters}
    for term, expression in zip(form.baseline.terms, form.baseline.expressions, strict=True):
        value = (term.initial or 0.0) if term.fixed else effective[term.parameter]
        unit = term.unit or units.get(term.parameter, "")
        what = "known" if term.fixed else "theta" if held is not None else "theta - theta_aux"
        named = with_unit(term.parameter, unit)
        factor = constants.node("p", term.parameter, value, f"{named}, {what}")
        row = form.outputs.index(term.output) if term.output is not None else 0
        sums[row].append(apply("mul", factor, written(expression)))
        if held is not None and not term.fixed and moved[term.parameter]:
            aux = constants.node(
                "p", f"{term.parameter}_aux", moved[term.parameter], f"{named}, theta_aux"
            )
            inside = dict(zip(form.layout, held.inside, strict=True))
            corrections[row].append(apply("neg", apply("mul", aux, written(expression, inside))))
    return sums, corrections


def _motion_names(
    form: MotionDynamics, values: Mapping[str, float], constants: _Constants
) -> dict[str, Node]:
    """Return the meaning of the names of constants, parameters, states and inputs.

    Args:
        values: of the parameters beside the learner.
    """
    motion = form.motion
    names: dict[str, Node] = {
        key: constants.node("c", key, value, f"constant {key}") for key, value in motion.constants
    }
    for parameter, value in zip(motion.parameters, values.values(), strict=True):
        unit = f" [{parameter.unit}]" if parameter.unit else ""
        beside = ", beside the learner" if form.learns else ""
        names[parameter.name] = constants.node(
            "p", parameter.name, value, f"{parameter.name}{unit}{beside}"
        )
    names |= {state.name: Entry("x", i) for i, state in enumerate(motion.states)}
    names |= {channel: Entry("u", i) for i, channel in enumerate(motion.inputs)}
    return names


def _faded(correction: Node, held: FadeNodes | None, rows: Sequence[Node]) -> Node:
    """Return a correction as it goes on beyond the range of training.

    `rows` are the physics of its equation at p̂, and at the border of the range at c and at p̂.
    """
    if rows:
        _, own, split = rows
        correction = apply("add", correction, apply("sub", own, split))
    return correction if held is None else held.fade(correction)


def _with_forces(
    rates: Sequence[Node], forces: Sequence[Node], responses: Sequence[Sequence[Node]]
) -> list[Node]:
    """Return rates that grow by what forces do through the mass matrix."""
    return [
        total([rate, *(apply("mul", row[k], g) for row, g in zip(responses, forces, strict=True))])
        for k, rate in enumerate(rates)
    ]


def _values_of_parameters(
    model: Model[MotionDynamics],
) -> tuple[dict[str, float], dict[str, float]]:
    """Return the parameters beside the learner, and as estimated."""
    numbers, motion = model.numbers, model.form.motion
    theta = np.asarray(numbers.theta)
    names = [parameter.name for parameter in motion.parameters]
    beside, whole = (
        dict(zip(names, np.asarray(motion.coordinates.physical(q)).tolist(), strict=True))
        for q in (theta - np.asarray(numbers.theta_aux), theta)
    )
    return beside, whole


def _split_parameters(values: Mapping[str, float], constants: _Constants) -> dict[str, Node]:
    """Return the estimated parameters, with which the physics continues beyond the data."""
    return {
        name: constants.node("p", f"{name}_split", value, f"{name}, as estimated")
        for name, value in values.items()
    }


def _motion(model: Model[MotionDynamics], name: str, digest: str) -> Program:
    form, numbers, motion = model.form, model.numbers, model.form.motion
    constants = _Constants()
    beside, whole = _values_of_parameters(model)
    names = _motion_names(form, beside, constants)
    physics = NodesOfMotion(form, dict(motion.constants), names, beside, constants.symbols)
    base = physics.at(names, beside)
    seen_names = physics.defined(names)
    features = [node_of(entry, seen_names, {}, physics.numeric) for entry in form.features]
    held, changed = None, list[PhysicsNodes]()
    if numbers.limits is not None:
        points: list[Node] = [
            *(Entry("x", i) for i in range(form.states)),
            *(names[key] for key in motion.inputs),
        ]
        held = FadeNodes.of(form, numbers, features, points)
        physics.locals |= dict(held.locals)
        constants.symbols |= held.symbols
        if np.any(
            numbers.theta_aux
        ):  # the physics itself extrapolates with the parameters that were split off
            apart = _split_parameters(whole, constants)
            inside = dict(zip((*motion.names_of_states, *motion.inputs), held.inside, strict=True))
            changed = [
                physics.at(names | apart, whole, "_s"),
                physics.at(names | inside, beside, "_h"),
                physics.at(names | inside | apart, whole, "_hs"),
            ]
    learned_states, learned_outputs = form.corrected
    results = {"rate": list(base.rates), "output": list(base.outputs)}
    forces: list[Node] = []
    blocks = {}
    for kind, learned, first in (
        ("output", learned_outputs, len(learned_states)),
        ("rate", learned_states, 0),
    ):
        network = None
        if learned:
            seen = features if held is None else held.features
            network = _network(form.bound, numbers, seen, first + np.arange(len(learned)))
            for i, place in enumerate(learned):
                rows = [there.learned[first + i] for there in changed]
                added = _faded(Entry("g", i), held, rows)
                physics_row = base.learned[first + i]
                if kind == "rate" and base.responses:
                    moved = [apply("sub", rows[0], physics_row)] if rows else []
                    forces.append(total([*moved, added]))
                else:
                    results[kind][place] = apply("add", rows[0] if rows else physics_row, added)
        if kind == "rate" and forces:
            results[kind] = _with_forces(base.rates, forces, base.responses)
        seen = list(network.features) if network is not None else []
        blocks[kind] = Block(
            kind,
            _needed_definitions(physics.locals, [*results[kind], *seen]),
            network,
            tuple(results[kind]),
        )
    return _moving_program(model, blocks, constants, name, digest)


def _moving_program(
    model: Model[MotionDynamics],
    blocks: Mapping[str, Block],
    constants: _Constants,
    name: str,
    digest: str,
) -> Program:
    motion, step_inputs = model.form.motion, model.step_inputs
    units = {channel.name: channel.unit for channel in model.inputs}
    return Program(
        name=name,
        states=tuple(
            Signal(state.name, identifier(state.name), state.unit) for state in motion.states
        ),
        inputs=tuple(_step_input(key, units) for key in step_inputs),
        outputs=tuple(map(_signal, model.outputs)),
        sampling_time=model.sampling_time,
        constants=tuple(constants.found.values()),
        output=blocks["output"],
        rate=blocks["rate"],
        scheme=_scheme(model),
        ends=2 if len(step_inputs) > len(motion.inputs) else 1,
        symbols=tuple(constants.symbols.items()),
        digest=digest,
    )


_LOWERED: dict[type, Callable[[Any, str, str], Program]] = {
    LaggedDynamics: _lower_lagged,
    MotionDynamics: _motion,
}


def _signal(channel: Channel) -> Signal:
    return Signal(channel.name, identifier(channel.name), channel.unit)


def _step_input(name: str, units: Mapping[str, str]) -> Signal:
    bare = name.removesuffix("[k+1]")
    return Signal(name, identifier(bare) + "_next" * (bare != name), units.get(bare, ""))


def _needed_definitions(
    defined: Mapping[str, Node], roots: Sequence[Node]
) -> tuple[tuple[str, Node], ...]:
    """Return the definitions that some nodes reach, in order."""
    reached: set[str] = set()

    def visit(node: Node) -> None:
        if isinstance(node, Name) and node.name in defined and node.name not in reached:
            reached.add(node.name)
            visit(defined[node.name])
        elif isinstance(node, Apply):
            for argument in node.arguments:
                visit(argument)

    for root in roots:
        visit(root)
    return tuple((name, node) for name, node in defined.items() if name in reached)


def _network(bound: Bound, numbers: Numbers, features: Sequence[Node], rows: Vector) -> Network:
    """Return the learner with its scaling; `rows` are the indices of its wanted values."""
    declared = getattr(bound.learner, "layers", None)
    if declared is None:
        raise InputError(
            f"the learner {type(bound.learner).__name__} is a function that no target can "
            "write; fit with an MLP or Terms, or give its class a method `layers(tree)` that "
            "returns weight, bias and activation of each layer. `model.step` runs it where "
            "Python with JAX does."
        )
    centre, halfwidth = np.asarray(numbers.centre), np.asarray(numbers.halfwidth)
    scaled: list[Node] = []
    for feature, middle, width in zip(features, centre.tolist(), halfwidth.tolist(), strict=True):
        moved = feature if middle == 0 else apply("sub", feature, Number(middle))
        scaled.append(moved if width == 1 else apply("div", moved, Number(width)))
    layers = []
    for weight, bias, activation in declared(bound.tree(bound.leaves(np.asarray(numbers.weights)))):
        if activation not in ACTIVATIONS:
            raise InputError(
                f"the learner has the activation {activation!r}; known are "
                f"{', '.join(ACTIVATIONS)}."
            )
        layers.append(
            Layer(
                np.asarray(weight, dtype=float),
                None if bias is None else np.asarray(bias, dtype=float),
                activation,
            )
        )
    last, gain = layers[-1], np.asarray(numbers.gain, dtype=float)[rows]
    layers[-1] = Layer(
        gain[:, None] * last.weight[rows],
        None if last.bias is None else gain * last.bias[rows],
        last.activation,
    )
    return Network(tuple(scaled), tuple(layers))


def _scheme(model: Model[MotionDynamics]) -> Scheme:
    form = model.form
    kind, substeps = form.motion.integrator, form.substeps
    kind = "rk4" if kind == "auto" else kind  # of a motion that no data chose for
    h = model.sampling_time / substeps
    if kind != "exact":
        return Scheme(kind, h, substeps)
    found = form.exponentials(model.numbers)
    assert found is not None
    linear, whole, phi1, phi2, phi3, half, half1 = (np.asarray(matrix) for matrix in found)
    matrices = {
        "linear": linear,
        "whole": whole,
        "half": half,
        "half1": half1,
        "first": h * (phi1 - 3 * phi2 + 4 * phi3),
        "middle": 2 * h * (phi2 - 2 * phi3),
        "last": h * (4 * phi3 - phi2),
    }
    return Scheme(kind, h, substeps, tuple(matrices.items()))
