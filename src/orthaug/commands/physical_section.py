"""A physical parameter as a spec declares it."""

from __future__ import annotations

import math

from orthaug.commands.sections import Finite, Section
from orthaug.physics.parameters import PhysicalParameter


class PhysicalSection(Section):
    """One physical parameter."""

    initial: Finite
    unit: str = ""
    min: Finite | None = None
    max: Finite | None = None

    def declared(self, name: str) -> PhysicalParameter:
        """The parameter of this name."""
        low, high = -math.inf if self.min is None else self.min, math.inf if self.max is None else self.max
        return PhysicalParameter(name, self.initial, self.unit, low, high)
