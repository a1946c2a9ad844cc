"""A correction that is held or fades beyond the range of its training, in the intermediate form (`models.beyond`)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from orthaug.export.nodes import Name, Node, Number, apply, total
from orthaug.models.beyond import FADED
from orthaug.models.dynamics import Numbers
from orthaug.models.lagged import Lagged
from orthaug.models.motion_field import MotionField


@dataclass(frozen=True, eq=False)
class FadeNodes:
    """Named intermediate results: features on the range of training, the point x̄ there, and what fading leaves."""

    locals: tuple[tuple[str, Node], ...]
    features: tuple[Node, ...]
    """z̄ (nz,)."""
    inside: tuple[Node, ...]
    """x̄ (nx,), in the order of the points that were given."""
    share: Node | None
    """None where the correction is held."""

    @classmethod
    def of(
        cls, form: Lagged | MotionField, numbers: Numbers, features: Sequence[Node], points: Sequence[Node]
    ) -> FadeNodes:
        """Return the intermediate results for features z (nz,) of the entries of a point x (nx,)."""
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
        for j, (point, row) in enumerate(zip(points, np.asarray(numbers.pull).tolist(), strict=True)):
            steps = [apply("mul", Number(by), over[i]) for i, by in enumerate(row) if by]
            moved.append(name(f"h_point_{j}", total([point, *steps])) if steps else point)
        share = None
        if form.beyond == "fade":
            halves = [(b - a) / 2 or 1.0 for a, b in zip(low, high, strict=True)]
            apart = [apply("div", step, Number(half * FADED)) for step, half in zip(over, halves, strict=True)]
            squares = total([apply("mul", part, part) for part in apart])
            share = name("h_share", apply("exp", apply("neg", squares)))
        return cls(tuple(found.items()), tuple(inside), tuple(moved), share)

    @property
    def symbols(self) -> dict[str, str]:
        """Names of the intermediate results as a reader sees them, counted from 1 as the features are listed."""
        return {key: _read(key) for key, _ in self.locals}

    def faded(self, correction: Node) -> Node:
        """Return what is left of a correction."""
        return correction if self.share is None else apply("mul", self.share, correction)


def _read(key: str) -> str:
    """`h_inside_0` as `inside_1`."""
    _, kind, *number = key.split("_")
    return "_".join([kind, *(str(int(i) + 1) for i in number)])
