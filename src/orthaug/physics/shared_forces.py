"""Forces that several equations of a motion share, such as that of a damper between two masses.

`c*(vs - vu)` pushes one mass and pulls the other, and a sensor of acceleration measures it, too. A
term that such a force lacks is missing wherever that is.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from dataclasses import dataclass, replace

from orthaug.data.expressions import parse_named
from orthaug.physics.motion import Motion


@dataclass(frozen=True)
class SharedForce:
    """A parameter or constant times a difference of two states or inputs."""

    factor: str
    first: str
    second: str

    def __str__(self) -> str:
        return f"{self.factor}*({self.first} - {self.second})"

    def with_added(self, text: str, added: str) -> str:
        """Return an expression with what is added to the force, wherever that is in it.

        Examples:
            >>> SharedForce("c", "v", "w").with_added("(f - c*(v - w))/m + k*(v - w)", "d*v")
            '(f - (c*(v - w) + d*v))/m + k*(v - w)'
            >>> SharedForce("c", "v", "w").with_added("-c*(w - v)", "d*v")
            '(-c*(w - v) + d*v)'
        """
        flat = " ".join(text.split())
        places = sorted(self._places(flat), key=lambda one: -one[0].col_offset)
        if not places:
            return text
        data = flat.encode()  # in which places are counted
        for node, sign in places:
            begin, end = node.col_offset, node.end_col_offset
            own = data[begin:end].decode()
            changed = f"({own} {'+' if sign > 0 else '-'} {added})"
            data = data[:begin] + changed.encode() + data[end:]
        return data.decode()

    def _places(self, text: str) -> Iterator[tuple[ast.BinOp, int]]:
        """Yield its products in an expression, and the sign of each."""
        for node in ast.walk(ast.parse(text, mode="eval")):
            found = _product(node)
            if found is None:
                continue
            factor, pair, sign = found
            if factor == self.factor and set(pair) == {self.first, self.second}:
                yield node, sign if pair == (self.first, self.second) else -sign  # type: ignore[misc]


def shared_forces(motion: Motion) -> tuple[SharedForce, ...]:
    """Return the forces that several equations, of states or outputs, have; none of functions."""
    if motion.functions is not None or motion.held:
        return ()
    known, visible = {*motion.names, *dict(motion.constants)}, {*motion.visible}
    found: dict[tuple[str, frozenset[str]], SharedForce] = {}
    for expression in motion.expressions:
        for node in ast.walk(expression.tree):
            made = _product(node)
            if made is not None and made[0] in known and set(made[1]) <= visible:
                found.setdefault((made[0], frozenset(made[1])), SharedForce(made[0], *made[1]))
    return tuple(force for force in found.values() if len(_equations_with(motion, force)) > 1)


def with_input(motion: Motion, force: SharedForce) -> Motion:
    """Return the motion with a further input, the last one, that is added to a force."""
    name = "added_force"
    while name in motion.known:
        name += "_"

    def changed(text: str | None) -> str:
        return force.with_added(str(text), name)

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


def _product(node: ast.AST) -> tuple[str, tuple[str, str], int] | None:
    """Return factor, difference and sign of a product of a name and a difference of two names."""
    if not (isinstance(node, ast.BinOp) and isinstance(node.op, ast.Mult)):
        return None
    for factor, other in ((node.left, node.right), (node.right, node.left)):
        sign = 1
        if isinstance(factor, ast.UnaryOp) and isinstance(factor.op, ast.USub):
            factor, sign = factor.operand, -1
        match factor, other:
            case ast.Name(name), ast.BinOp(ast.Name(a), ast.Sub(), ast.Name(b)):
                return name, (a, b), sign
    return None
