"""Search for an input within limits under which suspected terms and noise disturb θ least.

The rows of a simulated system give Φ and Δ, and these what least squares would do on a record of
that input (eq:error_val; Ljung 1999, ch. 9 and 13):

    bias = Φ⁺Δ,   Cov θ̂ = Φ⁺Σ_eΦ⁺ᵀ,   cost = ‖W bias‖² + tr(W Cov θ̂ Wᵀ),   W = diag(1/|θ|) by
    default,

so that √cost is the root mean square of `‖(θ̂ − θ)/θ‖`. Outputs are weighted by one over their
deviations. The search is deterministic. It tries the families of `orthaug.signals`, then periodic
patterns of levels and hold lengths. A pattern is improved by one level, pair or length at a time on
a shortened record. The best are simulated again over all N samples.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from orthaug._base.checks import Matrix, Vector, check_count, check_number
from orthaug._base.errors import InputError

LONGEST_PATTERN = 32  # held samples; a longer period needs a longer hold
_STEPS = (2.0, 1.0, 0.5, 0.25, 0.1)  # changes of one level of a pattern, in units of the amplitude


class Pattern(NamedTuple):
    """Levels in [−1, 1], each held, repeated; with `odd` they are followed by their negatives."""

    levels: tuple[float, ...]
    hold: int
    odd: bool

    @property
    def name(self) -> str:
        shown = "".join("-0+"[int(v) + 1] for v in self.levels)
        if any(v not in (-1, 0, 1) for v in self.levels):
            shown = " ".join(f"{v:.3g}" for v in self.levels)
        return (
            "pattern "
            f"[{shown}]{', then its negative' * self.odd}{f', hold {self.hold}' * (self.hold > 1)}"
        )

    def __call__(self, samples: int) -> Vector:
        unit = np.array(self.levels + tuple(-v for v in self.levels) * self.odd)
        return unit[np.arange(samples) // self.hold % len(unit)]

    def neighbours(self) -> list[Pattern]:
        """Return patterns with one level or a pair's signs changed, or a level taken or doubled."""
        x, near = self.levels, set()
        for i, v in enumerate(x):
            near |= {
                (*x[:i], min(max(v + s * d, -1.0), 1.0), *x[i + 1 :])
                for d in _STEPS
                for s in (-1, 1)
            }
            near |= {(*x[:i], -v, *x[i + 1 : j], -x[j], *x[j + 1 :]) for j in range(i + 1, len(x))}
            near |= {(*x[:i], *x[i + 1 :])} if len(x) > 2 else set()
            near |= {(*x[:i], v, *x[i:])} if len(x) < LONGEST_PATTERN else set()
        return [Pattern(levels, self.hold, self.odd) for levels in sorted(near - {x})]


def starting_patterns(period: int, seed: int) -> list[Pattern]:
    """Return patterns to start from: cut squares of about this period, short ones, and random ones.

    Squares are cut at every length; short patterns have two or four levels.
    """
    rng, patterns = np.random.default_rng(seed), []
    for hold in sorted({1} if period <= 16 else {round(period / 6), round(period / 12)}):
        square = [1.0 if k * hold % period < period / 2 else -1.0 for k in range(LONGEST_PATTERN)]
        for n, odd in product(range(2, LONGEST_PATTERN + 1), (False, True)):
            patterns += [
                Pattern(tuple(x), hold, odd)
                for x in (square[:n], rng.choice([-1.0, 1.0], n).tolist())
            ]
        patterns += [
            Pattern(levels, hold, False)
            for n in range(3, 8)
            for levels in product((-1.0, 1.0), repeat=n)
        ]
        patterns += [
            Pattern(levels, hold, True) for levels in product((-1.0, -0.5, 0.5, 1.0), repeat=4)
        ]
    return sorted(set(patterns))


