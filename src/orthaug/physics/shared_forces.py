"""Forces that several equations of a motion share, such as that of a damper between two masses.

`c*(vs - vu)` pushes one mass and pulls the other, and a sensor of acceleration measures it, too;
`k*(motor/N - load)` is divided by N where it acts before the gear. A term that such a force lacks
is missing wherever that is.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache

from orthaug.data.expressions import parse_named
from orthaug.physics.differences import Difference, ScaledName, Side, difference_of, scaled_name
from orthaug.physics.motion import Motion


@dataclass(frozen=True)
class SharedForce:
    """A parameter or constant times a difference of two states or inputs."""

    factor: str
    difference: Difference

    def __str__(self) -> str:
        return f"{self.factor}*({self.difference})"

    def with_added(self, text: str, added: str, constants: Mapping[str, float]) -> str:
        """Return an expression with what is added to the force, wherever that is in it.

        Args:
            constants: by name, for ratios of gears.

        Examples:
            >>> v, w = Side("v", "v", 1.0), Side("w", "w", 1.0)
            >>> damper = SharedForce("c", Difference(v, w))
            >>> damper.with_added("(f - c*(v - w))/m + k*(v - w)", "d*v", {})
            '(f - (c*(v - w) + d*v))/m + k*(v - w)'
            >>> damper.with_added("-c*(w - v)", "d*v", {})
            '(-c*(w - v) + d*v)'
            >>> damper.with_added("2*c*(v - w)", "d*v", {})
            '(2*c*(v - w) + 2*(d*v))'
        """
        flat = " ".join(text.split())
        places = sorted(self._places(flat, constants), key=lambda one: -one[0].col_offset)
        if not places:
            return text
        data = flat.encode()  # in which places are counted
        for node, product in places:
            begin, end = node.col_offset, node.end_col_offset
            own = data[begin:end].decode()
            same = product.difference == self.difference
            sign = "+" if same != product.negative else "-"
            changed = f"({own} {sign} {product.factor.scaled(added)})"
            data = data[:begin] + changed.encode() + data[end:]
        return data.decode()

    def _places(
        self, text: str, constants: Mapping[str, float]
    ) -> Iterator[tuple[ast.BinOp, _Product]]:
        """Yield its products in an expression."""
        for node in ast.walk(ast.parse(text, mode="eval")):
            found = _product(node, constants)
            if (
                found is not None
                and found.factor.name == self.factor
                and found.difference.sides == self.difference.sides
            ):
                yield node, found  # type: ignore[misc]


@dataclass(frozen=True)
class _Product:
    """A parameter or constant, times or over known numbers, times a difference."""

    factor: ScaledName
    difference: Difference
    negative: bool


@lru_cache(maxsize=16)
def shared_forces(motion: Motion) -> tuple[SharedForce, ...]:
    """Return the forces that several equations, of states or outputs, have; none of functions."""
    if motion.functions is not None or motion.held:
        return ()
    constants = dict(motion.constants)
    known, visible = {*motion.names, *constants}, {*motion.visible}
    found: dict[tuple[str, frozenset[Side]], SharedForce] = {}
    for expression in motion.expressions:
        for node in ast.walk(expression.tree):
            made = _product(node, constants)
            if made is not None and made.factor.name in known and made.difference.names <= visible:
                force = SharedForce(made.factor.name, made.difference)
                found.setdefault((made.factor.name, made.difference.sides), force)
    return tuple(force for force in found.values() if len(_equations_with(motion, force)) > 1)


def with_input(motion: Motion, force: SharedForce) -> Motion:
    """Return the motion with a further input, the last one, that is added to a force."""
    name = "added_force"
    while name in motion.known:
        name += "_"

    def changed(text: str | None) -> str:
        return force.with_added(str(text), name, dict(motion.constants))

    longer = replace(
        motion,
        states=tuple(replace(s, derivative=changed(s.derivative)) for s in motion.states),
        outputs=tuple(replace(o, expression=changed(o.expression)) for o in motion.outputs),
        inputs=(*motion.inputs, name),
    )
    defined = tuple(
        (own, parse_named(changed(str(given)), longer.known, f"motion.define '{own}'"))
        for own, given in motion.definitions
    )
    return replace(longer, definitions=defined)


def _equations_with(motion: Motion, force: SharedForce) -> list[int]:
    """Return the numbers of the equations that have a force, also by way of a definition."""
    longer = with_input(motion, force)
    every = (*longer.equations.values(), *longer.observations)
    return [i for i, one in enumerate(every) if longer.inputs[-1] in longer.names_in(one)]


def _product(node: ast.AST, constants: Mapping[str, float]) -> _Product | None:
    """Return a product of a name and a difference of two names."""
    if not (isinstance(node, ast.BinOp) and isinstance(node.op, ast.Mult)):
        return None
    for factor, other in ((node.left, node.right), (node.right, node.left)):
        difference = difference_of(other, constants)
        if difference is None:
            continue
        negative = isinstance(factor, ast.UnaryOp) and isinstance(factor.op, ast.USub)
        if isinstance(factor, ast.UnaryOp) and negative:
            factor = factor.operand
        made = scaled_name(factor, constants)
        if made is not None:
            return _Product(made, difference, negative)
    return None
