"""Experiment design: an input within limits under which suspected terms and noise disturb θ least.

For a candidate input the physics at θ plus the suspected terms at their guessed coefficients is simulated without
noise; its rows give Φ and Δ, and with them what least squares would do on a record of that input (fact F3 and
eq:error_val; Ljung 1999, ch. 9 and 13):

    bias = Φ⁺Δ,   Cov θ̂ = Φ⁺Σ_eΦ⁺ᵀ,   cost = ‖W bias‖² + tr(W Cov θ̂ Wᵀ),   W = diag(1/|θ|) by default,

so that √cost is the root mean square of `‖(θ̂ − θ)/θ‖`; outputs are weighted as in `orthaug.problem`. The search is
deterministic: the families of `orthaug.signals`, then periodic patterns of levels and hold lengths, improved by one
level, pair or length at a time on a shortened record; the best of them are simulated again over all N samples.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from orthaug._base.checks import Matrix, Vector, check_choice, check_count, check_number, check_unique
from orthaug._base.errors import InputError
from orthaug.analysis.suspects import Suspect
from orthaug.data.expressions import Expression, Lag
from orthaug.data.regressors import in_order, largest_lag
from orthaug.physics.baseline import Baseline

LONGEST_PATTERN = 32  # held samples; a longer period needs a longer hold
SEARCH_ROWS, SEARCH_PERIODS = 512, 40  # of the shortened record: samples, or periods of the best square if more
STARTS, FINALISTS = 6, 12  # patterns that are improved, each of another length; that are tried over all N samples
LEAST_GAIN = 1e-4  # of the cost, relative, for another change of a pattern
RUNS_AWAY = 1e4  # largest output of the second half of a record over that of the first
SINGULAR = 1e12  # condition number of Φ above which neither bias nor variance is computed
BATCH = 2_000_000  # samples that are simulated side by side
_STEPS = (2.0, 1.0, 0.5, 0.25, 0.1)  # changes of one level of a pattern, in units of the amplitude

Factors = Float[np.ndarray, "M 2 n n"]  # per candidate the R of rows [Φ Δ] and of σ[Φ Δ], n = nt + 1


class Candidate(NamedTuple):
    """A signal tried over N samples: cost, ‖W bias‖, √tr(W Cov Wᵀ), condition of Φ; infinite where it has none."""

    name: str
    cost: float
    bias: float
    std: float
    condition: float


@dataclass(frozen=True, eq=False)
class Design:
    """An input (N,) and its prediction: `bias` and `std` (nt,) in θ's units, √cost, what else was tried, best first."""

    signal: Vector
    kind: str
    names: tuple[str, ...]
    bias: Vector
    std: Vector
    relative_error: float
    condition: float
    cost: float
    candidates: tuple[Candidate, ...]


