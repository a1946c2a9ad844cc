"""Directions of the physics that a learner could imitate, also with other learner inputs (F8)."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np

from orthaug._base.checks import Matrix, Vector
from orthaug._base.errors import InputError
from orthaug._base.filters import autoregression
from orthaug._base.lines import join_words
from orthaug.analysis.mapped_bias import physical_slopes
from orthaug.data.expressions import parse, parse_named
from orthaug.data.regressors import Features
from orthaug.inference.splitting import learned_places, shared_of_motion, slopes_at
from orthaug.models.moving import MotionDynamics
from orthaug.physics.motion import Motion
from orthaug.physics.parameters import PhysicsMap
from orthaug.physics.problem import Problem
from orthaug.physics.shared import SharedDirections, shared_directions

_STILL = 1e-8  # change of a physical parameter along a shared direction, relative: rounding
_ALTERNATIVES = 8
# Of a regressor's norm: what widens a standard error twenty times, as in `orthaug select`
_NEARLY = 0.05
_LAGS, _FEWEST_ROWS = 12, 60  # of each input, and rows on which they are tried
# Of a slope's variance: what lags leave of it is then 3 % of its size
_FOLLOWED = 1e-3
_DISTINCT = 1e-6  # of a column's size: less of it beside others is rounding

# What depends on anything else moves parameters, and no learner of these inputs takes it up
_PROVIDED = ", if what the physics lacks depends only on that"


@dataclass(frozen=True)
class Alternative:
    """Other learner inputs: the directions they share, and the parameters they leave determined."""

    inputs: tuple[str, ...]
    shared: int
    determined: tuple[str, ...]
    physical: tuple[str, ...] | None

    @classmethod
    def of(
        cls,
        inputs: tuple[str, ...],
        shared: SharedDirections,
        physical: tuple[str, ...] | None = None,
    ) -> Alternative:
        return cls(inputs, shared.basis.shape[1], shared.untouched, physical)


@dataclass(frozen=True)
class Imitation:
    """Parts of the physics that a learner on these inputs could imitate.

    `directions` are those of θ that it shares with the physics. `determined` are the parameters,
    and `physical` the physical parameters, that no shared direction moves: the fit determines them
    beside any learner of these inputs.
    """

    inputs: tuple[str, ...]
    everything: bool
    directions: tuple[dict[str, float], ...]
    determined: tuple[str, ...]
    physical: tuple[str, ...] | None = None
    alternatives: tuple[Alternative, ...] = ()
    terms: bool = False
    """True if the learner can be linear combinations of its inputs only."""
    held: tuple[str, ...] = ()
    """Parameters at a bound: known terms, along which nothing is split off."""
    inseparable: tuple[str, ...] = ()
    """Parameters of which the data determine combinations only, with a learner and without."""
    weakest: tuple[str, float] | None = None
    """The determined parameter that a learner of terms comes nearest to, and what it leaves of its
    regressor.
    """

    @classmethod
    def of(cls, inputs: Sequence[str], shared: SharedDirections, *others: Any) -> Self:
        """Return the imitation for the shared directions; `others` are the last fields."""
        return cls(tuple(inputs), shared.all, shared.directions, shared.untouched, *others)

    def beside_collinear(self, groups: Iterable[Iterable[str]]) -> Self:
        """Return it with the parameters of these groups as determined by no data.

        Args:
            groups: parameters whose effects depend linearly on each other, or on the learner.
        """
        lost = tuple(dict.fromkeys(name for group in groups for name in group))
        others = tuple(
            replace(other, determined=tuple(n for n in other.determined if n not in lost))
            for other in self.alternatives
        )
        determined = tuple(name for name in self.determined if name not in lost)
        return replace(self, determined=determined, alternatives=others, inseparable=lost)

    def _determines(self, every: str) -> str:
        """Return what data determine where a learner could imitate nothing, as a clause."""
        if self.inseparable and not self.determined:
            return ", but the data determine none of the parameters"
        but = f" but {join_words(self.inseparable)}" if self.inseparable else ""
        return f": the data determine {every}{but}{_PROVIDED}"

    @property
    def text(self) -> str:
        """In sentences."""
        sees = f"The learner sees {join_words(self.inputs)}"
        if self.terms:
            sees = f"The learner is a sum of {len(self.inputs)} terms"
        if self.everything:
            return (
                f"{sees} and could imitate all of the physics. The data alone do not determine "
                "θ; the orthogonal split does."
            )
        if self.held:
            are, them = ("is", "it") if len(self.held) == 1 else ("are", "them")
            sees = (
                f"{join_words(self.held)} {are} at a bound: the orthogonal split does not move "
                f"{them}. {sees}"
            )
        if not self.directions:
            rest = " other" if self.held else ""
            text = f"{sees} and could imitate nothing of the{rest} physics"
            return f"{text}{self._determines(f'every{rest} parameter')}.{self._nearly}"
        could = join_words([_combination(direction) for direction in self.directions])
        along = "this direction" if len(self.directions) == 1 else "these directions"
        sentences = [
            f"{sees} and could imitate {could}. Along {along} the data alone do not determine "
            "θ; the orthogonal split does."
        ]
        if self.determined:
            sentences.append(
                f"The data determine {join_words(self.determined)} "
                "with any learner of these inputs."
            )
        if self.physical:
            sentences.append(
                f"Of the physical parameters they determine {join_words(self.physical)}."
            )
        return " ".join(sentences) + self._nearly

    @property
    def _nearly(self) -> str:
        """A sentence on the parameter whose regressor is nearly spanned by the terms.

        It is empty where none is.
        """
        if self.weakest is None or self.weakest[1] >= _NEARLY:
            return ""
        name, left = self.weakest
        return (
            f" On these rows, however, the terms span all but {100 * left:.2g} % of the regressor "
            f"of {name}. Only that part determines its value; the terms may have taken over the "
            "rest."
        )


@dataclass(frozen=True)
class MotionImitation(Imitation):
    """Parts of a motion that a learner on these inputs could imitate.

    Directions are those of the parameters' coordinates, logarithms of positive ones. `remembered`
    are the parameters that it could follow by states of its own, which `memory` names.
    """

    memory: tuple[str, ...] = ()
    remembered: tuple[str, ...] = ()

    @property
    def text(self) -> str:
        """In sentences."""
        sees = f"The learner sees {', '.join(self.inputs)}"
        if self.everything:
            return (
                f"{sees} and could imitate a change of every parameter. The data alone do not "
                "determine them; the physics nearest to the fitted motion does."
            )
        if not self.directions:
            text = f"{sees} and could imitate no change of a parameter"
            return f"{text}{self._determines('all of them')}.{self._remembered}"
        moved = "; ".join(" with ".join(direction) for direction in self.directions)
        text = (
            f"{sees} and could imitate a change of {moved}. Along this change the data alone "
            "do not determine the parameters; the physics nearest to the fitted motion does."
        )
        determined = [name for name in self.determined if name not in self.remembered]
        if determined:
            text += f" The data determine {', '.join(determined)} with any learner of these inputs."
        return text + self._remembered

    def with_memory(self, form: MotionDynamics, q: Vector, x: Matrix, u: Matrix) -> Self:
        """Return the imitation with what the states of the learner could follow along a run.

        The rows follow each other in time.
        """
        memory = form.motion.memory
        if not memory or self.everything:
            return self
        names = [name for name in form.motion.names if name in self.determined]
        followed = _followed_by_memory(form, q, x, u)
        remembered = tuple(name for name in names if name in followed)
        return replace(self, memory=memory, remembered=remembered)

    @property
    def _remembered(self) -> str:
        """Sentences on parameters that the learner's own states could follow; empty for none."""
        if not self.remembered:
            return ""
        state = "state" if len(self.memory) == 1 else "states"
        names = join_words(self.remembered)
        return (
            f" With its own {state} {', '.join(self.memory)} it could also imitate {names}, by the "
            f"past of its inputs. The interval of {names} holds for the solution that was found: "
            "it excludes others that describe the data as well. Compare it with a fit of fewer "
            "states or other inputs."
        )


