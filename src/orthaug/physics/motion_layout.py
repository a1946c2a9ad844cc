"""States and inputs of a motion as the entries of a regressor: what measures and ranges are told by."""

from __future__ import annotations

from orthaug.data.expressions import Lag
from orthaug.physics.motion import Motion


class Named(Lag):
    """A state or an input as a measure names it: at the present instant, without an index."""

    def __str__(self) -> str:
        return self.channel


def layout_of(motion: Motion) -> tuple[Named, ...]:
    """States, then inputs."""
    return tuple(Named(name, 0) for name in (*motion.names_of_states, *motion.inputs))