def families(samples: int, seed: int) -> tuple[dict[str, Vector], dict[str, int]]:
    """Return named signals of amplitude 1, and the periods of the square waves among them."""
    from orthaug.analysis import signals  # scipy.signal is slow to import

    def space_evenly(last: int) -> list[int]:
        return sorted(
            {
                *range(1, min(last, 8) + 1),
                *(round(8 * 1.4**i) for i in range(60) if 8 * 1.4**i <= last),
            }
        )

    squares = {f"square, period {2 * half}": 2 * half for half in space_evenly(samples // 8)}
    waves = {"white Gaussian": signals.white_gaussian(samples, seed)}
    waves["white uniform"] = signals.white_uniform(samples, seed)
    for h in space_evenly(max(samples // 64, 1))[::2]:
        waves[f"white binary, hold {h}"] = signals.white_binary(samples, seed, h)
        waves[f"PRBS, hold {h}"] = signals.prbs(samples, h)
    even = samples + samples % 2
    for part in [s for s in (1.0, 0.5, 0.2, 0.1, 0.03, 0.01) if s * samples > 16]:
        band, name = (1 / samples, part / 2), f"up to {part:g} Nyquist"
        waves[f"multisine {name}"] = signals.multisine(samples, band)
        waves[f"odd multisine {name}"] = signals.multisine(even, band, odd=True)[:samples]
        waves[f"swept square {name}"] = signals.swept_square(samples, band)
    waves |= {name: signals.square(samples, period) for name, period in squares.items()}
    return waves, squares


# Of the shortened record: samples, or periods of the best square if more
SEARCH_ROWS, SEARCH_PERIODS = (512, 40)
# Patterns that are improved, each of another length; that are tried over all N samples
STARTS, FINALISTS = (6, 12)
LEAST_GAIN = 1e-4  # of the cost, relative, for another change of a pattern
SINGULAR = 1e12  # condition number of Φ above which neither bias nor variance is computed
BATCH = 2_000_000  # samples that are simulated side by side

# Per candidate the R of rows [Φ Δ] and of σ[Φ Δ], n = nt + 1
Factors = Float[np.ndarray, "M 2 n n"]


@runtime_checkable
class DesignPlant(Protocol):
    """Simulated system for many inputs side by side: `Plant`, or that of a motion.

    `theta` are the parameters.
    """

    names: tuple[str, ...]
    theta: Vector
    outputs: Sequence[str]
    start: int
    """The first row that is simulated."""
    others: dict[str, np.ndarray]
    """Inputs beside the one that is designed, (N, 1) or one number for all rows."""

    def rows(
        self, u: Float[np.ndarray, "N M"]
    ) -> tuple[Float[np.ndarray, "M R ny nt+1"], np.ndarray]:
        """Return rows `[Φ Δ]`, zero where they run away, and the outputs' weights (M, 1, ny, 1)."""
        ...


class Candidate(NamedTuple):
    """A signal tried over N samples: cost, ‖W bias‖, √tr(W Cov Wᵀ), condition of Φ.

    Infinite where it has none.
    """

    name: str
    cost: float
    bias: float
    std: float
    condition: float


@dataclass(frozen=True, eq=False)
class Design:
    """An input (N,) and its predicted `bias` and `std` (nt,) in θ's units, with √cost.

    `tried` lists the other inputs, best first.
    """

    signal: Vector
    kind: str
    names: tuple[str, ...]
    bias: Vector
    std: Vector
    relative_error: float
    condition: float
    cost: float
    candidates: tuple[Candidate, ...]


def search_input(
    plant: DesignPlant,
    limits: tuple[tuple[float, float], float | None, float],
    sampling_time: float,
    samples: int,
    noise: float | Sequence[float],
    suspected: bool,
    weights: Vector | Matrix | None,
    effort: tuple[int, int],
) -> Design:
    """Return the best input of a plant; the arguments as in `design_input`.

    Args:
        limits: of the input, its rate, and the cap on the condition number.
        effort: seed and iterations.

    Raises:
        InputError: numbers out of range, no candidate within the cap.
    """
    (low, high), rate, cap = limits
    step = math.inf if rate is None else check_number(rate, "rate", positive=True) * sampling_time
    seed, iterations = check_count(effort[0], "seed", 0), check_count(effort[1], "iterations", 0)
    ny = len(plant.outputs)
    sigma = np.array([check_number(value, "noise") for value in as_numbers(noise, (ny,), "noise")])
    sigma = (sigma if suspected or sigma.any() else np.ones(ny)) / math.sqrt(samples - plant.start)
    bounds = low, high, step, check_number(cap, "condition", positive=True), samples
    try:
        with np.errstate(all="ignore"):
            return _Search(plant, _weights(weights, plant), sigma, *bounds).run(seed, iterations)
    except np.linalg.LinAlgError:
        raise InputError(
            "the simulated rows are too large or too small for double precision; change the "
            "limits or the units."
        ) from None


def as_numbers(values: object, shape: tuple[int, ...], name: str) -> np.ndarray:
    """Return finite numbers of a shape; InputError for others."""
    try:
        numbers = np.broadcast_to(np.asarray(values, dtype=float), shape)
    except (TypeError, ValueError, OverflowError):
        numbers = np.array(math.nan)
    if not np.all(np.isfinite(numbers)):
        raise InputError(f"`{name}` must be finite numbers of shape {shape}, or a single one.")
    return numbers


def _weights(weights: Any, plant: DesignPlant) -> Matrix:
    """Return W, (m, nt)."""
    nt = len(plant.theta)
    if weights is None:
        if not plant.theta.all():
            zero = plant.names[int(np.argmin(np.abs(plant.theta)))]
            raise InputError(
                f"θ of {zero} is 0, so that its relative error has no meaning; give `weights`."
            )
        weights = 1 / np.abs(plant.theta)
    try:
        shape = np.shape(weights)
    except ValueError:  # rows of unequal lengths
        shape = ()
    matrix = as_numbers(weights, shape if len(shape) == 2 else (nt,), "weights")
    if matrix.shape[-1] != nt or not matrix.any():
        raise InputError(f"`weights` must be of shape ({nt},) or (m, {nt}), and not all 0.")
    return np.diag(matrix) if matrix.ndim == 1 else matrix


class _Scores(NamedTuple):
    """Scores of M candidates: as in `Candidate`, then bias and std (M, nt)."""

    cost: Vector
    relative_bias: Vector
    relative_std: Vector
    condition: Vector
    bias: Matrix
    std: Matrix
    ranked: Vector  # the cost, infinite above the cap


@dataclass(frozen=True, eq=False)
class _Search:
    """Settings of a search; see `design_input`."""

    plant: DesignPlant
    weights: Matrix
    sigma: Vector  # of the noise, over the square root of the number of rows
    low: float
    high: float
    step: float
    cap: float
    samples: int

    def run(self, seed: int, iterations: int) -> Design:
        named, squares = families(self.samples, seed)
        u, factors = self.measure(np.stack(list(named.values()), axis=1))
        if not factors.any():
            raise InputError(
                "the simulated output diverges under every input; give the `theta` of a stable "
                "model."
            )
        rank = dict(zip(named, self.scores(factors).ranked, strict=True))
        patterns = self.patterns(
            squares[min(squares, key=lambda name: rank[name])], seed, iterations
        )
        more, theirs = self.measure(
            np.stack([pattern(self.samples) for pattern in patterns], axis=1)
        )
        u, scores = np.hstack([u, more]), self.scores(np.concatenate([factors, theirs]))
        names = [*named, *(pattern.name for pattern in patterns)]
        order = np.lexsort((scores.cost, scores.ranked))
        table = tuple(
            Candidate(names[i], *(float(column[i]) for column in scores[:4])) for i in order
        )
        if not table[0].condition <= self.cap:
            best = min(table, key=lambda row: row.condition)
            raise InputError(
                f"no candidate has a condition number of Φ of {self.cap:g} or less; the best "
                f"has {best.condition:.4g}: {best.name}. Raise `condition`, or fix a parameter."
            )
        (name, cost, _, _, condition), k = table[0], order[0]
        own = u[:, k].copy(), name, self.plant.names, scores.bias[k], scores.std[k]
        return Design(*own, math.sqrt(cost), condition, cost, table)

    def measure(self, waves: Matrix, period: Vector | None = None) -> tuple[Matrix, Factors]:
        """Return the limited signals (N, M) of waves of amplitude 1, and their factors per row.

        Factors are those of whole periods if given.
        """
        signals, factors, size = [], [], max(1, BATCH // len(waves))
        for first in range(0, waves.shape[1], size):
            u = self.limit(waves[:, first : first + size])
            rows, weight = self.plant.rows(u)
            counted = np.full(len(rows), rows.shape[1])
            if period is not None:  # a quarter is left to the transient
                here = period[first : first + size]
                counted = np.maximum(rows.shape[1] * 3 // 4 // here, 1) * np.minimum(
                    here, rows.shape[1]
                )
            rows *= (np.arange(rows.shape[1]) >= rows.shape[1] - counted[:, None])[
                :, :, None, None
            ] * weight
            shape = len(rows), -1, rows.shape[-1]
            r = np.linalg.qr(rows.reshape(shape), mode="r")
            noisy = rows * weight * self.sigma[:, None]
            s = (
                np.linalg.qr(noisy.reshape(shape), mode="r")
                if len(self.sigma) > 1
                else r * self.sigma
            )
            signals.append(u)
            factors.append(np.stack([r, s], axis=1) / np.sqrt(counted)[:, None, None, None])
        return np.hstack(signals), np.concatenate(factors)

    def limit(self, waves: Matrix) -> Matrix:
        """Return signals within the limits to the last bit, with steps shortened for rounding."""
        low, high = self.low, self.high
        u = np.clip((low + high) / 2 + (high - low) / 2 * waves, low, high)
        if self.step >= high - low:
            return u
        from orthaug.analysis.signals import (
            limit_rate,
        )  # after scipy.signal, which is slow to import

        step = max(self.step - 4 * np.spacing(max(-low, high)), self.step / 2)
        before = min(max(0.0, low), high)
        return np.stack([limit_rate(column, step, before) for column in u.T], axis=1)

    def scores(self, factors: Factors) -> _Scores:
        """Return bias, variance and cost over all N samples."""
        nt = len(self.plant.theta)
        r = factors[:, 0, :nt, :nt]
        norms = np.where((norms := np.linalg.norm(r, axis=1)) > 0, norms, 1.0)
        unit = r / norms[:, None]
        sigma = np.linalg.svd(unit, compute_uv=False)
        condition = np.divide(
            sigma[:, 0], sigma[:, -1], out=np.full(len(r), np.inf), where=sigma[:, -1] > 0
        )
        fine = condition < SINGULAR
        inverse = np.linalg.inv(np.where(fine[:, None, None], unit, np.eye(nt))) / norms[:, :, None]
        bias = (inverse @ factors[:, 0, :nt, nt:])[:, :, 0]
        half = factors[:, 1, :nt, :nt] @ inverse @ inverse.transpose(0, 2, 1)  # Cov = halfᵀ half
        relative = [
            np.linalg.norm(bias @ self.weights.T, axis=1),
            np.linalg.norm(half @ self.weights.T, axis=(1, 2)),
        ]
        parts = [np.where(fine, values, np.inf) for values in relative]
        ranked = np.where(condition <= self.cap, cost := parts[0] ** 2 + parts[1] ** 2, np.inf)
        return _Scores(
            cost, parts[0], parts[1], condition, bias, np.linalg.norm(half, axis=1), ranked
        )

    def patterns(self, period: int, seed: int, iterations: int) -> list[Pattern]:
        """Return the best patterns, best first.

        The first few of different lengths were improved.
        """
        length = min(self.samples, max(SEARCH_ROWS, SEARCH_PERIODS * period) + self.plant.start)

        def evaluate_patterns(patterns: list[Pattern]) -> Vector:
            waves = np.stack([pattern(length) for pattern in patterns], axis=1)
            periods = np.array([len(p.levels) * p.hold * (1 + p.odd) for p in patterns])
            return self.scores(self.measure(waves, periods)[1]).ranked

        starts = starting_patterns(period, seed)
        pool = dict(zip(starts, evaluate_patterns(starts), strict=True))
        chosen = {
            (len(p.levels), p.odd): p for p in sorted(pool, key=lambda p: -pool[p])
        }  # the best of each length
        for pattern in sorted(chosen.values(), key=lambda p: pool[p])[:STARTS]:
            for _ in range(iterations):
                values = evaluate_patterns(near := pattern.neighbours())
                k = int(np.argmin(values))
                if not values[k] < pool[pattern] * (1 - LEAST_GAIN):
                    break
                pattern = near[k]
                pool[pattern] = values[k]
        return sorted(pool, key=lambda p: pool[p])[:FINALISTS]