def imitation(
    problem: Problem,
    physics: PhysicsMap | None = None,
    *,
    others: bool = True,
    held: Collection[str] = (),
) -> Imitation:
    """Return the imitation for the problem's learner, and for `others`, other inputs.

    Args:
        held: parameters at a bound.
    """
    slopes = _slopes(problem, physics)
    own = problem.shared.without_entries([problem.baseline.names.index(name) for name in held])
    inputs = tuple(str(entry) for entry in problem.features.entries)
    alternatives = []
    for other in other_inputs(problem) if others and not problem.features.linear else ():
        features = Features(tuple(parse(text, {}) for text in other))
        shared = shared_directions(
            problem.baseline, features, problem.layout, problem.outputs, problem.rows.x
        )
        if not shared.all and set(other) != set(inputs):
            alternatives.append(Alternative.of(other, shared, _unmoved_parameters(shared, slopes)))
    shown, terms = tuple(alternatives[:_ALTERNATIVES]), problem.features.linear
    found = Imitation.of(inputs, own, _unmoved_parameters(own, slopes), shown, terms, tuple(held))
    determined = tuple(name for name in found.determined if name not in held)
    return replace(
        found, determined=determined, weakest=_weakest(problem, determined) if terms else None
    )


def _weakest(problem: Problem, determined: Collection[str]) -> tuple[str, float] | None:
    """Return the parameter whose regressor loses most of its norm to the terms.

    It is measured relative to the regressor without the terms.
    """
    if len(problem.outputs) > 1 or not determined or not problem.count:
        return None
    physics, terms = problem.unfiltered.projection.phi[:, 0], problem.feature_rows()
    left = []
    for columns in (np.concatenate([physics, terms], axis=1), physics):
        size = np.linalg.norm(columns, axis=0)
        r = np.linalg.qr(columns / np.where(size > 0, size, 1.0), mode="r")
        inverse = np.linalg.pinv(r, rcond=1e-12)
        left.append(1 / np.maximum(np.linalg.norm(inverse[: physics.shape[1]], axis=1), 1.0))
    share = dict(
        zip(problem.baseline.names, np.minimum(left[0] / left[1], 1.0).tolist(), strict=True)
    )
    name = min(determined, key=lambda one: share[one])
    return name, share[name]


