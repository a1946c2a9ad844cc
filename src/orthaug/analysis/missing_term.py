"""Terms that a motion's equation may lack: which are tried, their values, what they are called."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from orthaug._base.checks import Matrix, Vector
from orthaug.analysis.suspects import changes_sign
from orthaug.physics.motion import Motion

_EDGE = 0.05  # of the largest value: over which a jump at zero is smoothed
_MOST_FACTORS = 5  # states and inputs, of which products are tried

SHAPES = ("linear", "jump", "absolute", "square", "cube", "drag")
POWERS = (1, 0, 1, 2, 3, 2)
"""Of the variable's unit in each shape."""
BEYOND = "beyond"
"""Shape of a term that is zero up to a width, as past the ends of a gap."""
_TERMS = ("{}", "sign({})", "abs({})", "{}**2", "{}**3", "{}*abs({})")
_MEANINGS = (
    "linear in {}",
    "odd in {} with a jump at 0",
    "even in {}, with a kink at 0",
    "even in {}, without a kink",
    "odd in {} and growing faster than it",
    "odd in {} and growing with its square",
)
_ONE_SIDED = ("linear in {}", "", "", "curved in {}", "curved in {}, most where that is large", "")
# What a shape is where it acts against its variable: against a movement, or a displacement
_AGAINST = {
    ("jump", "movement"): ", as dry friction",
    ("drag", "movement"): ", as quadratic drag",
    ("cube", "displacement"): ", as a hardening spring",
}


class Placed:
    """Words for the place of a term by its `equation`, `output` and `beside`."""

    @property
    def place(self: Any) -> str:
        """Place of the term: the equation of a state or of an output, or an input."""
        if self.beside is not None:
            return f"the {'input' if self.beside.isidentifier() else 'term'} {self.beside}"
        if self.equation is None:
            return f"the equation of the output {self.output}"
        return f"the equation of {self.equation}"

    @property
    def where(self: Any) -> str:
        """Place of the term with its preposition."""
        return f"{'in' if self.beside is None else 'beside'} {self.place}"


_DOUBTFUL = 0.05  # p of missing terms below which no parameter is read as physics
_NAMED = 0.5  # share of the errors from which such terms count


def may_be_missing(p: float | None, share: float | None) -> bool:
    """Return whether terms explain most of coloured errors, which need not be surely missing.

    Disturbances and missing physics both colour errors, and few rows do not tell them apart.

    Args:
        p: that nothing is missing.
        share: of the errors' variance that the terms explain together.
    """
    return p is not None and p < _DOUBTFUL and (share or 0.0) > _NAMED


