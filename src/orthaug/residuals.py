"""Residual analysis: is what a model leaves over white, independent of the inputs, and flat over the regressors?

Ljung, System Identification (1999), sect. 16.6. Experiments are pooled: sums run over all of them, products of two
samples never reach from one into the next. Where the residual is coloured, `e = H ε` with `H = 1/A` an
autoregression, the tests for dependence work on `A e` and on equally filtered regressors: a relation `e = Z β + H ε` is
`A e = (A Z) β + ε`, whose F-test keeps its level, also where Z holds past outputs. Large records make every test reject;
the sizes of the effects stand beside the p-values for that reason. There is no verdict here.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.special
from jaxtyping import Float, Int

from orthaug._arrays import Matrix, Vector, check_count, check_number, check_unique
from orthaug.errors import InputError

Segments = Sequence[Vector] | Vector
"""One signal of several experiments; a plain vector is one experiment."""

_ROWS = 4096  # rows of a regressor matrix that exist at a time: 26 columns of them stay in the cache
_ROWS_PER_BIN = 5  # fewer would make bins of chance
_ROWS_PER_COEFFICIENT = 20  # of the autoregression; AIC chooses too long ones where there are fewer
_CONSTANT = 64 * np.finfo(float).eps  # rounding of the mean: a smaller deviation, against the largest value, is none
_RANK = 1e-10  # eigenvalues of a unit-diagonal Gram matrix below this, of the largest, are rounding


@dataclass(frozen=True)
class ChiSquare:
    """A statistic, its degrees of freedom, and the probability of a larger one where the hypothesis holds."""

    statistic: float
    freedom: int
    p: float


@dataclass(frozen=True)
class Normality:
    """Jarque-Bera statistic (χ² with 2 degrees of freedom), its p-value, skewness and excess kurtosis."""

    statistic: float
    p: float
    skewness: float
    kurtosis: float


@dataclass(frozen=True, eq=False)
class CrossTest:
    """Residual against an input: `values` (2M+1,) of r_eu for lags −M…M, `band` (±) of one value, `p` of lags 0…M."""

    values: Vector
    band: float
    p: float | None
    """Joint test; None where there are too few rows for it."""

    @property
    def lag(self) -> int:
        """The causal lag, 0…M, with the largest |r_eu|."""
        return int(np.argmax(np.abs(self.values[len(self.values) // 2 :])))

    @property
    def largest(self) -> float:
        """Largest |r_eu| over the causal lags."""
        return float(np.abs(self.values[len(self.values) // 2 :]).max())


@dataclass(frozen=True, eq=False)
class RegressorTest:
    """Residual against a regressor, by bins: p-value of no relation and share of the residual's variance explained.

    Per bin: `centres` (mean of the regressor, in its unit), `means` of the residual with standard `errors` from the
    deviation within the bins (both in the residual's unit; the errors take it as white), and `counts` of rows.
    """

    p: float | None
    share: float
    centres: Vector
    means: Vector
    errors: Vector
    counts: Int[np.ndarray, "_"]


@dataclass(frozen=True, eq=False)
class ResidualTest:
    """The tests of one output's residual; None stands where something does not exist (a residual that is constant)."""

    name: str
    n: int
    level: float
    mean: float | None
    rms: float | None
    acf: Vector | None
    acf_band: float | None
    ljung_box: ChiSquare | None
    cross: Mapping[str, CrossTest | None]
    regressors: Mapping[str, RegressorTest | None]
    normality: Normality | None
    order: int | None
    """Order of the autoregression that stands for the residual's colour, 0 if none."""

    @property
    def white(self) -> bool | None:
        """Whether Ljung-Box does not reject at `level`."""
        return None if self.ljung_box is None else self.ljung_box.p >= self.level

    @property
    def correlated_inputs(self) -> tuple[str, ...]:
        """Inputs with a joint test below `level`, divided by the number of inputs tested (Bonferroni)."""
        return _rejected(self.cross, self.level)

    @property
    def curved_regressors(self) -> tuple[str, ...]:
        """Regressors over which the residual is not flat, at `level` divided by the number of regressors tested."""
        return _rejected(self.regressors, self.level)

    @property
    def largest_acf(self) -> float | None:
        """Largest |r_e| beyond lag 0."""
        return None if self.acf is None or len(self.acf) < 2 else float(np.abs(self.acf[1:]).max())

    @property
    def largest_cross(self) -> float | None:
        """Largest |r_eu| over all inputs and causal lags."""
        return max((test.largest for test in self.cross.values() if test is not None), default=None)

    @property
    def largest_share(self) -> float | None:
        """Largest share of the residual's variance that the bins of one regressor explain."""
        return max((test.share for test in self.regressors.values() if test is not None), default=None)

    def as_dict(self) -> dict[str, Any]:
        """Plain content for JSON: lists, numbers, strings and None, never NaN."""
        shape = self.normality
        cross = {
            name: test and {"values": test.values, "band": test.band, "p": test.p, "lag": test.lag, "r": test.largest}
            for name, test in self.cross.items()
        }
        found = {
            **{key: getattr(self, key) for key in ("name", "n", "level", "mean", "rms", "order", "acf", "acf_band")},
            "ljung_box": self.ljung_box and vars(self.ljung_box),
            "white": self.white,
            "cross": cross,
            "correlated_inputs": self.correlated_inputs,
            "regressors": {name: test and vars(test) for name, test in self.regressors.items()},
            "curved_regressors": self.curved_regressors,
            "jarque_bera": shape and {"statistic": shape.statistic, "p": shape.p},
            "skewness": shape and shape.skewness,
            "kurtosis": shape and shape.kurtosis,
            "largest": {"acf": self.largest_acf, "cross": self.largest_cross, "share": self.largest_share},
        }
        return _plain(found)


def analyse(
    residuals: Sequence[Matrix],
    inputs: Sequence[Matrix],
    regressors: Sequence[Matrix],
    output_names: Sequence[str],
    input_names: Sequence[str],
    regressor_names: Sequence[str],
    *,
    lags: int = 25,
    level: float = 0.01,
    fitted: int = 0,
) -> tuple[ResidualTest, ...]:
    """All tests of every output's residual.

    The regressor tests ask for bin means that differ from the overall mean: an offset, reported as `mean`, is no curve.

    Args:
        residuals: per experiment (N_i, ny), measured less model, in the outputs' units.
        inputs: per experiment (N_i, nu), of the same rows.
        regressors: per experiment (N_i, nx), of the same rows.
        output_names: of the ny columns; equally `input_names` and `regressor_names`.
        lags: of all correlations; cut where the longest experiment is shorter.
        level: of every test; the bands hold one value with probability 1 − level.
        fitted: dynamic parameters whose fit has used up degrees of freedom of Ljung-Box.

    Returns:
        One `ResidualTest` per output.

    Raises:
        InputError: experiments, rows or columns that do not match, a name twice, or a setting out of range.

    Examples:
        >>> e, u = np.random.default_rng(0).normal(size=(2, 500, 1))
        >>> (test,) = analyse([e], [u], [u], ["y"], ["u"], ["u[k-1]"])
        >>> test.white, test.correlated_inputs, test.curved_regressors
        (True, (), ())
    """
    lags, fitted = check_count(lags, "lags"), check_count(fitted, "fitted", least=0)
    if not 0 < check_number(level, "level", positive=True) < 1:
        raise InputError(f"`level` must be between 0 and 1; got {level!r}.")
    lengths = [len(residual) for residual in residuals]
    e = _channels(residuals, output_names, "residuals", lengths)
    u = _channels(inputs, input_names, "inputs", lengths)
    x = _channels(regressors, regressor_names, "regressors", lengths)
    return tuple(_one_output(name, column, u, x, lags, level, fitted) for name, column in e.items())


def _one_output(
    name: str,
    e: list[Vector],
    inputs: Mapping[str, list[Vector]],
    regressors: Mapping[str, list[Vector]],
    lags: int,
    level: float,
    fitted: int,
) -> ResidualTest:
    whole = np.concatenate(e)
    size = float(np.abs(whole).max(initial=0.0))
    usable = len(whole) > 0 and np.isfinite(size)
    scaled = whole / size if usable and size > 0 else whole
    rms = size * float(np.sqrt(np.mean(scaled**2))) if usable else None
    mean = size * float(np.mean(scaled)) if usable else None
    acf, a = autocorrelation(e, lags), whitening(e, lags)
    return ResidualTest(
        name=name,
        n=len(whole),
        level=float(level),
        mean=mean,
        rms=rms,
        acf=acf,
        acf_band=None if acf is None else _reach(level) / float(np.sqrt(len(whole))),
        ljung_box=ljung_box(e, lags, fitted),
        cross={key: against_input(e, u, lags, level=level, a=a) for key, u in inputs.items()},
        regressors={key: against_regressor(e, x, centred=True, a=a) for key, x in regressors.items()},
        normality=normality(e),
        order=None if a is None else len(a) - 1,
    )


def autocorrelation(segments: Segments, lags: int = 25) -> Vector | None:
    """r_e(τ) = Σ e_k e_{k−τ} / Σ e_k², e less its mean, for τ = 0…lags, (lags + 1,).

    The mean is that of all experiments. Lags that no experiment is long enough for are cut; None for a signal that is
    constant or not finite.
    """
    e = _standardised(segments)
    if e is None:
        return None
    reach = min(lags, max(map(len, e)) - 1)
    return np.array([_lagged_product(e, e, lag) for lag in range(reach + 1)])


def cross_correlation(residual: Segments, inputs: Segments, lags: int = 25) -> Vector | None:
    """r_eu(τ) = Σ e_k u_{k−τ} / √(Σ e_k² Σ u_k²), means removed, for τ = −lags…lags, (2 lags + 1,).

    At τ ≥ 0 the residual follows the input. Lags are cut as in `autocorrelation`; None where one signal is constant.
    """
    e, u = _standardised(residual), _standardised(inputs)
    if e is None or u is None:
        return None
    reach = min(lags, max(map(len, e)) - 1)
    leads = [_lagged_product(u, e, lag) for lag in range(reach, 0, -1)]
    return np.array(leads + [_lagged_product(e, u, lag) for lag in range(reach + 1)])


def ljung_box(segments: Segments, lags: int = 25, fitted: int = 0) -> ChiSquare | None:
    """Whiteness: `Q = N (N + 2) Σ_τ r_e(τ)² / n_τ` ~ χ²(lags − fitted), τ = 1…lags (Ljung and Box 1978).

    n_τ is the number of pairs of samples τ apart within experiments; for one experiment N − τ.
    """
    acf = autocorrelation(segments, lags)
    if acf is None or len(acf) < 2:
        return None
    lengths = np.array([len(one) for one in _as_segments(segments)])
    n, lag = lengths.sum(), np.arange(1, len(acf))
    pairs = np.maximum(lengths[:, None] - lag, 0).sum(axis=0)
    statistic = float(n * (n + 2.0) * np.sum(acf[1:] ** 2 / pairs))
    freedom = max(len(lag) - fitted, 1)
    return ChiSquare(statistic, freedom, float(scipy.special.chdtrc(freedom, statistic)))


def normality(segments: Segments) -> Normality | None:
    """Jarque-Bera, `N/6 (S² + K²/4)` ~ χ²(2), of skewness S and excess kurtosis K (population moments).

    For white samples; the distribution is approached slowly, below some 2000 rows the p-value is rough.
    """
    e = _standardised(segments)
    if e is None:
        return None
    whole = np.concatenate(e) * np.sqrt(sum(map(len, e)))
    skewness, kurtosis = float(np.mean(whole**3)), float(np.mean(whole**4)) - 3
    statistic = len(whole) / 6 * (skewness**2 + kurtosis**2 / 4)
    return Normality(statistic, float(scipy.special.chdtrc(2, statistic)), skewness, kurtosis)


def whitening(segments: Segments, largest: int = 25) -> Vector | None:
    """The coefficients (1, a_1, …, a_p) of `A(q) e_k = ε_k`: Burg's recursion over all experiments, p by AIC.

    Burg's A is stable and, unlike that of Yule and Walker, hardly biased near the unit circle.
    """
    e = _standardised(segments)
    if e is None:
        return None
    n = sum(map(len, e))
    forward = backward = e
    a = best = np.ones(1)
    power, lowest = 0.0, 0.0  # log of the innovations' variance, AIC
    for order in range(1, min(largest, n // _ROWS_PER_COEFFICIENT) + 1):
        forward, backward = [f[1:] for f in forward], [b[:-1] for b in backward]
        energy = sum(f @ f + b @ b for f, b in zip(forward, backward, strict=True))
        if energy < n * _CONSTANT**2:  # nothing left to predict, or no experiment is longer than this
            break
        k = -2 * sum(f @ b for f, b in zip(forward, backward, strict=True)) / energy
        if 1 - k**2 < _CONSTANT:
            break
        pairs = [(f + k * b, b + k * f) for f, b in zip(forward, backward, strict=True)]
        forward, backward = [f for f, _ in pairs], [b for _, b in pairs]
        a = np.append(a, 0.0) + k * np.append(a, 0.0)[::-1]
        power += np.log(1 - k**2)
        if n * power + 2 * order < lowest:
            best, lowest = a, n * power + 2 * order
    return best


def against_input(
    residual: Segments, inputs: Segments, lags: int = 25, *, level: float = 0.01, a: Vector | None = None
) -> CrossTest | None:
    """Is the residual independent of an input? Bands of r_eu(τ) and the joint test of the causal lags.

    Band of one value: Var r_eu(τ) = P/N with `P = Σ_m r_e(m) r_u(m)` over all m (Ljung 1999, eq. 16.56 ff.), 1 for a
    white residual. r_e is that of the autoregression, the product of two sample functions would not converge.
    Joint test: Ljung's `ζ = N r_euᵀ P⁻¹ r_eu` ~ χ²(M + 1), on A e and A u, where P is the covariance of the input
    alone, as it stands in the record; F-distributed, since the variance is estimated. Lags that the input
    does not tell apart (a sine has two) count once.

    Args:
        residual: per experiment (N_i,).
        inputs: per experiment (N_i,).
        lags: M.
        level: the band holds one value of r_eu with probability 1 − level.
        a: `whitening(residual)`, where it is known already.
    """
    values = cross_correlation(residual, inputs, lags)
    e, u = _standardised(residual), _standardised(inputs)
    a = whitening(residual, lags) if a is None else a
    if values is None or e is None or u is None or a is None:
        return None
    variance = _spectral_product(a, u) / sum(map(len, e))
    p = _no_relation(_lag_blocks(e, u, a, len(values) // 2), intercept=True)
    return CrossTest(values, _reach(level) * float(np.sqrt(variance)), p)


def against_regressor(
    residual: Segments, regressor: Segments, bins: int = 20, *, centred: bool = False, a: Vector | None = None
) -> RegressorTest | None:
    """Is the mean residual zero wherever the regressor stands? An F-test over bins of equal count.

    For a white residual the one-way analysis of variance against zero, `F = Σ n_b m_b² / B : Σ (e − m_b)² / (N − B)`;
    for a coloured one the same hypothesis on A e with filtered indicators of the bins. Equal values share a bin.

    Args:
        residual: per experiment (N_i,).
        regressor: per experiment (N_i,).
        bins: B at most; fewer where values repeat or rows are few. None is returned for a single one.
        centred: test against the mean of the residual instead of zero, with B − 1 degrees of freedom.
        a: `whitening(residual)`, where it is known already.
    """
    e, scale = _as_segments(residual), _standardised(residual)
    a = whitening(residual) if a is None else a
    placed = _bins(np.concatenate(_as_segments(regressor)), bins)
    if scale is None or a is None or placed is None:
        return None
    size = np.abs(np.concatenate(e)).max()
    whole, x = np.concatenate(e) / size, np.concatenate(_as_segments(regressor))
    whole = whole - whole.mean() if centred else whole
    counts = np.bincount(placed)
    means = np.bincount(placed, whole) / counts
    total, explained = float(whole @ whole), float(counts @ means**2)
    within = np.sqrt(max(total - explained, 0.0) / (len(whole) - len(counts)))
    cuts = np.cumsum([len(one) for one in e])[:-1]
    p = _no_relation(_bin_blocks(np.split(whole, cuts), np.split(placed, cuts), a, len(counts)), intercept=centred)
    largest = np.abs(x).max() or 1.0
    centres = np.bincount(placed, x / largest) / counts * largest
    share = min(explained / total, 1.0)
    return RegressorTest(p, share, centres, size * means, size * within / np.sqrt(counts), counts)


def _as_segments(signal: Segments) -> list[Vector]:
    parts = [signal] if isinstance(signal, np.ndarray) and signal.ndim == 1 else signal
    return [np.asarray(one, dtype=float) for one in parts]


def _standardised(segments: Segments) -> list[Vector] | None:
    """Less the mean of all samples, with a sum of squares of 1; None for a signal that is constant or not finite."""
    parts = _as_segments(segments)
    size = max((np.abs(one).max(initial=0.0) for one in parts), default=0.0)
    if not np.isfinite(size) or size == 0:
        return None
    parts = [one / size for one in parts]  # so that no square overflows
    n = sum(map(len, parts))
    mean = sum(one.sum() for one in parts) / n
    parts = [one - mean for one in parts]
    norm = np.sqrt(sum(one @ one for one in parts))
    return None if norm <= _CONSTANT * np.sqrt(n) else [one / norm for one in parts]


def _lagged_product(late: list[Vector], early: list[Vector], lag: int) -> float:
    """Σ late_k early_{k−lag}, within experiments."""
    return float(sum(x[lag:] @ y[: len(y) - lag] for x, y in zip(late, early, strict=True) if len(x) > lag))


def _spectral_product(a: Vector, u: list[Vector]) -> float:
    """Σ_m r_e(m) r_u(m), with r_e of 1/A and r_u that of the record, as the integral of the product of their spectra."""
    if len(a) == 1:
        return 1.0
    product = 0.0
    for one in u:
        size = 1 << max(2 * len(one), 2048).bit_length()  # zeros behind the record, so that it does not meet its start
        gain = 1 / np.abs(np.fft.fft(a, size)) ** 2
        product += float(np.mean(np.abs(np.fft.fft(one, size)) ** 2 * gain) / np.mean(gain))
    return product


def _lag_blocks(e: list[Vector], u: list[Vector], a: Vector, lags: int) -> Iterator[tuple[Matrix, Vector]]:
    """Rows of `(A u_k, …, A u_{k−lags})` and of `A e_k`; the input counts as at its mean before an experiment."""
    for one, other in zip(e, u, strict=True):
        if len(one) < len(a):
            continue
        target = np.convolve(one, a, "valid")
        padded = np.concatenate([np.zeros(lags), np.convolve(other, a, "valid")])
        windows = np.lib.stride_tricks.sliding_window_view(padded, lags + 1)
        for start in range(0, len(target), _ROWS):
            yield windows[start : start + _ROWS], target[start : start + _ROWS]


def _bin_blocks(e: list[Vector], placed: Sequence[Any], a: Vector, bins: int) -> Iterator[tuple[Matrix, Vector]]:
    """Rows of the indicators of all bins, filtered by A, and of `A e_k`."""
    memory = len(a) - 1
    for one, bin_of in zip(e, placed, strict=True):
        for start in range(memory, len(one), _ROWS):
            stop = min(start + _ROWS, len(one))
            member = (bin_of[start - memory : stop, None] == np.arange(bins)).astype(float)
            rows = sum(c * member[memory - j : len(member) - j] for j, c in enumerate(a))
            yield np.asarray(rows), np.convolve(one[start - memory : stop], a, "valid")


def _bins(x: Vector, bins: int) -> Int[np.ndarray, "_"] | None:
    """The bin of each sample, numbered from 0: each distinct value goes where the middle of its ranks falls."""
    bins = min(bins, len(x) // _ROWS_PER_BIN)
    if bins < 2 or not np.isfinite(x).all():
        return None
    _, place, counts = np.unique(x, return_inverse=True, return_counts=True)
    middle = np.cumsum(counts) - counts / 2
    _, number = np.unique(np.floor(middle * bins / len(x)), return_inverse=True)
    return number[place] if number[-1] > 0 else None


def _no_relation(blocks: Iterable[tuple[Matrix, Vector]], intercept: bool) -> float | None:
    """p-value of `β = 0` in `target = Z β + ε`, or `+ constant`, from blocks of rows; F(rank, rows − rank).

    A Gram matrix suffices: only the part of the target that Z explains is needed, and directions that
    it cannot resolve are dropped. They depend on Z alone, so the level stays.
    """
    gram, moment, total, mean, target_mean, rows = 0.0, 0.0, 0.0, 0.0, 0.0, 0
    for z, target in blocks:
        gram, moment, total = gram + z.T @ z, moment + z.T @ target, total + target @ target
        mean, target_mean, rows = mean + z.sum(axis=0), target_mean + target.sum(), rows + len(target)
    if not rows:
        return None
    if intercept:
        gram, moment = gram - np.outer(mean, mean) / rows, moment - np.asarray(mean) * target_mean / rows
        total -= target_mean**2 / rows
    gram = np.asarray(gram)
    diagonal = np.diag(gram)
    unit = np.where(diagonal > 0, 1 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0)), 0.0)
    values, vectors = np.linalg.eigh(gram * np.outer(unit, unit))
    kept = values > _RANK * max(values[-1], 1.0)
    rank = int(kept.sum())
    freedom = rows - rank - intercept
    if rank == 0 or freedom < 1 or total <= 0:
        return None
    explained = float(np.sum((vectors[:, kept].T @ (unit * moment)) ** 2 / values[kept]))
    left = max(float(total) - explained, np.finfo(float).tiny)
    return float(scipy.special.fdtrc(rank, freedom, explained / rank / (left / freedom)))


def _reach(level: float) -> float:
    """2.576 for a level of 0.01."""
    return float(scipy.special.ndtri(1 - level / 2))


def _rejected(tests: Mapping[str, Any], level: float) -> tuple[str, ...]:
    p = {name: test.p for name, test in tests.items() if test is not None and test.p is not None}
    return tuple(name for name, value in p.items() if value < level / len(p))


def _channels(
    experiments: Sequence[Matrix], names: Sequence[str], what: str, lengths: Sequence[int]
) -> dict[str, list[Vector]]:
    """Every channel's segments, by its name.

    Raises:
        InputError: another number of experiments, rows or columns than the residuals or the names have.
    """
    check_unique(names, f"`{what}`:")
    if len(experiments) != len(lengths) or not lengths:
        raise InputError(f"`{what}` has {len(experiments)} experiments but `residuals` has {len(lengths)}; at least 1.")
    for i, (one, rows) in enumerate(zip(experiments, lengths, strict=True)):
        if np.shape(one) != (rows, len(names)):
            raise InputError(
                f"`{what}` of experiment {i} has the shape {np.shape(one)}; expected {(rows, len(names))}: "
                "a row for every row of the residuals and a column for every name."
            )
    return {name: [np.asarray(one, dtype=float)[:, j] for one in experiments] for j, name in enumerate(names)}


def _plain(value: Any) -> Any:
    """Arrays and tuples as lists, mappings as dictionaries, numbers as Python's, None for what is not finite."""
    if isinstance(value, Mapping):
        return {key: _plain(entry) for key, entry in value.items()}
    if isinstance(value, np.ndarray | tuple | list):
        return [_plain(entry) for entry in value]
    if isinstance(value, np.integer):
        return int(value)
    if isinstance(value, float | np.floating):
        return float(value) if np.isfinite(value) else None
    return value