def _slopes(problem: Problem, physics: PhysicsMap | None) -> dict[str, np.ndarray] | None:
    """Return dp/dθ by name, at the spec's initial values or, without any, at least squares.

    None where there is none.
    """
    if physics is None:
        return None
    initial = problem.baseline.initial
    try:
        found = physical_slopes(
            physics, problem, initial if np.all(initial) else problem.least_squares
        )
    except InputError:
        return None
    return None if found is None else found[0]


def _unmoved_parameters(
    shared: SharedDirections, slopes: dict[str, np.ndarray] | None
) -> tuple[str, ...] | None:
    """Return the physical parameters that no shared direction moves."""
    if slopes is None:
        return None
    return tuple(
        name
        for name, row in slopes.items()
        if all(
            abs(row @ column) <= _STILL * np.sum(np.abs(row * column)) for column in shared.basis.T
        )
    )


def other_inputs(problem: Problem) -> Iterator[tuple[str, ...]]:
    """Return plausible choices of learner inputs: velocities, outputs, inputs, single lags."""
    for name in problem.outputs:
        lags = [str(lag) for lag in problem.layout if lag.channel == name]
        yield from ((f"{one}-{two}",) for one, two in zip(lags, lags[1:], strict=False))
    outputs = tuple(str(lag) for lag in problem.layout if lag.channel in problem.outputs)
    inputs = tuple(str(lag) for lag in problem.layout if lag.channel not in problem.outputs)
    yield from (several for several in (outputs, inputs) if len(several) > 1)
    yield from ((str(lag),) for lag in problem.layout)