@dataclass(frozen=True)
class MissingTerm(Placed):
    """A term that could be added: its equation, its variable, its shape, and what it would explain.

    `equation` is None of a term of an output, which `output` names then, and of one that acts as
    the input or the shared force `beside` does, in all equations that have it. `coefficient` is in
    the units of equation and variable, `share` that of the errors' variance, less what chance
    explains.
    """

    equation: str | None
    variable: str | None
    """None for a constant."""
    shape: str
    coefficient: float
    share: float
    side: int = 0
    """The sign that the variable keeps over the data, 0 where it changes it."""
    factors: tuple[str, ...] = ()
    """Of a product, its variables; `variable` is then the product itself, linear in it the term."""
    width: float | None = None
    """Of a term that begins beyond a size of its variable, that size."""
    reference: float | None = None
    """Of a variable that keeps its sign, such as a temperature, what the term counts from: it is
    the term's value there that is subtracted.
    """
    output: str | None = None
    against: str | None = None
    """What the term acts against: "movement" where it slows its variable down, "displacement"
    where it drives that back by way of its derivative, "input" where it takes from what an input
    does beyond a size; None where it does neither.
    """
    beside: str | None = None

    @property
    def variables(self) -> tuple[str, ...]:
        """States and inputs that the term depends on."""
        return self.factors or (() if self.variable is None else (self.variable,))

    @property
    def saturates(self) -> float | None:
        """The size at which its variable, an input, saturates; None where it does not."""
        return self.width if self.against == "input" else None

    @property
    def term(self) -> str:
        """The term without its coefficient, as an expression."""
        if self.variable is None:
            return "1"
        if self.width is None:
            name = self.variable
            inner = name[1:-1] if name.startswith("(") else name  # a difference
            written = _TERMS[SHAPES.index(self.shape)]
            term = written.replace("({})", f"({inner})").replace("{}", name)
            if self.reference is None:
                return term
            return f"({term} {'-' if self.reference >= 0 else '+'} {abs(self.reference):.4g})"
        size = f"{self.width:.4g}"
        above, below = f"max({self.variable} - {size}, 0)", f"min({self.variable} + {size}, 0)"
        return f"({above} + {below})" if not self.side else above if self.side > 0 else below

    @property
    def one_sided(self) -> bool:
        """True if the variable keeps its sign: nothing is then known of odd and even."""
        return self.side != 0

    @property
    def expression(self) -> str:
        """The term in the equation's own names."""
        if self.variable is None:
            return f"{self.coefficient:.3g}"
        return f"{self.coefficient:.3g}*{self.term}"

    @property
    def meaning(self) -> str:
        """Its kind in words."""
        if self.width is not None:
            place = f"about |{self.variable}| = {self.width:.3g}"
            if self.saturates is not None:
                limit = f"{'' if self.one_sided else '±'}{self.width:.3g}"
                return f"that begins at {place}, as where the input saturates at {limit}"
            return f"that begins at {place}, as a saturation, an end stop or a gap"
        words = _ONE_SIDED if self.one_sided else _MEANINGS
        if self.reference is not None and self.shape == "linear":
            return words[0].format(self.term)
        if self.variable is None:
            return "constant"
        found = words[SHAPES.index(self.shape)].format(self.variable)
        return found + ("" if self.one_sided else _AGAINST.get((self.shape, str(self.against)), ""))

    def curves_like(self, other: MissingTerm) -> bool:
        """Return whether both count from a level of one variable: nearly straight there."""
        same = (self.place, self.variable) == (other.place, other.variable)
        return same and self.reference is not None and other.reference is not None

    def __str__(self) -> str:
        if self.beside is not None:
            return f"beside {self.place} acts something {self.meaning}: {self.expression}"
        meaning = self.meaning  # a sensor has no springs and no friction
        meaning = meaning if self.equation is not None else meaning.partition(", as")[0]
        return f"{self.place} lacks something {meaning}: {self.expression}"


Product = tuple[int, int, int, int]
"""Two variables and their powers."""


class Tried(NamedTuple):
    """The terms that are tried in each equation, and what makes them of the points.

    A constant and the shapes of each variable are the simple ones; products and terms that begin
    beyond a size of a variable follow.
    """

    names: tuple[str, ...]
    choice: Matrix
    """Rows (n, nx + nu) of the variables by states and inputs."""
    products: list[Product]
    beyond: tuple[float, ...]
    """Shares of a variable's size that are the widths."""

    @property
    def simple(self) -> int:
        """Number of simple terms."""
        return 1 + len(SHAPES) * len(self.names)

    @property
    def count(self) -> int:
        """Number of all terms."""
        return self.simple + len(self.products) + len(self.beyond) * len(self.names)


class Sizes(NamedTuple):
    """Largest values, signs and widths of the variables along the runs."""

    largest: Vector
    sides: list[int]
    """The signs of those that keep theirs, 0 of the others."""
    widths: Matrix
    """Widths (w, n) in units of the largest size."""

    @classmethod
    def of(cls, values: Matrix, shares: tuple[float, ...]) -> Sizes:
        """Return the sizes of variables (n, M)."""
        size = np.abs(values)
        largest = size.max(axis=1, initial=0.0)
        largest = np.where(largest > 0, largest, 1.0)
        widths = np.quantile(size / largest[:, None], shares, axis=1)
        sides = [0 if changes_sign(one) else 1 if np.sum(one) > 0 else -1 for one in values]
        return cls(largest, sides, widths)

    @property
    def one_sided(self) -> list[bool]:
        """True for those that keep their sign."""
        return [side != 0 for side in self.sides]


