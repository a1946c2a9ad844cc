"""Test for missing terms in a motion's equations: each is tried at weight 0.

The error of the free run is regressed on its sensitivities to simple functions of every state and
input, added to one equation each, beside the sensitivities to all that was estimated: parameters,
weights and the segments' starts. That is the score test of Rao (1948) of `b = 0`. To first order
the errors are `S_p δ + S_b b + e`, so that the F-test of b is right whatever the parameters' own
errors δ are. Coloured errors are `e = H ε` with the autoregression `H = 1/A`: rows and columns are
filtered by A (Cochrane and Orcutt 1949). For the test A is that of the errors beside what was
estimated; beside all terms it would be found too white, and the test would reject too often. To
distinguish terms from each other A is that beside all terms, so that what the missing one leaves
does not pass for colour.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import scipy.special
from jaxtyping import Int

from orthaug._base.checks import Matrix, Vector
from orthaug._base.columns import span
from orthaug.analysis.missing_term import (
    BEYOND,
    SHAPES,
    MissingTerm,
    Sizes,
    Tried,
    products_of,
    term_of,
    values_of,
    variables_of,
)
from orthaug.analysis.term_sensitivities import (
    Sensitivities,
    Terms,
    acting_slopes,
    sensitivities,
)
from orthaug.fitting.motion_estimate import MotionEstimate
from orthaug.fitting.whiteness import whitening_filter
from orthaug.physics.motion import Motion
from orthaug.physics.shared_forces import shared_forces

# Shares of a variable's size, by quantiles: the widths that are tried, and those for the best one
_WIDTHS, _FINER = (0.5, 0.8), tuple(np.linspace(0.1, 0.95, 18).tolist())
# Of a column's size: what remains of it beside all that was estimated, so that it is one of its own
_OWN = 0.02
_RANK = 1e-6  # of the largest singular value of such columns, each of size 1
_ROWS_PER_COLUMN = 5
_PROBED = 20  # points at which an equation is looked at
_MOVED = 1e-3  # of a parameter, to see whether an equation has it
_ALONE = 0.05  # of the errors' variance: what a single term explains below it is small
_TOGETHER_LEVEL, _TOGETHER = 1e-6, 0.2  # of the joint test, and of the errors' variance
_ROWS_PER_PRODUCT = 10
_CURVED = 0.95  # of its gain: a curved term that counts from a level is named before a straight one
_RIVAL = 0.9  # of the best term's share, with which another one is named beside it
# Of what the best simple term leaves: a term with the best of many widths is named first below it.
# Saturations leave 0.2 to 0.6 of what a cube does, cubic springs 0.4 to 1 (missing_terms.py)
_LESS = 0.6
# Of its gain, of friction or drag that pushes along a movement, and of drag of no movement: beside
# a damper the right sign has nearly the same effect, and a cubic spring is nearly a square one
_UNLIKELY = 0.8
_ELSEWHERE = 0.97  # of its gain: friction is where the movement is that it follows
_TAKEN = (0.5, 2.0)  # of what an input does beyond a size: the same but for biased parameters
_CERTAIN = 0.9  # of the error: what leaks from an input into a sensor explains all of it
_SAME = 1e-5  # relative difference of what two forces do: they are one place
_ENOUGH = 0.5  # of the error, from which on no other equations are looked at


@dataclass(frozen=True)
class MissingTest:
    """Test that added terms explain the free run's errors: `p` of none, F-distributed.

    `share` is what all of them together explain of the variance, `terms` the best single one and
    its near rivals.
    """

    p: float
    freedom: tuple[int, int]
    share: float
    terms: tuple[MissingTerm, ...]

    def found(self, level: float, share: float) -> bool:
        """Return whether a term is surely missing and explains more than a share."""
        return bool(self.p < level and self.terms and self.terms[0].share > share)

    @property
    def scattered(self) -> bool:
        """True if terms that are small one by one surely explain a large share together.

        A force of another form than those tried, such as a gap, is made up of several of them. The
        level is far below the usual one, since long-lived disturbances resemble such terms.
        """
        small = all(term.share <= _ALONE for term in self.terms)
        return small and self.p < _TOGETHER_LEVEL and self.share > _TOGETHER


class _Regression(NamedTuple):
    """Rows of terms and errors beside what was estimated.

    `left` counts rows less what that used.
    """

    terms: Matrix
    errors: Vector
    left: int


def missing_terms(fit: MotionEstimate) -> MissingTest | None:
    """Try terms of every state and input in every equation with parameters or a learner.

    A difference that the equations contain, such as the stroke of a spring between two masses, is
    a variable, too. Where rows are many, products of two states or inputs, and of a difference and
    an input, are tried as well, and terms that begin beyond a size of one. None where the runs have
    no slopes, or there are too few rows.
    """
    if not fit.segmented.dynamics.differentiable:
        return None
    doubted, others = doubted_equations(fit)
    found = _missing_in(fit, doubted)
    if found is None:  # the rows are too few for all of these
        states = [i for i in doubted if i < len(fit.problem.motion.states)]
        return None if len(states) == len(doubted) else _missing_in(fit, states)
    share = found.terms[0].share if found.terms else 0.0
    shared = _shared_places(fit) if share < _CERTAIN else ()
    if shared:  # what acts as one of these is in several equations at once
        found = _better(found, _missing_in(fit, shared))
    if not others or (found.terms and found.terms[0].share > _ENOUGH):
        return found
    beyond = _missing_in(fit, others)  # a sensor may bend what it measures
    if beyond is None or not beyond.terms or _is_a_shift(beyond.terms[0], fit.problem.motion):
        return found
    return _better(found, beyond)


def _better(found: MissingTest, other: MissingTest | None) -> MissingTest:
    """Return the test of terms elsewhere, if the best of these leaves clearly less."""
    left = 1 - (found.terms[0].share if found.terms else 0.0)
    if other is None or not other.terms or 1 - other.terms[0].share > _LESS * left:
        return found
    return replace(other, p=min(2 * other.p, 1.0))


def _shared_places(fit: MotionEstimate) -> tuple[int, ...]:
    """Return the inputs and forces that act in several equations, counted behind outputs.

    Friction of a joint is a force there, and moves all that hangs on it, as its motor's does. What
    a damper between two masses lacks moves both.
    """
    motion = fit.problem.motion
    if motion.functions is not None or motion.source is not None:
        return ()
    first = len(motion.states) + len(motion.outputs)
    numbers = range(first, first + len(motion.inputs))
    inputs = [i for i in numbers if (np.abs(_acting(fit, i)) > 0).any(axis=0).sum() > 1]
    return (*inputs, *dict.fromkeys(_same_force(fit)))


def _same_force(fit: MotionEstimate) -> list[int]:
    """Return for each shared force the number of the first that acts as it does.

    Spring and damper between two masses are one place.
    """
    motion, kept = fit.problem.motion, dict[int, Matrix]()
    first, found = sum(map(len, (motion.states, motion.outputs, motion.inputs))), []
    for i in range(first, first + len(shared_forces(motion))):
        own = _acting(fit, i)
        same = (
            j
            for j, other in kept.items()
            if np.allclose(own, other, rtol=_SAME, atol=_SAME * np.abs(other).max(initial=0.0))
        )
        found.append(next(same, i))
        kept.setdefault(found[-1], own)
    return found


def _acting(fit: MotionEstimate, number: int) -> Matrix:
    """Return ∂(f, h) (m, nx + ny) by what is added to an input or a shared force, at some points.

    They are counted as by `acting_slopes`.
    """
    motion, (x, u, p) = fit.problem.motion, _along(fit)
    rows = np.concatenate([x, u], axis=1)
    with np.errstate(all="ignore"):
        return np.nan_to_num(acting_slopes(motion, rows, p, number))


def _along(fit: MotionEstimate) -> tuple[Matrix, Matrix, Vector]:
    """Return states and inputs at some points of the runs, and the physical parameters."""
    c = np.asarray(fit.model.numbers.theta - fit.model.numbers.theta_aux)
    x, u = fit.segmented.trajectory(c, fit.model.numbers.weights, fit.states)
    every = np.unique(np.linspace(0, len(x) - 1, _PROBED).astype(int))
    return x[every], u[every], fit.problem.motion.coordinates.physical(c)


def _is_a_shift(term: MissingTerm, motion: Motion) -> bool:
    """Return whether a term of an output is what a shift in time, or another hold, makes of it.

    The slope of a state times the shift is linear in states; and an input that is not held as the
    motion says acts a little at once.
    """
    if term.shape != "linear":
        return False
    only_states = set(term.variables) <= set(motion.names_of_states)
    return only_states or term.share < _CERTAIN


def _missing_in(fit: MotionEstimate, equations: Sequence[int]) -> MissingTest | None:
    """Return the test of terms in some equations, numbered as by `doubted_equations`."""
    motion = fit.problem.motion
    nx, ny = len(motion.states), len(motion.outputs)
    measured = (output.name for output in motion.outputs)
    forces = map(str, shared_forces(motion))
    names = (*motion.names_of_states, *measured, *motion.inputs, *forces)
    rows = int(fit.segmented.observations.sum())
    tried = Tried(*variables_of(motion), products_of(motion), _WIDTHS)
    for fewer in ({"products": []}, {"beyond": ()}):
        if rows < _ROWS_PER_PRODUCT * tried.count * len(equations):
            tried = tried._replace(**fewer)
    sizes: list[Sizes] = []

    def terms(points: Matrix) -> Terms:
        sizes.append(Sizes.of(tried.choice @ points, tried.beyond))
        return lambda rows: values_of(tried, sizes[0], rows)

    found = sensitivities(fit, equations, terms, tried.count)
    if found is None:
        return None
    constants = _constants(tried, sizes[0], len(equations))
    tested = _joint_test(found, constants)
    if tested is None:
        return None
    p, freedom, share, gains, shares, coefficients, references = tested
    of = np.arange(len(gains)) % tried.count
    simple = of < tried.simple
    shape = np.where(simple & (of > 0), (of - 1) % len(SHAPES), -1)
    # Simple terms are tested by themselves, too: the others would take power from them, and so
    # would drag, which is nearly made up of their shapes
    kept = simple & (shape != SHAPES.index("drag"))
    numbers = np.append(np.cumsum(kept) - 1, -1)[constants][kept]
    alone = _joint_test(found.with_terms(kept), numbers if simple.all() else None)
    if alone is not None and (alone[0] < p or simple.all()):
        p, freedom, share = alone[:3]
    if not simple.all():
        p = min(2 * p, 1.0)
        gains = np.where(simple, gains, _RIVAL * gains)
    # Over a range that is small beside the level all shapes are nearly straight
    straight = shape == SHAPES.index("linear")
    gains = np.where(np.isfinite(references) & ~straight, _CURVED * gains, gains)
    moved = [_moved_by(fit, equation) for equation in equations]
    own = np.concatenate([_own(tried, one) for one in moved])
    pushes = own * coefficients > 0
    unlikely = (shape == SHAPES.index("jump")) & pushes
    unlikely |= (shape == SHAPES.index("drag")) & (pushes | (own == 0))
    gains = np.where(unlikely, _UNLIKELY * gains, gains)
    elsewhere = (shape == SHAPES.index("jump")) & (own == 0)
    gains = np.where(elsewhere, _ELSEWHERE * gains, gains)
    named: list[tuple[int, MissingTerm]] = []
    for j in np.argsort(-gains):
        rivals = gains[simple] if simple[j] else gains  # widths are named beside a simple term
        if not gains[j] > _RIVAL * rivals.max():
            continue
        at, number = divmod(int(j), tried.count)
        made = (names[equations[at]], number, float(coefficients[j]), float(shares[j]))
        term = term_of(tried, sizes[0], *made)
        if np.isfinite(references[j]):
            unit = float(coefficients[j]) / term.coefficient
            term = replace(term, reference=float(references[j]) * unit)
        if nx <= equations[at] < nx + ny:
            term = replace(term, equation=None, output=term.equation)
        elif not term.factors and term.variable is not None:
            row = tried.choice[tried.names.index(term.variable)]
            against = _acts_against(fit, moved[at], row, term.coefficient)
            term = replace(term, against=against)
        if equations[at] >= nx + ny:
            force = _force_along(fit, equations[at], term)
            term = replace(term, equation=None, beside=force or term.equation)
        if not any(term.curves_like(other) for _, other in named):
            named.append((at, term))
    listed = [term for _, term in named]
    for place, term in named:
        if term.shape in (BEYOND, "cube", "drag") and term.reference is None:
            best = _finer(fit, tried, equations[place], term)
            if best is None and term.shape == BEYOND:
                best = replace(term, against=_against_input(fit, equations[place], term))
            listed = listed if best is None else _with_finer(listed, best)
            break
    return MissingTest(p, freedom, share, tuple(listed))


def _force_along(fit: MotionEstimate, number: int, term: MissingTerm) -> str | None:
    """Return the force that acts as the one of a number, and has the term's own difference."""
    motion = fit.problem.motion
    if number < sum(map(len, (motion.states, motion.outputs, motion.inputs))):
        return None
    forces = zip(shared_forces(motion), _same_force(fit), strict=True)
    alike = (f for f, first in forces if first == number)
    return next((str(f) for f in alike if f"({f.difference})" == term.variable), None)