def _combination(direction: dict[str, float]) -> str:
    """Return a direction as a sum: `theta1 - theta2`."""
    text = ""
    for name, factor in direction.items():
        size = "" if abs(abs(factor) - 1) < 1e-9 else f"{abs(factor):.4g}*"
        sign = ("-" if factor < 0 else "") if not text else (" - " if factor < 0 else " + ")
        text += f"{sign}{size}{name}"
    return text


def imitation_before(
    form: MotionDynamics, q: Vector, x: Matrix, u: Matrix, together: int
) -> MotionImitation:
    """Return the imitation for a learner on the form's features, and for others.

    Args:
        x: states (M, nx) of a run at the coordinates q; `u` its inputs (M, nu).
        together: the first rows, which follow each other in time.
    """
    own = tuple(str(entry) for entry in form.features)
    others = []
    for texts in dict.fromkeys(_choices(form.motion)):
        if set(texts) != set(own):
            features = tuple(
                parse_named(text, form.motion.known, "learner input") for text in texts
            )
            others.append(
                Alternative.of(texts, shared_of_motion(replace(form, features=features), q, x, u))
            )
    found = MotionImitation.of(own, shared_of_motion(form, q, x, u), None, tuple(others))
    return found.with_memory(form, q, x[:together], u[:together])


def _followed_by_memory(form: MotionDynamics, q: Vector, x: Matrix, u: Matrix) -> set[str]:
    """Return the parameters whose slopes a few lags of the learner's inputs follow.

    A slope is shared if it is a causal function of what the learner sees. Lags of each input are
    tried from a few samples to an integral; as many are taken as the learner has states, those that
    explain most.
    """
    motion, nx = form.motion, x.shape[1]
    places = [i for i in learned_places(motion) if i >= nx or not motion.states[i].memory]
    slopes = np.asarray(slopes_at(form, q, x, u))[:, places]
    z = form.features_at(x, u)
    own = [i for i, entry in enumerate(form.features) if str(entry) not in motion.memory]
    kept = np.isfinite(slopes).all(axis=(1, 2)) & np.isfinite(z).all(axis=1)
    if kept.sum() < _FEWEST_ROWS:
        return set()
    slopes, z = slopes[kept], z[kept][:, own]
    z = z / np.where(z.std(axis=0) > 0, z.std(axis=0), 1.0)
    kept_per_sample = 1 - np.append(np.geomspace(1 / len(z), 0.2, _LAGS), 0.0)
    bank = np.concatenate([autoregression(np.array([1.0, -a]), z) for a in kept_per_sample], axis=1)
    static = np.concatenate([np.ones((len(z), 1)), z], axis=1)
    followed = set()
    for j, name in enumerate(motion.names):
        moved = [slopes[:, i, j] for i in range(len(places)) if np.ptp(slopes[:, i, j]) > 0]
        if moved and all(
            _least_left(column, static, bank, len(motion.memory)) < _FOLLOWED for column in moved
        ):
            followed.add(name)
    return followed


def _least_left(target: Vector, columns: Matrix, others: Matrix, most: int) -> float:
    """Return the share of a target's variance that columns and the best few others leave."""
    total = float(np.var(target)) * len(target)
    for step in range(most + 1):
        q = np.linalg.qr(columns / np.linalg.norm(columns, axis=0))[0]
        rest = target - q @ (q.T @ target)
        left = float(rest @ rest) / total
        if step == most or left < _FOLLOWED:
            return left
        beside = others - q @ (q.T @ others)
        size = np.linalg.norm(beside, axis=0)
        own = size > _DISTINCT * np.linalg.norm(others, axis=0)
        gained = np.where(own, (beside.T @ rest) ** 2 / np.where(own, size, 1.0) ** 2, 0.0)
        columns = np.column_stack([columns, beside[:, int(np.argmax(gained))]])
    return 1.0


def _choices(motion: Motion) -> Iterator[tuple[str, ...]]:
    """Yield each state alone, all states, all states and inputs."""
    states = motion.visible_states
    yield from ((name,) for name in states)
    yield from (several for several in (states, motion.visible) if len(several) > 1)
