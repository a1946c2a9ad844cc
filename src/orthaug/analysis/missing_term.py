"""A term that a motion's equation may lack: its shape, as an expression and in words."""

from __future__ import annotations

from dataclasses import dataclass

from orthaug.analysis.bias import place_of

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


@dataclass(frozen=True)
class MissingTerm:
    """A term that could be added: its equation, its variable, its shape, and what it would explain.

    `equation` is None of a term of an output, which `output` names then, and of one that acts as
    the input `beside` does, in all equations that have it. `coefficient` is in the units of
    equation and variable, `share` that of the errors' variance, less what chance explains.
    """

    equation: str | None
    variable: str | None
    """None for a constant."""
    shape: str
    coefficient: float
    share: float
    one_sided: bool = False
    """True if the variable keeps its sign over the data: nothing is then known of odd and even."""
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
    where it drives that back by way of its derivative; None where it does neither.
    """
    beside: str | None = None

    @property
    def place(self) -> str:
        """Where the term is, in words."""
        return place_of(self.equation, self.output, self.beside)

    @property
    def where(self) -> str:
        """The same with its preposition."""
        return f"{'in' if self.beside is None else 'beside'} {self.place}"

    @property
    def variables(self) -> tuple[str, ...]:
        """States and inputs that the term depends on."""
        return self.factors or (() if self.variable is None else (self.variable,))

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
        return f"(max({self.variable} - {size}, 0) + min({self.variable} + {size}, 0))"

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
