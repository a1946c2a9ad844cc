"""Libraries of terms, written as text: products of signals and of functions of them.

For example `v[k-1]**2*abs(v[k-2])`.

A term is a product of factors. So a library of many thousand terms is evaluated from few factors,
and its terms are chosen by numbers while a program runs, without compiling anew.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations_with_replacement
from math import comb
from typing import Any

import numpy as np
from jaxtyping import Int

from orthaug._base.checks import nearest
from orthaug._base.errors import InputError
from orthaug._base.jax import ArrayModule

OF_SIGNALS = {
    "abs": "abs({})",
    "sign": "sign({})",
    "sqrt": "sqrt(abs({}))",
    "tanh": "tanh({})",
    "sin": "sin({})",
    "cos": "cos({})",
    "exp": "exp({})",
}
"""Functions that a library makes factors of, as text of a signal."""
MOST_TERMS = 200_000
CONSTANT = "1"


@dataclass(frozen=True)
class TermLibrary:
    """Terms as products of factors.

    `products` holds the numbers of their factors, in order, and () is the constant.

    Examples:
        >>> library = TermLibrary.of(["u", "v"], degree=2)
        >>> library.texts
        ('1', 'u', 'v', 'u**2', 'u*v', 'v**2')
    """

    factors: tuple[str, ...]
    products: tuple[tuple[int, ...], ...]

    @classmethod
    def of(
        cls,
        signals: Sequence[str],
        degree: int = 0,
        functions: Sequence[str] = (),
        terms: Sequence[str] = (),
        exclude: Iterable[str] = (),
    ) -> TermLibrary:
        """Return all products of up to `degree` signals, and `terms`.

        One signal of a product may be replaced by a function of a signal.

        Args:
            signals: as expressions can read them, `y[k-1]` or the name of a state.
            degree: 0 for none but `terms`.
            functions: of `OF_SIGNALS`.
            terms: further ones by hand, any expressions.
            exclude: texts of terms to leave out; factors in any order.

        Raises:
            InputError: an unknown function, an excluded term that is none, or more terms than can
                be weighed.
        """
        unknown = [name for name in functions if name not in OF_SIGNALS]
        if unknown:
            hint = nearest(unknown[0], OF_SIGNALS) or f"; known are {', '.join(OF_SIGNALS)}."
            raise InputError(f"a library has no terms of the function '{unknown[0]}'{hint}")
        signals = tuple(dict.fromkeys(signals))
        made = [
            OF_SIGNALS[name].format(signal)
            for name in dict.fromkeys(functions)
            for signal in signals
        ]
        count = count_products(len(signals), degree, len(set(functions)))
        if count > MOST_TERMS:
            raise InputError(
                f"{len(signals)} signals to the degree {degree} make {count} terms; at most "
                f"{MOST_TERMS} are allowed. Lower the degree, or give fewer signals."
            )
        numbers = range(len(signals))
        products = (
            [p for d in range(degree + 1) for p in combinations_with_replacement(numbers, d)]
            if degree
            else []
        )
        lower = [p for p in products if len(p) < degree]
        products += [(*p, len(signals) + i) for i in range(len(made)) for p in lower]
        given = [" ".join(term.split()) for term in terms]
        library = cls((*signals, *made), tuple(products))
        known = set(library.texts)
        new = tuple(dict.fromkeys(term for term in given if term not in known))
        first = len(library.factors)
        library = cls(
            (*library.factors, *new), (*products, *((first + i,) for i in range(len(new))))
        )
        return library._exclude(exclude)

    def __len__(self) -> int:
        return len(self.products)

    @property
    def texts(self) -> tuple[str, ...]:
        """The terms as expressions."""
        return tuple(map(self._text, self.products))

    @property
    def order(self) -> int:
        """The most factors in a term."""
        return max(map(len, self.products), default=0)

    @property
    def numbers(self) -> Int[np.ndarray, "terms order"]:
        """The factors of each term.

        The number of all factors, one more than the last, is 1.
        """
        table = np.full((len(self), max(self.order, 1)), len(self.factors))
        for row, product in zip(table, self.products, strict=True):
            row[: len(product)] = product
        return table

    def pick(self, chosen: Iterable[int]) -> TermLibrary:
        """Return some of the terms, of the same factors."""
        return TermLibrary(self.factors, tuple(self.products[i] for i in chosen))

    def _text(self, product: tuple[int, ...]) -> str:
        if not product:
            return CONSTANT
        powers = Counter(product)
        written = []
        for number, power in powers.items():
            factor = self.factors[number]
            atom = (
                factor
                if len(product) == 1 or not outside_brackets(factor, "+-*/ ")
                else f"({factor})"
            )
            written.append(atom if power == 1 else f"{atom}**{power}")
        return "*".join(written)

    def _exclude(self, exclude: Iterable[str]) -> TermLibrary:
        texts = self.texts
        by_factors: Mapping[tuple[str, ...], int] = {
            _factors_of(text): i for i, text in enumerate(texts)
        }
        gone = set()
        for text in exclude:
            there = by_factors.get(_factors_of(text))
            if there is None:
                hint = (nearest(text, texts) if len(texts) < 1000 else "") or "."
                raise InputError(
                    f"`exclude` names the term '{text}', which is not among the terms{hint}"
                )
            gone.add(there)
        return self.pick(i for i in range(len(self)) if i not in gone) if gone else self


def count_products(signals: int, degree: int, functions: int = 0) -> int:
    """Return the number of products of a library of so many signals and functions."""
    if not degree:
        return 0
    lower = comb(signals + degree - 1, degree - 1)
    return comb(signals + degree, degree) + functions * signals * lower


def products_of(factors: Any, numbers: Any, xp: ArrayModule) -> Any:
    """Return the terms (K, …) of factors (nf, …) by their factors' numbers (K, order).

    Number nf is 1.
    """
    with_one = xp.concatenate([factors, xp.ones((1, *factors.shape[1:]))])
    value = with_one[numbers[:, 0]]
    for column in range(1, numbers.shape[1]):
        value = value * with_one[numbers[:, column]]
    return value


def outside_brackets(text: str, marks: str) -> bool:
    """Return whether one of some marks is outside all brackets of a text."""
    depth = 0
    for character in text:
        depth += (character in "([") - (character in ")]")
        if depth == 0 and character in marks:
            return True
    return False


def _factors_of(text: str) -> tuple[str, ...]:
    """Return the factors of a product in order; `v**2` is v and v."""
    text, pieces, depth, begin = text.replace(" ", ""), [], 0, 0
    for i, character in enumerate(text):
        depth += (character in "([") - (character in ")]")
        power = text[i : i + 2] == "**" or text[i - 1 : i + 1] == "**"
        if depth == 0 and character == "*" and not power:
            pieces.append(text[begin:i])
            begin = i + 1
    pieces.append(text[begin:])
    found: list[str] = []
    for piece in pieces:
        base, _, power = piece.rpartition("**")
        found += [base] * int(power) if base and power.isdigit() else [piece]
    return tuple(sorted(found))
