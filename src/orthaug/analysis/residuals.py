"""Residual analysis: is what a model leaves over white, independent of the inputs, and flat over the regressors?

Ljung, System Identification (1999), sect. 16.6. Experiments are pooled, no product crosses their boundaries. Where the
residual is coloured, `e = H ε` with `H = 1/A` an autoregression, dependence is tested by `A e` on equally filtered
regressors: `e = Z β + H ε` is `A e = (A Z) β + ε`, whose F-test keeps its level, also where Z holds past outputs. What
Z β adds to the colour costs some power, most with a sine. On large records every test rejects; the sizes of the effects
stand beside the p-values for that reason. There is no verdict here.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.special
from jaxtyping import Int

from orthaug._base.checks import Matrix, Vector, check_count, check_number, check_unique
from orthaug._base.errors import InputError

Segments = Sequence[Vector] | Vector  # one signal of several experiments; a plain vector is one experiment
Channels = dict[str, list[Vector]]

_ROWS = 4096  # rows of a regressor matrix that exist at a time: 26 columns of them stay in the cache
_ROWS_PER_BIN = 5  # fewer would make bins of chance
_ROWS_PER_LAG = 20  # with fewer, Ljung-Box rejects too often (3 % instead of 1 % at 4) and AIC overfits
_CONSTANT = 64 * np.finfo(float).eps  # rounding of the mean: a smaller deviation, against the largest value, is none
_LARGEST = 1e150  # squares of larger values overflow: a model that left all bounds has no statistics
_RANK = 1e-10  # eigenvalues of a unit-diagonal Gram matrix below this, of the largest, are rounding


@dataclass(frozen=True)
class LjungBox:
    """Statistic Q, degrees of freedom, and the probability of a larger Q where the residual is white."""

    statistic: float
    freedom: int
    p: float


@dataclass(frozen=True)
class Normality:
    """Jarque-Bera statistic (χ² with 2 degrees of freedom) and p-value; skewness and excess kurtosis."""

    statistic: float
    p: float
    skewness: float
    kurtosis: float


@dataclass(frozen=True, eq=False)
class CrossTest:
    """Residual against an input: `values` (2M + 1,) are r_eu(τ), τ = −M…M, and `band` holds one of them."""

    values: Vector
    band: float
    p: float | None
    """Of the joint test of the lags 0…M; None where there are too few rows for it."""
    lag: int
    """The causal lag, 0…M, with the largest |r_eu|, and that value: `largest`."""
    largest: float


@dataclass(frozen=True, eq=False)
class RegressorTest:
    """Residual against a regressor, by bins: p-value of no relation, share of the residual's variance explained.

    Per bin: `centres` (mean of the regressor, in its unit), `means` of the residual and their standard `errors` from
    the deviation within the bins (in the residual's unit; the errors take it as white), and `counts` of rows.
    """

    p: float | None
    share: float
    centres: Vector
    means: Vector
    errors: Vector
    counts: Int[np.ndarray, "_"]


@dataclass(frozen=True, eq=False)
class ResidualTest:
    """The tests of one output's residual; None for what does not exist, as for a residual that is constant."""

    name: str
    n: int
    level: float
    mean: float | None
    rms: float | None
    acf: Vector | None
    acf_band: float | None
    ljung_box: LjungBox | None
    white: bool | None
    """Whether Ljung-Box does not reject at `level`."""
    order: int | None
    """Order of the autoregression that stands for the residual's colour."""
    cross: Mapping[str, CrossTest | None]
    correlated_inputs: tuple[str, ...]
    """Inputs whose joint test is below `level`, divided by the number of inputs tested (Bonferroni)."""
    regressors: Mapping[str, RegressorTest | None]
    curved_regressors: tuple[str, ...]
    """Regressors over which the residual is not flat, at `level` divided by the number of regressors tested."""
    normality: Normality | None
    """Of A e, the residual made white: of coloured samples Jarque-Bera rejects far too often."""
    largest_acf: float | None
    largest_cross: float | None
    largest_share: float | None
    """Largest |r_e| beyond lag 0, largest |r_eu| over all inputs and causal lags, largest share over all regressors."""


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
    """All tests of the residual of every output, in their order.

    The regressor tests ask for bin means that differ from the overall mean: an offset, reported as `mean`, is no curve.

    Args:
        residuals: per experiment (N_i, ny), measured less model, in the outputs' units.
        inputs: per experiment (N_i, nu), of the same rows.
        regressors: per experiment (N_i, nx), of the same rows.
        output_names: of the ny columns; equally `input_names` and `regressor_names`.
        lags: of all correlations; cut where the longest experiment is shorter.
        level: of every test; the bands hold one value with probability 1 − level.
        fitted: dynamic parameters whose fit has used up degrees of freedom of Ljung-Box.

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
    name: str, e: list[Vector], inputs: Channels, regressors: Channels, lags: int, level: float, fitted: int
) -> ResidualTest:
    whole = np.concatenate(e)
    n, finite = len(whole), len(whole) > 0 and bool(np.abs(whole).max() < _LARGEST)
    acf, box, a = autocorrelation(e, lags), ljung_box(e, lags, fitted), whitening(e, lags)
    cross = {key: against_input(e, u, lags, level=level, a=a) for key, u in inputs.items()}
    curves = {key: against_regressor(e, x, centred=True, a=a) for key, x in regressors.items()}
    return ResidualTest(
        name=name,
        n=n,
        level=float(level),
        mean=float(whole.mean()) if finite else None,
        rms=float(np.sqrt(np.mean(whole**2))) if finite else None,
        acf=acf,
        acf_band=None if acf is None else float(-scipy.special.ndtri(level / 2) / np.sqrt(n)),
        ljung_box=box,
        white=None if box is None else box.p >= level,
        order=None if a is None else len(a) - 1,
        cross=cross,
        correlated_inputs=_rejected(cross, level),
        regressors=curves,
        curved_regressors=_rejected(curves, level),
        normality=None if a is None else normality([np.convolve(one, a, "valid") for one in e if len(one) >= len(a)]),
        largest_acf=None if acf is None or len(acf) < 2 else float(np.abs(acf[1:]).max()),
        largest_cross=max((test.largest for test in cross.values() if test is not None), default=None),
        largest_share=max((test.share for test in curves.values() if test is not None), default=None),
    )


def autocorrelation(segments: Segments, lags: int = 25) -> Vector | None:
    """r_e(τ) = Σ e_k e_{k−τ} / Σ e_k², e less its mean, for τ = 0…lags, (lags + 1,).

    The mean is that of all experiments. Lags as long as the longest experiment are cut; None for a constant signal.
    """
    values = cross_correlation(segments, segments, lags)
    return None if values is None else values[len(values) // 2 :]


def cross_correlation(residual: Segments, inputs: Segments, lags: int = 25) -> Vector | None:
    """r_eu(τ) = Σ e_k u_{k−τ} / √(Σ e_k² Σ u_k²), means removed, for τ = −lags…lags, (2 lags + 1,).

    At τ ≥ 0 the residual follows the input. Lags are cut as in `autocorrelation`; None where one signal is constant.
    """
    e, u = _standardised(residual), _standardised(inputs)
    if e is None or u is None:
        return None
    reach = min(lags, max(map(len, e)) - 1)
    pairs = list(zip(e, u, strict=True))
    leads = [sum(y[lag:] @ x[: len(x) - lag] for x, y in pairs if len(x) > lag) for lag in range(reach, 0, -1)]
    follows = [sum(x[lag:] @ y[: len(y) - lag] for x, y in pairs if len(x) > lag) for lag in range(reach + 1)]
    return np.array(leads + follows)


def ljung_box(segments: Segments, lags: int = 25, fitted: int = 0) -> LjungBox | None:
    """Whiteness: `Q = N (N + 2) Σ_τ r_e(τ)² / n_τ` ~ χ²(lags − fitted), τ = 1…lags (Ljung and Box 1978).

    n_τ is the number of pairs of samples τ apart within experiments; for one experiment N − τ. At most a lag for every
    20 rows; None for a residual that is constant, not finite, or shorter than that.
    """
    lengths = np.array([len(one) for one in _as_segments(segments)])
    n = int(lengths.sum())
    acf = autocorrelation(segments, min(lags, n // _ROWS_PER_LAG))
    if acf is None or len(acf) < 2:
        return None
    pairs = np.maximum(lengths[:, None] - np.arange(1, len(acf)), 0).sum(axis=0)
    statistic = float(n * (n + 2.0) * np.sum(acf[1:] ** 2 / pairs))
    freedom = max(len(pairs) - fitted, 1)
    return LjungBox(statistic, freedom, float(scipy.special.chdtrc(freedom, statistic)))


def normality(segments: Segments) -> Normality | None:
    """Jarque-Bera, `N/6 (S² + K²/4)` ~ χ²(2), of skewness S and excess kurtosis K (population moments).

    For independent samples. The distribution is approached slowly: below some 2000 rows the p-value is rough.
    """
    e = _standardised(segments)
    if e is None:
        return None
    n, whole = sum(map(len, e)), np.concatenate(e)
    skewness, kurtosis = float(n**0.5 * np.sum(whole**3)), float(n * np.sum(whole**4)) - 3
    statistic = n / 6 * (skewness**2 + kurtosis**2 / 4)
    return Normality(statistic, float(scipy.special.chdtrc(2, statistic)), skewness, kurtosis)


def whitening(segments: Segments, largest: int = 25) -> Vector | None:
    """The coefficients (1, a_1, …, a_p) of `A(q) e_k = ε_k`, ε white: Burg's recursion over all experiments, p by AIC.

    None for a signal that is constant or not finite. Burg's A is stable and, unlike that of Yule and Walker, hardly
    biased near the unit circle.
    """
    forward = backward = _standardised(segments)
    if forward is None or backward is None:
        return None
    a = best = np.ones(1)
    criterion = lowest = 0.0
    for order in range(1, largest + 1):
        forward, backward = [f[1:] for f in forward], [b[:-1] for b in backward]
        rows = sum(map(len, forward))
        energy = sum(f @ f + b @ b for f, b in zip(forward, backward, strict=True))
        product = sum(f @ b for f, b in zip(forward, backward, strict=True))
        k = -2 * product / energy if energy > rows * _CONSTANT**2 else 1.0
        if rows < _ROWS_PER_LAG * order or 1 - k**2 < _CONSTANT:  # too few rows, or nothing is left to predict
            break
        both = list(zip(forward, backward, strict=True))
        forward, backward = [f + k * b for f, b in both], [b + k * f for f, b in both]
        a = np.append(a, 0.0) + k * np.append(a, 0.0)[::-1]
        criterion += rows * np.log(1 - k**2) + 2
        if criterion < lowest:
            best, lowest = a, criterion
    return best


def against_input(
    residual: Segments, inputs: Segments, lags: int = 25, *, level: float = 0.01, a: Vector | None = None
) -> CrossTest | None:
    """Is the residual independent of an input? Band of r_eu(τ) and joint test of the causal lags (Ljung, sect. 16.6).

    Band of one value: `Var r_eu(τ) = P/N` with `P = Σ_m r_e(m) r_u(m)` over all m, which is 1 for a white residual
    whatever the input. r_e is that of 1/A: a sum over two sample functions would not settle as N grows.
    Joint test: `ζ = N r_euᵀ P⁻¹ r_eu` ~ χ²(M + 1) of A e and A u, for which P is the correlation matrix of A u,
    taken from the record; as ζ/(M + 1) with the variance left over it has an F-distribution. Directions of the
    lags that the input does not excite (a sine excites two) are left out. None where either signal is constant.

    Args:
        residual, inputs: per experiment (N_i,).
        lags: M.
        level: the band holds one value of r_eu with probability 1 − level.
        a: `whitening(residual)`, where it is known already.
    """
    values = cross_correlation(residual, inputs, lags)
    e, u = _standardised(residual), _standardised(inputs)
    a = whitening(residual, lags) if a is None else a
    if values is None or e is None or u is None or a is None:
        return None
    band = float(-scipy.special.ndtri(level / 2) * np.sqrt(_spectral_product(a, u) / sum(map(len, e))))
    p = _no_relation(_lag_blocks(e, u, a, len(values) // 2), intercept=True)
    causal = np.abs(values[len(values) // 2 :])
    return CrossTest(values, band, p, int(causal.argmax()), float(causal.max()))


def against_regressor(
    residual: Segments, regressor: Segments, bins: int = 20, *, centred: bool = False, a: Vector | None = None
) -> RegressorTest | None:
    """Is the mean residual zero wherever the regressor stands? An F-test over bins of equal count.

    For a white residual the one-way analysis of variance against zero, `F = Σ n_b m_b² / B : Σ (e − m_b)² / (N − B)`;
    for a coloured one the same hypothesis on A e with filtered indicators of the bins. Equal values share a bin.
    None for a regressor or residual that is constant or not finite, or fewer than 10 rows.

    Args:
        residual, regressor: per experiment (N_i,).
        bins: B at most; fewer where values repeat, or where bins would have fewer than 5 rows.
        centred: test against the mean of the residual instead of zero, with B − 1 degrees of freedom.
        a: `whitening(residual)`, where it is known already.
    """
    e, x = _as_segments(residual), np.concatenate(_as_segments(regressor))
    a = whitening(e) if a is None else a
    placed = _bins(x, bins)
    if a is None or placed is None:
        return None
    size = np.abs(np.concatenate(e)).max()
    whole = np.concatenate(e) / size
    whole = whole - centred * whole.mean()
    counts = np.bincount(placed)
    means = np.bincount(placed, whole) / counts
    total, explained = float(whole @ whole), float(counts @ means**2)
    within = np.sqrt(max(total - explained, 0.0) / (len(whole) - len(counts)))
    p = _no_relation(_bin_blocks(_cut(whole, e), _cut(placed, e), a, len(counts)), intercept=centred)
    centres, errors = np.bincount(placed, x) / counts, within / np.sqrt(counts)
    return RegressorTest(p, min(explained / total, 1.0), centres, size * means, size * errors, counts)


def _as_segments(signal: Segments) -> list[Vector]:
    parts = [signal] if isinstance(signal, np.ndarray) and signal.ndim == 1 else signal
    return [np.asarray(one, dtype=float) for one in parts]


def _standardised(segments: Segments) -> list[Vector] | None:
    """Less the mean of all samples, with a sum of squares of 1; None for a signal that is constant or not finite."""
    parts = _as_segments(segments)
    whole = np.concatenate(parts) if len(parts) else np.zeros(0)
    size = np.abs(whole).max(initial=0.0)
    if not 0 < size < _LARGEST:
        return None
    whole = whole / size - np.mean(whole / size)  # so that no square underflows
    norm = np.linalg.norm(whole)
    return None if norm <= _CONSTANT * np.sqrt(len(whole)) else _cut(whole / norm, parts)


def _cut(whole: Any, like: Sequence[Vector]) -> list[Any]:
    """A signal in experiments as long as those of another."""
    return np.split(whole, np.cumsum([len(one) for one in like])[:-1])


def _spectral_product(a: Vector, u: list[Vector]) -> float:
    """Σ_m r_e(m) r_u(m), with r_e of 1/A and r_u of the record, as the integral of the product of their spectra."""
    if len(a) == 1:
        return 1.0
    product = 0.0
    for one in u:
        size = 1 << max(2 * len(one), 2048).bit_length()  # zeros behind the record, so that it does not meet its start
        gain = 1 / np.maximum(np.abs(np.fft.fft(a, size)), np.finfo(float).eps * np.abs(a).sum()) ** 2
        product += float(np.mean(np.abs(np.fft.fft(one, size)) ** 2 * gain) / np.mean(gain))
    return product


def _lag_blocks(e: list[Vector], u: list[Vector], a: Vector, lags: int) -> Iterator[Matrix]:
    """Rows of `(1, A u_k, …, A u_{k−lags}, A e_k)`; if rows are few also the first, with lags at the input's mean."""
    known = lags if 2 * lags * len(e) < sum(map(len, e)) else 0  # a start from rest would excite all directions
    for one, other in zip(e, u, strict=True):
        if len(one) >= len(a):
            target = np.convolve(one, a, "valid")
            padded = np.concatenate([np.zeros(lags), np.convolve(other, a, "valid")])
            windows = np.lib.stride_tricks.sliding_window_view(padded, lags + 1)
            for i in range(known, len(target), _ROWS):
                part = target[i : i + _ROWS]
                yield np.column_stack([np.ones(len(part)), windows[i : i + _ROWS], part])


def _bin_blocks(e: list[Vector], placed: list[Any], a: Vector, bins: int) -> Iterator[Matrix]:
    """Rows of the indicators of all bins, filtered by A, between 1 and `A e_k`."""
    memory = len(a) - 1
    for one, bin_of in zip(e, placed, strict=True):
        for i in range(memory, len(one), _ROWS):
            rows = slice(i - memory, i + _ROWS)
            member = (bin_of[rows, None] == np.arange(bins)).astype(float)
            filtered = sum(c * member[memory - j : len(member) - j] for j, c in enumerate(a))
            target = np.convolve(one[rows], a, "valid")
            yield np.column_stack([np.ones(len(target)), np.asarray(filtered), target])


def _bins(x: Vector, bins: int) -> Int[np.ndarray, "_"] | None:
    """The bin of each sample, numbered from 0: each distinct value goes where the middle of its ranks falls."""
    bins = min(bins, len(x) // _ROWS_PER_BIN)
    if bins < 2 or not np.abs(x).max() < _LARGEST:  # true for NaN, too
        return None
    _, place, counts = np.unique(x, return_inverse=True, return_counts=True)
    middle = np.cumsum(counts) - counts / 2
    _, number = np.unique(np.floor(middle * bins / len(x)), return_inverse=True)
    return number[place] if number[-1] > 0 else None


def _no_relation(blocks: Iterable[Matrix], intercept: bool) -> float | None:
    """p-value of `β = 0` in `target = Z β + ε`, or `+ constant`, from blocks of rows (1, Z, target); F(rank, rest).

    A Gram matrix suffices: only the part of the target that Z explains is needed, and directions that
    it cannot resolve are dropped. They depend on Z alone, so the level stays.
    """
    gram = np.asarray(sum(block.T @ block for block in blocks))
    if not gram.ndim:
        return None
    rows = gram[0, 0]
    gram = gram - intercept * np.outer(gram[0], gram[0]) / rows
    inner, moment, total = gram[1:-1, 1:-1], gram[1:-1, -1], gram[-1, -1]
    unit = 1 / np.sqrt(np.where(np.diag(inner) > 0, np.diag(inner), np.inf))
    values, vectors = np.linalg.eigh(inner * np.outer(unit, unit))
    kept = values > _RANK * max(values[-1], 1.0)
    rank, freedom = kept.sum(), rows - kept.sum() - intercept
    if rank == 0 or freedom < 1 or total <= 0:
        return None
    explained = np.sum((vectors[:, kept].T @ (unit * moment)) ** 2 / values[kept])
    left = max(total - explained, np.finfo(float).eps * total)
    return float(scipy.special.fdtrc(rank, freedom, explained / rank / (left / freedom)))


def _rejected(tests: Mapping[str, Any], level: float) -> tuple[str, ...]:
    p = {name: test.p for name, test in tests.items() if test is not None and test.p is not None}
    return tuple(name for name, value in p.items() if value < level / len(p))


def _channels(experiments: Sequence[Matrix], names: Sequence[str], what: str, lengths: Sequence[int]) -> Channels:
    """Every channel's segments, by its name."""
    check_unique(names, f"`{what}`:")
    if len(experiments) != len(lengths) or not lengths:
        raise InputError(f"`{what}` has {len(experiments)} experiments but `residuals` has {len(lengths)}; at least 1.")
    for i, (one, rows) in enumerate(zip(experiments, lengths, strict=True)):
        if np.shape(one) != (rows, len(names)):
            shape = f"{np.shape(one)}; its residuals and names make {(rows, len(names))}"
            raise InputError(f"`{what}` of experiment {i} has the shape {shape}.")
    return {name: [np.asarray(one, dtype=float)[:, j] for one in experiments] for j, name in enumerate(names)}