def design_input(
    baseline: Baseline,
    *,
    outputs: Sequence[str],
    inputs: Sequence[str],
    sampling_time: float,
    samples: int,
    amplitude: float,
    rate: float | None = None,
    suspects: Sequence[Suspect] = (),
    noise: float | Sequence[float] = 0.0,
    theta: Vector | Sequence[float] | None = None,
    weights: Vector | Matrix | None = None,
    condition: float = 1e3,
    channel: str | None = None,
    seed: int = 0,
    known_inputs: Mapping[str, Any] | None = None,
    initial_outputs: Any = 0.0,
    iterations: int = 30,
) -> Design:
    """The input of least predicted error of θ within |u| ≤ amplitude and |u_k − u_{k−1}| ≤ rate · Ts.

    Args:
        baseline: made of terms; of channels with the names `outputs` and `inputs`.
        sampling_time: Ts, s.
        samples: N.
        amplitude: in the channel's unit; `rate` in that unit per second, counted from 0 before the first sample.
        suspects: with their coefficients; without any the design has least variance (A-optimal for W θ).
        noise: standard deviation of the equation noise in the output's unit, or one for each; 0 counts the bias alone.
            Without suspects 0 means 1, and `std` is per unit of noise.
        theta: θ to simulate with (nt,); None for the baseline's initial values.
        weights: W, (nt,) for a diagonal, or (m, nt), such as dp/dθ / p for physical parameters p; None for 1/|θ|.
        condition: cap on the condition number of Φ with columns of unit norm.
        channel: the input that is designed; may be left out where there is one.
        known_inputs: samples (N,) of other inputs, by name; zero where absent.
        initial_outputs: before the first row, a number, (ny,) or (largest lag, ny).
        iterations: the most improvements of one pattern; `seed` is that of the random candidates.

    Raises:
        InputError: numbers out of range, unknown channels, a suspect without coefficient, θ of 0 without `weights`,
            a simulated output that runs away, no candidate within the cap on the condition number.
    """
    amplitude = check_number(amplitude, "amplitude", positive=True)
    sampling_time = check_number(sampling_time, "sampling_time", positive=True)
    step = math.inf if rate is None else check_number(rate, "rate", positive=True) * sampling_time
    iterations, seed, suspects = check_count(iterations, "iterations", 0), check_count(seed, "seed", 0), tuple(suspects)
    if baseline.function is not None or not baseline.names:
        raise InputError("a design needs physics that is made of terms, with one parameter or more.")
    theta = _numbers(baseline.initial if theta is None else theta, (len(baseline.names),), "theta")
    plant = _Plant(baseline, (tuple(outputs), tuple(inputs)), suspects, theta, channel)
    samples = check_count(samples, "samples", plant.start + 4 * len(theta) + 16)
    for name, values in (known_inputs or {}).items():
        check_choice(name, plant.others, "a channel of `known_inputs`")
        plant.others[name] = _numbers(values, (samples,), f"known_inputs['{name}']")[:, None]
    plant.before = _numbers(initial_outputs, (plant.start, len(outputs)), "initial_outputs")
    sigma = np.array([check_number(value, "noise") for value in _numbers(noise, (len(outputs),), "noise")])
    sigma = (sigma if suspects or sigma.any() else np.ones(len(outputs))) / math.sqrt(samples - plant.start)
    limits = amplitude, step, check_number(condition, "condition", positive=True), samples
    return _Search(plant, _weights(weights, plant), sigma, *limits).run(seed, iterations)


def _numbers(values: Any, shape: tuple[int, ...], name: str) -> np.ndarray:
    try:
        found = np.broadcast_to(np.asarray(values, dtype=float), shape)
    except (TypeError, ValueError):
        found = np.array(math.nan)
    if not np.all(np.isfinite(found)):
        raise InputError(f"`{name}` must be finite numbers of shape {shape}, or a single one.")
    return found


def _weights(weights: Any, plant: _Plant) -> Matrix:
    """W, (m, nt)."""
    nt = len(plant.theta)
    if weights is None:
        if not plant.theta.all():
            zero = plant.names[int(np.argmin(np.abs(plant.theta)))]
            raise InputError(f"θ of {zero} is 0, so that its relative error has no meaning; give `weights`.")
        weights = 1 / np.abs(plant.theta)
    found = _numbers(weights, np.shape(weights) if np.ndim(weights) == 2 else (nt,), "weights")
    if found.shape[-1] != nt or not found.any():
        raise InputError(f"`weights` must be of shape ({nt},) or (m, {nt}), and not all 0.")
    return np.diag(found) if found.ndim == 1 else found


class _Node(np.lib.mixins.NDArrayOperatorsMixin):
    """A value on a tape; what NumPy does with it is recorded."""

    def __init__(self, tape: _Tape, slot: int):
        self.tape, self.slot = tape, slot

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *arguments: Any) -> _Node:
        return self.tape.record(ufunc, *arguments)