def _moved_by(fit: MotionEstimate, equation: int) -> Vector:
    """Return the directions (nx,), by sign, in which a term of an equation moves the states."""
    motion = fit.problem.motion
    nx, ny = len(motion.states), len(motion.outputs)
    if equation >= nx + ny:
        return np.sign(np.median(_acting(fit, equation)[:, :nx], axis=0))
    return (np.arange(nx) == equation).astype(float)


def _own(tried: Tried, moved: Vector) -> Vector:
    """Return how the variable of each term follows the states that it moves; 0 where not."""
    found = np.zeros(tried.count)
    found[1 : tried.simple] = np.repeat(tried.choice[:, : len(moved)] @ moved, len(SHAPES))
    return found


def _acts_against(
    fit: MotionEstimate, moved: Vector, row: Vector, coefficient: float
) -> str | None:
    """Return what an odd term of a variable acts against, as `MissingTerm.against` has it.

    Args:
        moved: directions (nx,) in which the term moves the states.
        row: of the variable (nx + nu,) by states and inputs.
    """
    motion, nx = fit.problem.motion, len(fit.problem.motion.states)
    if row[nx:].any():
        return None
    if (along := float(row[:nx] @ moved)) != 0:
        return "movement" if coefficient * along < 0 else None
    if moved.astype(bool).sum() != 1:
        return None
    equation = int(np.argmax(np.abs(moved)))
    x, u, p = _along(fit)
    point, inputs = x[len(x) // 2], u[len(x) // 2]
    step = _MOVED * max(float(np.abs(x[:, equation]).max()), _MOVED) * (np.arange(nx) == equation)
    with np.errstate(all="ignore"):
        before, after = (
            np.asarray(motion.rates(point + moved, inputs, p, np)) for moved in (-step, step)
        )
    return "displacement" if coefficient * float(row[:nx] @ (after - before)) < 0 else None


def _with_finer(listed: list[MissingTerm], best: MissingTerm) -> list[MissingTerm]:
    """Return the terms with that of the best width, in front where it leaves clearly less.

    It has a width more than the others, and is named once.
    """
    same = (best.place, best.variable, BEYOND)
    others = [one for one in listed if (one.place, one.variable, one.shape) != same]
    if not others or 1 - best.share < _LESS * (1 - others[0].share):
        return [best, *(one for one in others if one.share > _RIVAL * best.share)]
    return [others[0], *([best] if best.share > others[0].share else []), *others[1:]]


def _finer(
    fit: MotionEstimate, tried: Tried, equation: int, term: MissingTerm
) -> MissingTerm | None:
    """Return a term of the same variable that begins beyond a size, the best of many sizes.

    None where it explains no more than the given one.
    """
    i = tried.names.index(str(term.variable))
    one = Tried((tried.names[i],), tried.choice[i : i + 1], [], _FINER)
    sizes: list[Sizes] = []

    def terms(points: Matrix) -> Terms:
        sizes.append(Sizes.of(one.choice @ points, _FINER))
        return lambda rows: values_of(one, sizes[0], rows)[one.simple :]

    found = sensitivities(fit, [equation], terms, len(_FINER))
    tested = None if found is None else _joint_test(found)
    if tested is None:
        return None
    *_, gains, shares, coefficients, _ = tested
    j = int(np.argmax(gains))
    made = ("", one.simple + j, float(coefficients[j]), float(shares[j]))
    best = replace(
        term_of(one, sizes[0], *made),
        equation=term.equation,
        output=term.output,
        beside=term.beside,
    )
    best = replace(best, against=_against_input(fit, equation, best))
    return best if best.share > term.share else None


def _against_input(fit: MotionEstimate, equation: int, term: MissingTerm) -> str | None:
    """Return "input" of a term that takes from what an input does beyond a size; else None.

    A saturation takes all of it, as far as parameters that it has biased show.
    """
    motion = fit.problem.motion
    nx, ny = len(motion.states), len(motion.outputs)
    if term.variable not in motion.inputs or nx <= equation < nx + ny:
        return None
    number = motion.inputs.index(term.variable) + nx + ny
    if equation >= nx + ny:
        gain = float(equation == number)
    else:
        gain = float(np.median(_acting(fit, number)[:, equation]))
    low, high = _TAKEN
    return (
        "input" if low * abs(gain) < -np.sign(gain) * term.coefficient < high * abs(gain) else None
    )


def doubted_equations(fit: MotionEstimate) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Return the equations with a parameter or a learner, and the other outputs.

    Equations of outputs are counted behind those of states. Others of states, such as ẋ = v, define
    a state. All states, if there is none with a parameter.
    """
    motion, (x, u, own) = fit.problem.motion, _along(fit)
    nx, ny = len(motion.states), len(motion.outputs)
    moved = {*motion.learned[0], *(nx + j for j in motion.learned[1])}

    def values(point: Vector, row: Vector, p: Vector) -> Vector:
        rates = np.asarray(motion.mass.balance(motion.rates(point, row, p, np), point, own))
        return np.concatenate([rates, np.asarray(motion.observed(point, row, p, np))])

    with np.errstate(all="ignore"):
        for point, row in zip(x, u, strict=True):
            here = values(point, row, own)
            for i in range(len(own)):
                step = _MOVED * np.where(own != 0, np.abs(own), 1.0)
                there = own + step * (np.arange(len(own)) == i)
                moved |= set(np.flatnonzero(values(point, row, there) != here).tolist())
    if not any(i < nx for i in moved):
        moved |= set(range(nx))
    return tuple(sorted(moved)), tuple(i for i in range(nx, nx + ny) if i not in moved)


def _constants(tried: Tried, sizes: Sizes, equations: int) -> Int[np.ndarray, "q"]:
    """Return for each term the number of the constant beside which it is tried, -1 for none.

    A linear term of an absolute temperature is mostly its mean: with a constant it counts from a
    level that the rows determine.
    """
    own = np.full(tried.count, -1)
    for variable, keeps in enumerate(sizes.one_sided):
        if keeps:
            first = 1 + len(SHAPES) * variable
            own[first : first + len(SHAPES)] = 0
    return np.concatenate([np.where(own == 0, i * tried.count, -1) for i in range(equations)])


def _joint_test(
    found: Sensitivities, constants: Int[np.ndarray, "q"] | None = None
) -> tuple[float, tuple[int, int], float, Vector, Vector, Vector, Vector] | None:
    """Return p, degrees of freedom and share of all terms.

    Each term has its gain in filtered rows, its share, its coefficient, and the level from which it
    counts where that leaves clearly less, NaN elsewhere.

    Args:
        constants: numbers of the constants beside which terms are tried, -1 for none.
    """
    plain = _regression(found, None, constants)
    null = None if plain is None else _regression(found, _filters(found, plain.errors), constants)
    if plain is None or null is None:
        return None
    basis = span(null.terms, _RANK)
    rank, freedom = basis.shape[1], null.left - basis.shape[1]
    total = float(null.errors @ null.errors)
    if rank == 0 or freedom < _ROWS_PER_COLUMN * rank or not total > 0:
        return None
    explained = float(np.sum((basis.T @ null.errors) ** 2))
    rest = max(total - explained, np.finfo(float).eps * total)
    p = float(scipy.special.fdtrc(rank, freedom, explained / rank / (rest / freedom)))
    basis = span(plain.terms, _RANK)
    left = plain.errors - basis @ (basis.T @ plain.errors)
    beside = _regression(found, _filters(found, left), constants)
    rows = null if beside is None else beside
    size = np.einsum("rj,rj->j", rows.terms, rows.terms)
    size = np.where(size > 0, size, np.inf)
    along = rows.terms.T @ rows.errors
    gains, shares, coefficients = along**2 / size, _shares(plain), along / size
    references = np.full(len(gains), np.nan)
    whole, unfiltered = float(rows.errors @ rows.errors), float(plain.errors @ plain.errors)
    for j, constant in enumerate(() if constants is None else constants.tolist()):
        pair = _beside_constant(rows, j, constant) if constant >= 0 else None
        own = _beside_constant(plain, j, constant) if constant >= 0 else None
        if pair is None or own is None:
            continue
        if whole - pair[0] < _LESS * (whole - max(gains[j], gains[constant])):
            gains[j], coefficients[j], references[j] = pair
            left = (1 - own[0] / unfiltered) * plain.left / max(plain.left - 2, 1)
            shares[j] = max(1 - left, 0.0)
    return p, (rank, freedom), _share(plain, basis), gains, shares, coefficients, references


def _beside_constant(rows: _Regression, j: int, constant: int) -> tuple[float, float, float] | None:
    """Return what a term and a constant explain, the term's coefficient, and where both are zero.

    None where the term is nearly a constant, or either has no effect of its own.
    """
    one, term = rows.terms[:, constant], rows.terms[:, j]
    square = float(one @ one)
    if not square > 0:
        return None
    rest = term - one * (float(one @ term) / square)
    size = float(rest @ rest)
    if not size > _OWN**2 * float(term @ term):
        return None
    slope = float(rest @ rows.errors) / size
    level = float(one @ rows.errors - slope * (one @ term)) / square
    gain = float(one @ rows.errors) ** 2 / square + size * slope**2
    return (gain, slope, -level / slope) if slope != 0 else None


def _share(plain: _Regression, basis: Matrix) -> float:
    """Return the share of the errors' variance that all terms explain, less that of chance."""
    total = float(plain.errors @ plain.errors)
    rest = total - float(np.sum((basis.T @ plain.errors) ** 2))
    return max(1 - rest / max(plain.left - basis.shape[1], 1) / (total / plain.left), 0.0)


def _shares(plain: _Regression) -> Vector:
    """Return the share of the errors' variance that each term explains by itself."""
    total, size = (
        float(plain.errors @ plain.errors),
        np.einsum("rj,rj->j", plain.terms, plain.terms),
    )
    explained = (plain.terms.T @ plain.errors) ** 2 / np.where(size > 0, size, np.inf) / total
    return np.maximum(1 - (1 - explained) * plain.left / max(plain.left - 1, 1), 0.0)


def _regression(
    found: Sensitivities,
    filters: tuple[list[Vector], Vector] | None,
    constants: Int[np.ndarray, "q"] | None = None,
) -> _Regression | None:
    """Return filtered terms and errors, with starts and all unknowns projected out.

    A term of which hardly anything is left is none. Of those beside a constant (`constants`) what
    the constant leaves counts.
    """
    rows = [_filter_segment(found, i, filters) for i in range(len(found.scored))]
    parts, used = [], 0
    for block in rows:  # the starts move their own segment only
        starts, rest = block[:, : found.starts], block[:, found.starts :]
        q = span(starts)
        used += q.shape[1]
        parts.append(rest - q @ (q.T @ rest))
    whole = np.concatenate(parts)
    unknowns = found.nuisance - found.starts
    q = span(whole[:, :unknowns])
    rest = whole[:, unknowns:]
    columns = np.concatenate(rows)[:, found.nuisance : -1]
    before = np.linalg.norm(columns, axis=0)
    for j, constant in enumerate([] if constants is None else constants.tolist()):
        if constant >= 0 and before[constant] > 0:
            unit = columns[:, constant] / before[constant]
            before[j] = np.linalg.norm(columns[:, j] - unit * (unit @ columns[:, j]))
    rest = rest - q @ (q.T @ rest)
    terms, errors = rest[:, :-1], rest[:, -1]
    terms = np.where(np.linalg.norm(terms, axis=0) > _OWN * before, terms, 0.0)
    left = len(whole) - used - q.shape[1]
    if left < _ROWS_PER_COLUMN * terms.shape[1] or not np.isfinite(whole).all():
        return None
    return _Regression(terms, errors, left)


def _filter_segment(
    found: Sensitivities, segment: int, filters: tuple[list[Vector], Vector] | None
) -> Matrix:
    """Return columns and errors of one segment, outputs stacked, filtered by their colours."""
    there = found.scored[segment]
    both = np.concatenate([found.columns[segment], found.errors[segment][..., None]], axis=-1)[
        there
    ]  # (r, ny, K + 1)
    ny = both.shape[1]
    if filters is None:
        size = np.sqrt(np.mean(found.errors[found.scored] ** 2, axis=0))
        return np.moveaxis(both / np.where(size > 0, size, 1.0)[:, None], 1, 0).reshape(
            ny * len(both), -1
        )
    coefficients, unit = filters
    memory = max(map(len, coefficients)) - 1
    filtered = []
    for o, a in enumerate(coefficients):
        series = both[:, o]
        if len(series) <= memory:
            return np.zeros((0, both.shape[2]))
        filtered.append(
            sum(c * series[memory - lag : len(series) - lag] for lag, c in enumerate(a)) / unit[o]  # type: ignore[arg-type]
        )
    return np.concatenate(filtered)


def _filters(found: Sensitivities, left: Vector) -> tuple[list[Vector], Vector]:
    """Return the autoregression of each output's remaining errors, and their innovations' size."""
    ny = found.errors.shape[2]
    pieces: list[list[Vector]] = [[] for _ in range(ny)]
    for one in _cut_segments(found, left):
        for o, part in enumerate(one.reshape(ny, -1)):
            pieces[o].append(part)
    coefficients = [whitening_filter(own) for own in pieces]
    known = [np.ones(1) if a is None else a for a in coefficients]
    unit = []
    for own, a in zip(pieces, known, strict=True):
        innovations = np.concatenate(
            [np.convolve(part, a, "valid") for part in own if len(part) >= len(a)]
        )
        size = float(np.sqrt(np.mean(innovations**2)))
        unit.append(size if size > 0 else 1.0)
    scale = np.sqrt(np.mean(found.errors[found.scored] ** 2, axis=0))
    return known, np.array(unit) * np.where(scale > 0, scale, 1.0)


def _cut_segments(found: Sensitivities, whole: Vector) -> Iterator[Vector]:
    """Yield a vector over all rows in the pieces of its segments."""
    ny, place = found.errors.shape[2], 0
    for there in found.scored:
        count = int(there.sum()) * ny
        yield whole[place : place + count]
        place += count