def variables_of(motion: Motion) -> tuple[tuple[str, ...], Matrix]:
    """Return the names of the variables of terms, and their rows (n, nx + nu) by states and inputs.

    They are the states and inputs that a learner may see, and differences of two of them that
    occur in the equations.
    """
    every, names = (*motion.names_of_states, *motion.inputs), motion.visible
    unit = np.eye(len(every))
    rows = [unit[every.index(name)] for name in names]
    rows += [one.row(every) for one in motion.differences]
    return (*names, *(f"({one})" for one in motion.differences)), np.stack(rows)


def products_of(motion: Motion) -> list[Product]:
    """Return the products of two variables, numbered as by `variables_of`.

    They are those of two states or inputs, each linear or one squared, unless there are many; and
    of a difference in the equations and an input, such as a flow that carries heat.
    """
    names = motion.visible
    few = range(len(names) if len(names) <= _MOST_FACTORS else 0)
    found = [
        (i, j, a, b) for i, j in itertools.combinations(few, 2) for a, b in ((1, 1), (2, 1), (1, 2))
    ]
    for number, difference in enumerate(motion.differences, len(names)):
        inputs = [name for name in motion.inputs if name in names and name not in difference.names]
        found += [(number, names.index(name), 1, 1) for name in inputs]
    return found


def values_of(tried: Tried, sizes: Sizes, rows: Matrix) -> Matrix:
    """Return the terms (count, r) of states and inputs (nx + nu, r).

    Where a variable keeps its sign a jump at zero is a constant, and its size is itself: zeros take
    their places.
    """
    z = tried.choice @ rows / sizes.largest[:, None]
    size, turns = np.abs(z), np.logical_not(sizes.one_sided)[:, None]
    jump, kink, drag = (one * turns for one in (np.tanh(z / _EDGE), size, z * size))
    shaped = np.stack([z, jump, kink, z**2, z**3, drag], axis=1)
    multiplied = [z[i] ** a * z[j] ** b for i, j, a, b in tried.products]
    beyond = [z - np.clip(z, -w[:, None], w[:, None]) for w in sizes.widths]
    each = (values for own in (*shaped, *beyond) for values in own)
    simple = list(itertools.islice(each, tried.simple - 1))
    return np.stack([np.ones(z.shape[1]), *simple, *multiplied, *each])


def term_of(
    tried: Tried, sizes: Sizes, equation: str, number: int, coefficient: float, share: float
) -> MissingTerm:
    """Return the term of a number among those that are tried."""
    names, largest = tried.names, sizes.largest
    if number == 0:
        return MissingTerm(equation, None, "constant", coefficient, share)
    if number < tried.simple:
        variable, shape = divmod(number - 1, len(SHAPES))
        coefficient /= float(largest[variable]) ** POWERS[shape]
        side = sizes.sides[variable]
        return MissingTerm(equation, names[variable], SHAPES[shape], coefficient, share, side)
    number -= tried.simple
    if number < len(tried.products):
        first, second, a, b = tried.products[number]
        coefficient /= float(largest[first] ** a * largest[second] ** b)
        factors = (names[first], names[second])
        product = "*".join(
            name if power == 1 else f"{name}**{power}"
            for name, power in zip(factors, (a, b), strict=True)
        )
        return MissingTerm(equation, product, "linear", coefficient, share, factors=factors)
    level, variable = divmod(number - len(tried.products), len(names))
    size = float(largest[variable])
    width = size * float(sizes.widths[level, variable])
    made = (equation, names[variable], BEYOND, coefficient / size, share)
    return MissingTerm(*made, sizes.sides[variable], width=width)