class _Tape:
    """Stands for NumPy while expressions are evaluated once, and then repeats what they did, each part once."""

    def __init__(self) -> None:
        self.values: list[Any] = []
        self.known: dict[Any, _Node] = {}
        self.steps: list[tuple[Callable[..., Any], int, int, int]] = []
        self.lags: dict[Lag, int] = {}

    def __getattr__(self, name: str) -> Callable[..., _Node]:
        return lambda *arguments: self.record(getattr(np, name), *arguments)

    def asarray(self, value: Any, dtype: Any = None) -> _Node:
        return value if isinstance(value, _Node) else self._node(float(value), np.float64(value))

    def record(self, function: Callable[..., Any], *arguments: Any) -> _Node:
        slots = [self.asarray(argument).slot for argument in arguments]
        if (function, *slots) not in self.known:
            self.steps.append((function, slots[0], slots[1] if len(slots) > 1 else -1, len(self.values)))
        return self._node((function, *slots))

    def trace(self, expression: Expression, coefficient: float | None = None) -> _Node:
        """The value of an expression, times a coefficient if given."""
        nodes = {lag: self._node(lag) for lag in expression.lags}
        self.lags |= {lag: node.slot for lag, node in nodes.items()}
        value = self.asarray(expression.evaluate(nodes, self))
        return value if coefficient is None else self.record(np.multiply, value, coefficient)

    def total(self, values: Sequence[_Node]) -> _Node:
        return sum(values[1:], values[0]) if values else self.asarray(0.0)

    def _node(self, key: Any, value: Any = None) -> _Node:
        if key not in self.known:
            self.known[key] = _Node(self, len(self.values))
            self.values.append(value)
        return self.known[key]

    def replay(self, columns: Iterable[Any], wanted: Sequence[int]) -> list[Any]:
        """Values of the wanted slots for one column for each of `lags`, in their order."""
        values = self.values
        for slot, column in zip(self.lags.values(), columns, strict=True):
            values[slot] = column
        for function, a, b, out in self.steps:
            values[out] = function(values[a]) if b < 0 else function(values[a], values[b])
        return [values[slot] for slot in wanted]


class _Plant:
    """The physics at θ with the suspected terms, simulated for many inputs side by side."""

    def __init__(self, baseline: Baseline, channels: Any, suspects: Sequence[Suspect], theta: Vector, channel: Any):
        outputs, inputs = channels
        if channel is None and len(inputs) != 1:
            raise InputError(f"`channel` is missing: the input to design, one of the inputs ({', '.join(inputs)}).")
        self.channel = inputs[0] if channel is None else check_choice(channel, inputs, "`channel`")
        baseline.check_channels(outputs, inputs)
        check_unique((suspect.name for suspect in suspects), "suspect")
        self.names, self.theta, self.outputs = baseline.names, theta, outputs
        self.others = {name: np.zeros((1, 1)) for name in inputs if name != self.channel}
        self.before = np.zeros((0, 0))
        self.tape, nt = _Tape(), len(theta)
        parts: list[list[list[_Node]]] = [[[] for _ in range(nt + 2)] for _ in outputs]  # φ, then δ, then fixed terms
        for term, expression in zip(baseline.terms, baseline.expressions, strict=True):
            i = 0 if term.output is None else outputs.index(term.output)
            j = nt + 1 if term.fixed else self.names.index(term.parameter)
            parts[i][j].append(self.tape.trace(expression, (term.initial or 0.0) if term.fixed else None))
        for suspect in suspects:
            in_order(suspect.lags, outputs, inputs)
            if suspect.coefficient is None:
                raise InputError(f"suspect '{suspect.name}' has no `coefficient`; a design needs a guess of its size.")
            parts[suspect._column_of(outputs)][nt].append(self.tape.trace(suspect.parsed, suspect.coefficient))
        table = [[self.tape.total(entry) for entry in row] for row in parts]
        scaled = [[*(v * t for v, t in zip(row, theta.tolist(), strict=False)), *row[nt:]] for row in table]
        if self.channel not in {lag.channel for lag in self.tape.lags}:
            raise InputError(f"no term reads the input '{self.channel}', so that it cannot be designed.")
        self.start = largest_lag(tuple(self.tape.lags))
        self._total = [self.tape.total(row).slot for row in scaled]
        self._table = [node.slot for row in table for node in row]

    def rows(self, u: Float[np.ndarray, "N M"]) -> tuple[Float[np.ndarray, "M R ny nt+1"], np.ndarray]:
        """Rows `[Φ Δ]`, zero for an input under which they run away, and the weights of the outputs (M, 1, ny, 1)."""
        (length, count), start, half = u.shape, self.start, len(u) // 2
        y = np.zeros((len(self.outputs), length, count))
        y[:, :start] = self.before.T[:, :, None]
        signals = {self.channel: u} | {name: np.resize(v, (length, 1)) for name, v in self.others.items()}
        signals |= dict(zip(self.outputs, y, strict=True))
        reads = [(signals[lag.channel], lag.lag) for lag in self.tape.lags]
        with np.errstate(all="ignore"):
            for k in range(start, length):
                for i, value in enumerate(self.tape.replay([s[k - lag] for s, lag in reads], self._total)):
                    y[i, k] = value
            columns = [signals[lag.channel][start - lag.lag : length - lag.lag] for lag in self.tape.lags]
            rows = np.empty((count, length - start, len(self._table)))
            for j, value in enumerate(self.tape.replay(columns, self._table)):
                rows[:, :, j] = np.transpose(value)
            early, late = np.abs(y[:, :half]).max(axis=1), np.abs(y[:, half:]).max(axis=1)
            sound = np.isfinite(rows).all(axis=(1, 2)) & (late <= RUNS_AWAY * np.where(early > 0, early, late)).all(0)
            rows = rows.reshape(count, length - start, len(self.outputs), -1)
            deviation = (y[:, start:].transpose(2, 1, 0) - rows[..., -1]).std(axis=1)[:, None, :, None]
        rows[~sound], deviation[~sound] = 0.0, 1.0
        return rows[..., :-1], 1 / np.where((deviation > 0) & (len(y) > 1), deviation, 1.0)


