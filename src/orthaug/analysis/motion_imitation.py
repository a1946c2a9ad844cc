"""What the learner of a motion could imitate of its physics, in words, and what other inputs would make of it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

from orthaug._base.checks import Matrix, Vector
from orthaug.analysis.imitation import Alternative
from orthaug.data.expressions import parse_named
from orthaug.inference.motion_split import shared_of_motion
from orthaug.models.moving import Moving
from orthaug.physics.motion import Motion
from orthaug.physics.shared import Shared


@dataclass(frozen=True)
class MotionImitation:
    """As `Imitation`; the directions are those of the parameters' coordinates, logarithms of positive ones."""

    inputs: tuple[str, ...]
    everything: bool
    directions: tuple[dict[str, float], ...]
    determined: tuple[str, ...]
    alternatives: tuple[Alternative, ...] = ()

    physical = None

    @classmethod
    def of(cls, inputs: Sequence[str], shared: Shared, others: Sequence[Alternative] = ()) -> MotionImitation:
        """Of the directions that a learner on these inputs shares."""
        return cls(tuple(inputs), shared.all, shared.directions, shared.untouched, tuple(others))

    @property
    def text(self) -> str:
        """In sentences."""
        sees = f"The learner sees {', '.join(self.inputs)}"
        if self.everything:
            return f"{sees} and could imitate a change of every parameter: they are those of the nearest physics."
        if not self.directions:
            return f"{sees} and could imitate no change of a parameter: the fit determines all of them beside it."
        moved = "; ".join(" with ".join(direction) for direction in self.directions)
        told = f"{sees} and could imitate a change of {moved}: there, and only there, the nearest physics decides."
        if self.determined:
            told += f" The fit determines {', '.join(self.determined)} beside any learner of these inputs."
        return told


def imitation_before(form: Moving, q: Vector, x: Matrix, u: Matrix) -> MotionImitation:
    """What a learner on the form's features would share with the physics, and what others would.

    Args:
        x: states (M, nx) of a run at the coordinates q; `u` its inputs (M, nu).
    """
    own = tuple(str(entry) for entry in form.features)
    others = []
    for texts in dict.fromkeys(_choices(form.motion)):
        if set(texts) != set(own):
            shared = shared_of_motion(_seeing(form, texts), q, x, u)
            others.append(Alternative(texts, shared.basis.shape[1], shared.untouched, None))
    return MotionImitation.of(own, shared_of_motion(form, q, x, u), others)


def _choices(motion: Motion) -> Iterator[tuple[str, ...]]:
    """Each state alone, all states, all states and inputs."""
    states = motion.names_of_states
    yield from ((name,) for name in states)
    yield from (several for several in (states, (*states, *motion.inputs)) if len(several) > 1)


def _seeing(form: Moving, texts: Sequence[str]) -> Moving:
    known = form.motion.known
    return replace(form, features=tuple(parse_named(text, known, "learner input") for text in texts))
