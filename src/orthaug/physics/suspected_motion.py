"""A motion with suspected terms, each times a coefficient that is one more parameter."""

from __future__ import annotations

import ast
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np

from orthaug._base.checks import Matrix, Vector
from orthaug._base.jax import ArrayModule
from orthaug.data.expressions import Expression, syntax_tree
from orthaug.physics.motion import Motion
from orthaug.physics.parameters import PhysicalParameter

_LONGEST = 400  # characters of a factor: an expression has at most 500


class Memory(Protocol):
    """Internal state that a signal drives."""

    def along(self, values: Vector, sampling_time: float) -> Vector:
        """Return the internal state along the values (N,) of one experiment, from rest."""
        ...


class Signal(NamedTuple):
    """Internal state of a memory that an expression drives along the nominal run."""

    expression: Expression
    memory: Memory

    def along(
        self, motion: Motion, p: Vector, x: Matrix, u: Matrix, sampling_time: float
    ) -> Vector:
        """Return the signal over the samples (N,) of one experiment: each is the mean over it.

        Args:
            p: parameters (np,).
            x: states (N, nx) at the samples, with inputs u (N, nu).
        """
        with np.errstate(all="ignore"):
            found = self.expression.value(motion.values(x.T, u.T, p, np), np)
        state = self.memory.along(np.broadcast_to(np.asarray(found, float), len(x)), sampling_time)
        if motion.scheme.discrete:
            return state
        return (state + np.append(state[1:], state[-1])) / 2


class SuspectedTerm(NamedTuple):
    """A term of an equation, counted from 0 with the outputs after the states.

    `name` is that of its coefficient. A term with a `signal` is the expression times the signal,
    an input of its own: to first order in the coefficient it is that of the run without the term.
    """

    name: str
    place: int
    expression: Expression
    signal: Signal | None = None


@dataclass(frozen=True)
class SuspectedMotion(Motion):
    """The motion `physics` with `added` terms, whose coefficients are parameters, 0 at first.

    The signals of terms with memory are inputs after its own.
    """

    physics: Motion | None = None
    added: tuple[SuspectedTerm, ...] = ()

    @classmethod
    def of(cls, physics: Motion, added: Sequence[SuspectedTerm]) -> SuspectedMotion:
        """Return the motion with terms that read the same names as its equations."""
        own = physics.declaration
        own["parameters"] = (
            *physics.parameters,
            *(PhysicalParameter(term.name, 0.0) for term in added),
        )
        signals = tuple(f"signal of {term.name}" for term in added if term.signal is not None)
        own["inputs"] = (*physics.inputs, *signals)
        return cls(**own, physics=physics, added=tuple(added))

    def values(
        self, x: Any, u: Any, p: Any, xp: Any, needed: Collection[str] | None = None
    ) -> dict[str, Any]:
        return self._known.values(x, u[: self._own], p[: self._count], xp, needed)

    def rates(self, x: Any, u: Any, p: Any, xp: ArrayModule) -> Any:
        rates = self._known.rates(x, u[: self._own], p[: self._count], xp)
        added = self._with_terms(xp.zeros_like(rates), 0, (x, u, p), xp)
        return rates + xp.asarray(self.mass.rates(added, x, p[: self._count]))

    def observed(self, x: Any, u: Any, p: Any, xp: ArrayModule) -> Any:
        outputs = self._known.observed(x, u[: self._own], p[: self._count], xp)
        return self._with_terms(outputs, len(self.states), (x, u, p), xp)

    @property
    def held(self) -> tuple[str, ...]:
        return self._known.held

    @property
    def discrete_states(self) -> tuple[str, ...]:
        return self._known.discrete_states

    def control(self, y: Any, x: Any, u: Any, p: Any, xp: ArrayModule) -> Any:
        return self._known.control(y, x, u[: len(self._known.external)], p[: self._count], xp)

    def after_sample(self, following: Any, y: Any, x: Any, u: Any, p: Any, xp: ArrayModule) -> Any:
        return self._known.after_sample(following, y, x, u[: self._own], p[: self._count], xp)

    @property
    def _known(self) -> Motion:
        assert self.physics is not None
        return self.physics

    @property
    def _count(self) -> int:
        return len(self._known.parameters)

    @property
    def _own(self) -> int:
        """Number of inputs of the physics."""
        return len(self._known.inputs)

    def _with_terms(self, rows: Any, first: int, at: tuple[Any, Any, Any], xp: ArrayModule) -> Any:
        """Return the rows with their terms added; the first row is that of the place `first`."""
        x, u, p = at
        found = list(rows)
        values, signals = None, iter(u[self._own :])
        for term, coefficient in zip(self.added, p[self._count :], strict=True):
            signal = 1.0 if term.signal is None else next(signals)
            if first <= term.place < first + len(found):
                values = self.values(x, u, p, xp) if values is None else values
                found[term.place - first] = found[
                    term.place - first
                ] + coefficient * signal * term.expression.value(values, xp)
        return (
            rows
            if values is None
            else xp.stack([xp.broadcast_to(row, x.shape[1:]) for row in found])
        )


def equations_of(motion: Motion) -> tuple[str, ...]:
    """Return the names of all equations, outputs after states."""
    return (*motion.names_of_states, *(output.name for output in motion.outputs))


def usual_places(motion: Motion) -> tuple[int, ...]:
    """Return the state equations likely to lack a term: learned ones, else with parameters.

    The equations of a learner's own states are none of the physics.
    """
    learned = tuple(i for i in motion.learned[0] if not motion.states[i].memory)
    if learned:
        return learned
    if motion.functions is not None:
        return tuple(range(len(motion.states)))
    return tuple(i for i, state in enumerate(motion.states) if motion.parameters_in(state.name))


def factor_of(equation: str, parameter: str) -> str | None:
    """Return what multiplies the product with a parameter in an equation.

    None where the product is a summand by itself, where the equation is not linear in it, and where
    it has the parameter in no or several places.

    Examples:
        >>> factor_of("(b*u - s*x*abs(x))/L", "s")
        '((b*u - 1)/L) - ((b*u - 0)/L)'
        >>> factor_of("b*u - s*x**3", "s")
    """
    tree = syntax_tree(equation)
    above = {child: node for node in ast.walk(tree) for child in ast.iter_child_nodes(node)}
    places = [n for n in ast.walk(tree) if isinstance(n, ast.Name) and n.id == parameter]
    if len(places) != 1 or 2 * len(equation) > _LONGEST:
        return None
    product: Any = places[0]
    while isinstance(above[product], ast.UnaryOp) or _is(above[product], ast.Mult):
        product = above[product]
    node, alone = product, True
    while not isinstance(above[node], ast.Expression):
        over: Any = above[node]
        divided = _is(over, ast.Div) and over.left is node
        if not (divided or isinstance(over, ast.UnaryOp) or _is(over, ast.Add, ast.Sub, ast.Mult)):
            return None
        alone = alone and _is(over, ast.Add, ast.Sub)
        node = over
    if alone:
        return None
    before, after = equation[: product.col_offset], equation[product.end_col_offset :]
    return f"({before}1{after}) - ({before}0{after})"


def _is(node: Any, *operators: type[ast.operator]) -> bool:
    """Return whether a node is one of these operators between two others."""
    return isinstance(node, ast.BinOp) and isinstance(node.op, operators)