class _Pattern(NamedTuple):
    """Levels in [−1, 1], each held, repeated; with `odd` they are followed by their negatives."""

    levels: tuple[float, ...]
    hold: int
    odd: bool

    @property
    def name(self) -> str:
        shown = "".join("-0+"[int(v) + 1] for v in self.levels)
        if any(v not in (-1, 0, 1) for v in self.levels):
            shown = " ".join(f"{v:.3g}" for v in self.levels)
        return f"pattern [{shown}]{', then its negative' * self.odd}{f', hold {self.hold}' * (self.hold > 1)}"

    def __call__(self, samples: int) -> Vector:
        unit = np.array(self.levels + tuple(-v for v in self.levels) * self.odd)
        return unit[np.arange(samples) // self.hold % len(unit)]

    def neighbours(self) -> list[_Pattern]:
        """Patterns with one level or the signs of a pair changed, or a level taken out or given twice."""
        x, found = self.levels, set()
        for i, v in enumerate(x):
            found |= {(*x[:i], min(max(v + s * d, -1.0), 1.0), *x[i + 1 :]) for d in _STEPS for s in (-1, 1)}
            found |= {(*x[:i], -v, *x[i + 1 : j], -x[j], *x[j + 1 :]) for j in range(i + 1, len(x))}
            found |= {(*x[:i], *x[i + 1 :])} if len(x) > 2 else set()
            found |= {(*x[:i], v, *x[i:])} if len(x) < LONGEST_PATTERN else set()
        return [_Pattern(levels, self.hold, self.odd) for levels in sorted(found - {x})]


def _starts(period: int, seed: int) -> list[_Pattern]:
    """Squares of about this period cut at every length, short binary and four-level patterns, and some at random."""
    rng, found = np.random.default_rng(seed), []
    for hold in sorted({1} if period <= 16 else {round(period / 6), round(period / 12)}):
        square = [1.0 if k * hold % period < period / 2 else -1.0 for k in range(LONGEST_PATTERN)]
        for n, odd in product(range(2, LONGEST_PATTERN + 1), (False, True)):
            found += [_Pattern(tuple(x), hold, odd) for x in (square[:n], rng.choice([-1.0, 1.0], n).tolist())]
        found += [_Pattern(levels, hold, False) for n in range(3, 8) for levels in product((-1.0, 1.0), repeat=n)]
        found += [_Pattern(levels, hold, True) for levels in product((-1.0, -0.5, 0.5, 1.0), repeat=4)]
    return sorted(set(found))


def _families(samples: int, seed: int) -> tuple[dict[str, Vector], dict[str, int]]:
    """Named signals of amplitude 1, and the periods of the square waves among them."""
    from orthaug.analysis import signals  # scipy.signal is slow to import

    def spaced(first: int, last: int) -> list[int]:
        return sorted({*range(first, min(last, 8) + 1), *(round(8 * 1.4**i) for i in range(60) if 8 * 1.4**i <= last)})

    squares = {f"square, period {2 * half}": 2 * half for half in spaced(1, samples // 8)}
    found = {"white Gaussian": signals.white_gaussian(samples, amplitude=1, seed=seed)}
    found["white uniform"] = signals.white_uniform(samples, amplitude=1, seed=seed)
    for h in spaced(1, max(samples // 64, 1))[::2]:
        found[f"white binary, hold {h}"] = signals.white_binary(samples, amplitude=1, seed=seed, hold=h)
        found[f"PRBS, hold {h}"] = signals.prbs(samples, amplitude=1, hold=h)
    even = samples + samples % 2
    for part in [s for s in (1.0, 0.5, 0.2, 0.1, 0.03, 0.01) if s * samples > 16]:
        band, name = (1 / samples, part / 2), f"up to {part:g} Nyquist"
        found[f"multisine {name}"] = signals.multisine(samples, amplitude=1, band=band)
        found[f"odd multisine {name}"] = signals.multisine(even, amplitude=1, band=band, odd=True)[:samples]
        found[f"swept square {name}"] = signals.swept_square(samples, amplitude=1, band=band, logarithmic=True)
    found |= {name: signals.square(samples, amplitude=1, period=period) for name, period in squares.items()}
    return found, squares


class _Scores(NamedTuple):
    """Of M candidates: as in `Candidate`, then bias and std (M, nt)."""

    cost: Vector
    relative_bias: Vector
    relative_std: Vector
    condition: Vector
    bias: Matrix
    std: Matrix
    ranked: Vector  # the cost, infinite above the cap


@dataclass(frozen=True, eq=False)
class _Search:
    """What is asked for; see `design_input`."""

    plant: _Plant
    weights: Matrix
    sigma: Vector  # of the noise, over the square root of the number of rows
    amplitude: float
    step: float
    cap: float
    samples: int

    def run(self, seed: int, iterations: int) -> Design:
        families, squares = _families(self.samples, seed)
        u, factors = self.measured(np.stack(list(families.values()), axis=1))
        if not factors.any():
            raise InputError("the simulated output runs away under every input; give a `theta` that is stable.")
        rank = dict(zip(families, self.scores(factors).ranked, strict=True))
        patterns = self.patterns(squares[min(squares, key=lambda name: rank[name])], seed, iterations)
        more, found = self.measured(np.stack([pattern(self.samples) for pattern in patterns], axis=1))
        u, scores = np.hstack([u, more]), self.scores(np.concatenate([factors, found]))
        names = [*families, *(pattern.name for pattern in patterns)]
        order = np.lexsort((scores.cost, scores.ranked))
        table = tuple(Candidate(names[i], *(float(column[i]) for column in scores[:4])) for i in order)
        if not table[0].condition <= self.cap:
            best = min(table, key=lambda row: row.condition)
            raise InputError(
                f"no candidate has a condition number of Φ of {self.cap:g} or less; the best has {best.condition:.4g}: "
                f"{best.name}. Raise `condition`, or fix a parameter."
            )
        (name, cost, _, _, condition), k = table[0], order[0]
        own = u[:, k].copy(), name, self.plant.names, scores.bias[k], scores.std[k]
        return Design(*own, math.sqrt(cost), condition, cost, table)

    def measured(self, waves: Matrix, period: Vector | None = None) -> tuple[Matrix, Factors]:
        """The limited signals (N, M) of waves of amplitude 1, and their factors per row; of whole periods if given."""
        signals, factors, size = [], [], max(1, BATCH // len(waves))
        for first in range(0, waves.shape[1], size):
            u = self.limited(waves[:, first : first + size] * self.amplitude)
            rows, weight = self.plant.rows(u)
            counted = np.full(len(rows), rows.shape[1])
            if period is not None:  # a quarter is left to the transient
                here = period[first : first + size]
                counted = np.maximum(rows.shape[1] * 3 // 4 // here, 1) * np.minimum(here, rows.shape[1])
            rows *= (np.arange(rows.shape[1]) >= rows.shape[1] - counted[:, None])[:, :, None, None] * weight
            shape = len(rows), -1, rows.shape[-1]
            r = np.linalg.qr(rows.reshape(shape), mode="r")
            noisy = rows * weight * self.sigma[:, None]
            s = np.linalg.qr(noisy.reshape(shape), mode="r") if len(self.sigma) > 1 else r * self.sigma
            signals.append(u)
            factors.append(np.stack([r, s], axis=1) / np.sqrt(counted)[:, None, None, None])
        return np.hstack(signals), np.concatenate(factors)

    def limited(self, u: Matrix) -> Matrix:
        """Within the limits to the last bit: steps are shortened by what rounding could add."""
        u = np.clip(u, -self.amplitude, self.amplitude)
        if self.step >= 2 * self.amplitude:
            return u
        from orthaug.analysis.signals import limit_rate  # after scipy.signal, which is slow to import

        step = max(self.step - 4 * np.spacing(self.amplitude), self.step / 2)
        return np.stack([limit_rate(column, step, 0.0) for column in u.T], axis=1)

    def scores(self, factors: Factors) -> _Scores:
        """Bias, variance and cost over all N samples."""
        nt = len(self.plant.theta)
        r = factors[:, 0, :nt, :nt]
        norms = np.where((norms := np.linalg.norm(r, axis=1)) > 0, norms, 1.0)
        unit = r / norms[:, None]
        sigma = np.linalg.svd(unit, compute_uv=False)
        condition = np.divide(sigma[:, 0], sigma[:, -1], out=np.full(len(r), np.inf), where=sigma[:, -1] > 0)
        fine = condition < SINGULAR
        inverse = np.linalg.inv(np.where(fine[:, None, None], unit, np.eye(nt))) / norms[:, :, None]
        bias = (inverse @ factors[:, 0, :nt, nt:])[:, :, 0]
        half = factors[:, 1, :nt, :nt] @ inverse @ inverse.transpose(0, 2, 1)  # Cov = halfᵀ half
        relative = [np.linalg.norm(bias @ self.weights.T, axis=1), np.linalg.norm(half @ self.weights.T, axis=(1, 2))]
        parts = [np.where(fine, values, np.inf) for values in relative]
        ranked = np.where(condition <= self.cap, cost := parts[0] ** 2 + parts[1] ** 2, np.inf)
        return _Scores(cost, parts[0], parts[1], condition, bias, np.linalg.norm(half, axis=1), ranked)

    def patterns(self, period: int, seed: int, iterations: int) -> list[_Pattern]:
        """The best patterns, best first; the first few of different lengths were improved."""
        length = min(self.samples, max(SEARCH_ROWS, SEARCH_PERIODS * period) + self.plant.start)

        def tried(patterns: list[_Pattern]) -> Vector:
            waves = np.stack([pattern(length) for pattern in patterns], axis=1)
            periods = np.array([len(p.levels) * p.hold * (1 + p.odd) for p in patterns])
            return self.scores(self.measured(waves, periods)[1]).ranked

        starts = _starts(period, seed)
        pool = dict(zip(starts, tried(starts), strict=True))
        chosen = {(len(p.levels), p.odd): p for p in sorted(pool, key=lambda p: -pool[p])}  # the best of each length
        for pattern in sorted(chosen.values(), key=lambda p: pool[p])[:STARTS]:
            for _ in range(iterations):
                values = tried(near := pattern.neighbours())
                k = int(np.argmin(values))
                if not values[k] < pool[pattern] * (1 - LEAST_GAIN):
                    break
                pattern = near[k]
                pool[pattern] = values[k]
        return sorted(pool, key=lambda p: pool[p])[:FINALISTS]
