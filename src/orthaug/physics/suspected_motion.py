"""A motion with suspected terms, each times a coefficient that is one more parameter."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, fields
from typing import Any, NamedTuple

from orthaug.data.expressions import Expression
from orthaug.physics.motion import Motion
from orthaug.physics.parameters import PhysicalParameter


class SuspectedTerm(NamedTuple):
    """A term of an equation, counted from 0 with the outputs after the states.

    `name` is that of its coefficient.
    """

    name: str
    place: int
    expression: Expression


@dataclass(frozen=True)
class SuspectedMotion(Motion):
    """The motion `physics` with `added` terms, whose coefficients are parameters, 0 at first."""

    physics: Motion | None = None
    added: tuple[SuspectedTerm, ...] = ()

    @classmethod
    def of(cls, physics: Motion, added: Sequence[SuspectedTerm]) -> SuspectedMotion:
        """Return the motion with terms that read the same names as its equations."""
        own = {field.name: getattr(physics, field.name) for field in fields(Motion)}
        own["parameters"] = (
            *physics.parameters,
            *(PhysicalParameter(term.name, 0.0) for term in added),
        )
        return cls(**own, physics=physics, added=tuple(added))

    def values(
        self, x: Any, u: Any, p: Any, xp: Any, needed: Collection[str] | None = None
    ) -> dict[str, Any]:
        return self._known.values(x, u, p[: self._count], xp, needed)

    def rates(self, x: Any, u: Any, p: Any, xp: Any) -> Any:
        rates = self._known.rates(x, u, p[: self._count], xp)
        return self._with_terms(rates, 0, (x, u, p), xp)

    def observed(self, x: Any, u: Any, p: Any, xp: Any) -> Any:
        outputs = self._known.observed(x, u, p[: self._count], xp)
        return self._with_terms(outputs, len(self.states), (x, u, p), xp)

    @property
    def _known(self) -> Motion:
        assert self.physics is not None
        return self.physics

    @property
    def _count(self) -> int:
        return len(self._known.parameters)

    def _with_terms(self, rows: Any, first: int, at: tuple[Any, Any, Any], xp: Any) -> Any:
        """Return the rows with their terms added; the first row is that of the place `first`."""
        x, u, p = at
        found = list(rows)
        values = None
        for term, coefficient in zip(self.added, p[self._count :], strict=True):
            if first <= term.place < first + len(found):
                values = self.values(x, u, p, xp) if values is None else values
                found[term.place - first] = found[
                    term.place - first
                ] + coefficient * term.expression.value(values, xp)
        return (
            rows
            if values is None
            else xp.stack([xp.broadcast_to(row, x.shape[1:]) for row in found])
        )
