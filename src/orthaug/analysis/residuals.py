"""Residual analysis: whiteness, independence of the inputs, and flatness over the regressors.

The tests are those of Ljung, System Identification (1999), sect. 16.6. Experiments are pooled. On a
large record every test rejects. The sizes of the effects are given beside the p-values for that
reason. There is no verdict here.

A coloured residual is `e = H ε` with the autoregression `H = 1/A`. The tests filter residual and
regressors by A, for `e = Z β + H ε` is `A e = (A Z) β + ε`. The F-test of β then keeps its level,
also where Z holds past outputs. What Z β adds to the colour costs some power, most with a sine.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.special
from jaxtyping import Int

from orthaug._base.checks import Matrix, Vector
from orthaug.data.record import Experiment
from orthaug.fitting.whiteness import (
    LARGEST,
    LjungBox,
    Normality,
    Pieces,
    autocorrelation,
    cross_correlation,
    excess_of_products,
    ljung_box,
    ljung_box_of,
    normality,
    pieces_of,
    split_like,
    standardise,
    whitening_filter,
)
from orthaug.models.response import Response

# Rows of a regressor matrix that exist at a time: 26 columns of them stay in the cache
_ROWS = 4096
_BINS = 20  # at most
_ROWS_PER_BIN = 5  # fewer would make bins of chance
_RANK = 1e-10  # eigenvalues of a unit-diagonal Gram matrix below this, of the largest, are rounding

LAGS = 25  # as MATLAB's `resid`
# Correlations below this are no matter, however sure a long record makes them
PRACTICALLY_WHITE = 0.05
ROUNDING = 1e-14  # of the output's deviation: a residual that says nothing

Channels = dict[str, list[Vector]]


@dataclass(frozen=True, eq=False)
class ResidualTest:
    """The tests of one output's residual.

    None for what does not exist, as for a residual that is constant.
    """

    name: str
    n: int
    level: float
    mean: float | None
    rms: float | None
    acf: Vector | None
    acf_band: float | None
    ljung_box: LjungBox | None
    white: bool | None
    """True if Ljung-Box does not reject at `level`."""
    order: int | None
    """Order of the autoregression that models the residual's colour."""
    cross: Mapping[str, CrossTest | None]
    correlated_inputs: tuple[str, ...]
    """Inputs whose joint test is below `level`, divided by the number of inputs tested
    (Bonferroni).
    """
    regressors: Mapping[str, RegressorTest | None]
    curved_regressors: tuple[str, ...]
    """Regressors over which the residual is not flat, at `level` divided by the number of
    regressors tested.
    """
    normality: Normality | None
    """Of A e, the residual made white: of coloured samples Jarque-Bera rejects far too often."""
    largest_acf: float | None
    largest_cross: float | None
    largest_share: float | None
    """Largest |r_e| beyond lag 0, largest |r_eu| over all inputs and causal lags, largest share
    over all regressors.
    """

    def practically_white(self, small: float = PRACTICALLY_WHITE) -> bool:
        """Return whether it is white by Ljung-Box, or its correlations are too small to matter."""
        return self.white is not False or self.largest_acf is None or self.largest_acf < small

    def follows(self, small: float = PRACTICALLY_WHITE) -> list[str]:
        """Return inputs that the residual follows significantly, and by enough to matter.

        The correlation is also beyond the band of the figure.
        """
        band = max([small, *(test.band for test in self.cross.values() if test is not None)])
        named = [(name, self.cross[name]) for name in self.correlated_inputs]
        return [name for name, test in named if test is not None and test.largest > band]

    def curved_over(self, share: float) -> list[str]:
        """Return regressors over which it is surely curved, by more than a share of variance."""
        named = [(name, self.regressors[name]) for name in self.curved_regressors]
        return [name for name, test in named if test is not None and test.share > share]


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
) -> tuple[ResidualTest, ...]:
    """Return all tests of the residual of every output, in their order.

    The regressor tests ask for bin means that differ from the overall mean: an offset, reported as
    `mean`, is no curve.

    Args:
        residuals: per experiment (N_i, ny), measured less model, in the outputs' units.
        inputs: per experiment (N_i, nu), of the same rows.
        regressors: per experiment (N_i, nx), of the same rows.
        output_names: of the ny columns; equally `input_names` and `regressor_names`.
        lags: of all correlations; cut where the longest experiment is shorter.
        level: of every test; the bands hold one value with probability 1 − level.

    Examples:
        >>> e, u = np.random.default_rng(0).normal(size=(2, 500, 1))
        >>> (test,) = analyse([e], [u], [u], ["y"], ["u"], ["u[k-1]"])
        >>> test.white, test.correlated_inputs, test.curved_regressors
        (True, (), ())
    """
    e = _channels(residuals, output_names)
    u, x = _channels(inputs, input_names), _channels(regressors, regressor_names)
    return tuple(_one_output(name, column, u, x, lags, level) for name, column in e.items())


def _one_output(
    name: str,
    e: list[Vector],
    inputs: Channels,
    regressors: Channels,
    lags: int,
    level: float,
) -> ResidualTest:
    whole = np.concatenate(e)
    n, finite = len(whole), len(whole) > 0 and bool(np.abs(whole).max() < LARGEST)
    acf, box, a = autocorrelation(e, lags), ljung_box(e, lags), whitening_filter(e, lags)
    cross = {key: against_input(e, u, lags, level=level, a=a) for key, u in inputs.items()}
    curves = {key: against_regressor(e, x, a=a) for key, x in regressors.items()}
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
        correlated_inputs=_rejected_tests(cross, level),
        regressors=curves,
        curved_regressors=_rejected_tests(curves, level),
        normality=None
        if a is None
        else normality([np.convolve(one, a, "valid") for one in e if len(one) >= len(a)]),
        largest_acf=None if acf is None or len(acf) < 2 else float(np.abs(acf[1:]).max()),
        largest_cross=max(
            (test.largest for test in cross.values() if test is not None), default=None
        ),
        largest_share=max(
            (test.share for test in curves.values() if test is not None), default=None
        ),
    )


def _rejected_tests(tests: Mapping[str, Any], level: float) -> tuple[str, ...]:
    p = {name: test.p for name, test in tests.items() if test is not None and test.p is not None}
    return tuple(name for name, value in p.items() if value < level / len(p))


def _channels(experiments: Sequence[Matrix], names: Sequence[str]) -> Channels:
    """Return every channel in one piece per experiment, by its name."""
    return {
        name: [np.asarray(one, dtype=float)[:, j] for one in experiments]
        for j, name in enumerate(names)
    }


def errors_of(response: Response, skip: int = 0) -> list[Matrix]:
    """Return measured less model of each experiment, on rows with a value, after `skip` of them."""
    return [trajectory.errors[skip:] for trajectory in response.trajectories]


def rms_errors(response: Response, skip: int = 0) -> Vector:
    """Return the RMS error of every output, over the rows where it was measured."""
    errors = np.concatenate(errors_of(response, skip))
    with np.errstate(all="ignore"):
        there = ~np.isnan(np.concatenate(measured_of(response, skip)))
        return np.sqrt(np.mean(errors**2, axis=0, where=there))


def measured_of(response: Response, skip: int = 0) -> list[Matrix]:
    """Return the measured outputs of each experiment on the rows of `errors_of`."""
    found = []
    for one in response.trajectories:
        assert one.measured is not None, "of a record with measured outputs"
        found.append(one.measured[one.start :][skip:])
    return found


@dataclass(frozen=True, eq=False)
class RunningTest:
    """Whiteness and independence of one output's residual over all rows.

    None for what does not exist.

    The band of a cross-correlation takes `Var r_eu(τ) = P/N` with `P = Σ_m r_e(m) r_u(m)` over |m|
    ≤ M. There is no joint test: it needs the rows.
    """

    name: str
    n: int
    mean: float
    rms: float
    acf: Vector
    acf_band: float
    ljung_box: LjungBox
    cross: Mapping[str, CrossTest | None]


class RunningResidual:
    """Sums over residuals and inputs that come piece by piece."""

    def __init__(self, outputs: Sequence[str], inputs: Sequence[str], lags: int = LAGS) -> None:
        n = 2 * len(outputs) + len(inputs)  # the squares of the residuals come last
        self.outputs, self.inputs, self.lags = tuple(outputs), tuple(inputs), lags
        self._origin: Any = None  # near the means, so that little cancels
        self._before = np.zeros((0, n))
        self._products = np.zeros((lags + 1, n, n))
        self._later, self._earlier = np.zeros((lags + 1, n)), np.zeros((lags + 1, n))
        self._pairs = np.zeros(lags + 1)
        self._ended = ("", -1)

    def add(self, residual: Matrix, inputs: Matrix, *, begins: bool) -> None:
        """Add rows (m, ny) and (m, nu) that follow those before, unless an experiment `begins`."""
        values = np.concatenate([residual, inputs], axis=1)
        if not len(values):
            return
        if self._origin is None:
            self._origin = values.mean(axis=0)
        held = self._before[:0] if begins else self._before
        with np.errstate(all="ignore"):
            values = values - self._origin
            squares = values[:, : len(self.outputs)] ** 2
            joined = np.concatenate([held, np.concatenate([values, squares], axis=1)])
            for lag in range(min(self.lags, len(joined) - 1) + 1):
                first = max(len(held), lag)
                later, earlier = joined[first:], joined[first - lag : len(joined) - lag]
                self._products[lag] += later.T @ earlier
                self._later[lag] += later.sum(axis=0)
                self._earlier[lag] += earlier.sum(axis=0)
                self._pairs[lag] += len(later)
        self._before = joined[max(len(joined) - self.lags, 0) :]

    def watch(self, piece: Experiment, first: int, residual: Matrix) -> None:
        """Add the residual of a piece from its row `first` on."""
        follows = self._ended == (piece.source, piece.offset + first)
        self.add(residual, piece.inputs[first:], begins=not follows)
        self._ended = piece.source, piece.offset + len(piece)

    def tests(self, level: float = 0.01) -> tuple[RunningTest, ...]:
        """Return the tests of every output whose residual is finite and not constant."""
        n = int(self._pairs[0])
        if n <= self.lags or not np.abs(self._products[0]).max() < LARGEST:
            return ()
        mean = self._later[0] / n
        crossed = self._later[:, :, None] * mean + mean[:, None] * self._earlier[:, None, :]
        covariance = self._products - crossed + self._pairs[:, None, None] * np.outer(mean, mean)
        size = np.sqrt(np.maximum(np.diag(covariance[0]), 0.0))
        moves = size > np.sqrt(np.finfo(float).eps) * np.sqrt(np.diag(self._products[0]))
        r = covariance / np.where(moves[:, None] & moves, np.outer(size, size), 1.0)
        quantile = float(-scipy.special.ndtri(level / 2))
        found = []
        for i, name in enumerate(self.outputs):
            if not moves[i]:
                continue
            acf, centre = r[:, i, i], float(self._origin[i] + mean[i])
            cross = {
                other: self._cross(r, i, len(self.outputs) + j, n, quantile)
                if moves[len(self.outputs) + j]
                else None
                for j, other in enumerate(self.inputs)
            }
            excess = self._excess(acf, covariance, mean, i, n)
            box = ljung_box_of(acf, self._pairs[1:], n, excess=excess)
            rms = float(np.hypot(size[i] / np.sqrt(n), centre))
            found.append(RunningTest(name, n, centre, rms, acf, quantile / np.sqrt(n), box, cross))
        return tuple(found)

    def _excess(self, acf: Vector, covariance: Any, mean: Vector, e: int, n: int) -> Vector | None:
        """Return what uneven sizes of an output's residual make of its correlations, or None.

        The square of a residual less its mean μ is `s − 2 μ e + μ²`, with s its square.
        """
        s, centre = len(mean) - len(self.outputs) + e, mean[e]
        own = covariance[:, s, s] - 2 * centre * (covariance[:, s, e] + covariance[:, e, s])
        own = own + 4 * centre**2 * covariance[:, e, e]
        if not own[0] > 0:
            return None
        level = covariance[0, e, e] / n
        sums = [
            side[:, s] - 2 * centre * side[:, e] + self._pairs * centre**2
            for side in (self._later, self._earlier)
        ]
        products = own + level * (sums[0] + sums[1]) - self._pairs * level**2
        products = products[1:] / covariance[0, e, e] ** 2
        return excess_of_products(acf, own / own[0], products, self._pairs[1:], n)

    def _cross(self, r: Any, e: int, u: int, n: int, quantile: float) -> CrossTest:
        follows = r[:, e, u]
        values = np.concatenate([r[:0:-1, u, e], follows])
        product = 2 * float(r[:, e, e] @ r[:, u, u]) - 1
        lag = int(np.abs(follows).argmax())
        band = quantile * float(np.sqrt(max(product, 0.0) / n))
        return CrossTest(values, band, None, lag, float(np.abs(follows[lag])))


@dataclass(frozen=True, eq=False)
class CrossTest:
    """Residual against an input: `values` (2M + 1,) are r_eu(τ), τ = −M…M, each with a `band`."""

    values: Vector
    band: float
    p: float | None
    """Of the joint test of the lags 0…M; None where there are too few rows for it."""
    lag: int
    """The causal lag, 0…M, with the largest |r_eu|, and that value: `largest`."""
    largest: float


@dataclass(frozen=True, eq=False)
class RegressorTest:
    """Residual against a regressor, by bins: p-value of no relation, explained share of variance.

    Per bin: `centres` (mean of the regressor, in its unit), `means` of the residual and their
    standard `errors` (in the residual's unit), and `counts` of rows. The means are those that the
    test looks at: of a coloured residual by generalised least squares, less the mean of all rows
    where the test is centred. Where the rows do not separate them they are plain means, with
    errors that take the residual as white.
    """

    p: float | None
    share: float
    centres: Vector
    means: Vector
    errors: Vector
    counts: Int[np.ndarray, "_"]


def against_input(
    residual: Pieces,
    inputs: Pieces,
    lags: int = 25,
    *,
    level: float = 0.01,
    a: Vector | None = None,
) -> CrossTest | None:
    """Test the residual's independence of an input: band of r_eu(τ), joint test of the causal lags.

    Ljung (1999), sect. 16.6.

    Band of one value: `Var r_eu(τ) = P/N` with `P = Σ_m r_e(m) r_u(m)` over all m, which is 1 for a
    white residual whatever the input. r_e is that of 1/A: a sum over two sample functions would not
    settle as N grows.
    Joint test: `ζ = N r_euᵀ P⁻¹ r_eu` ~ χ²(M + 1) of A e and A u, for which P is the correlation
    matrix of A u, taken from the record; as ζ/(M + 1) with the variance left over it has an
    F-distribution. Directions of the lags that the input does not excite (a sine excites two) are
    left out. None where either signal is constant.

    Args:
        residual, inputs: per experiment (N_i,).
        lags: M.
        level: the band holds one value of r_eu with probability 1 − level.
        a: `whitening(residual)`, where it is known already.
    """
    values = cross_correlation(residual, inputs, lags)
    e, u = standardise(residual), standardise(inputs)
    a = whitening_filter(residual, lags) if a is None else a
    if values is None or e is None or u is None or a is None:
        return None
    band = float(
        -scipy.special.ndtri(level / 2) * np.sqrt(_spectral_product(a, u) / sum(map(len, e)))
    )
    found = _relation(_lag_blocks(e, u, a, len(values) // 2))
    causal = np.abs(values[len(values) // 2 :])
    return CrossTest(
        values, band, None if found is None else found.p, int(causal.argmax()), float(causal.max())
    )


def against_regressor(
    residual: Pieces, regressor: Pieces, *, a: Vector | None = None
) -> RegressorTest | None:
    """Test whether the residual has its mean all over the regressor, by an F-test over equal bins.

    A white residual, less its mean, is tested by the one-way analysis of variance, `F = Σ n_b m_b²
    / (B − 1) : Σ (e − m_b)² / (N − B)`; for a coloured one the same hypothesis on A e with filtered
    indicators of the bins. Equal values share a bin. None for a regressor or residual that is
    constant or not finite, or fewer than 10 rows.

    Args:
        residual, regressor: per experiment (N_i,).
        a: `whitening(residual)`, where it is known already.
    """
    e, x = pieces_of(residual), np.concatenate(pieces_of(regressor))
    a = whitening_filter(e) if a is None else a
    placed = _bins(x)
    if a is None or placed is None:
        return None
    size = np.abs(np.concatenate(e)).max()
    whole = np.concatenate(e) / size
    whole = whole - whole.mean()
    counts = np.bincount(placed)
    means = np.bincount(placed, whole) / counts
    total, explained = float(whole @ whole), float(counts @ means**2)
    within = np.sqrt(max(total - explained, 0.0) / (len(whole) - len(counts)))
    found = _relation(_bin_blocks(split_like(whole, e), split_like(placed, e), a, len(counts)))
    errors = within / np.sqrt(counts)
    if found is not None and found.rank == len(counts) - 1:
        contrast = np.eye(len(counts)) - counts / len(whole)  # to the mean of all rows
        means = contrast @ found.coefficients
        errors = np.sqrt(np.maximum(np.diag(contrast @ found.covariance @ contrast.T), 0.0))
    centres, p = np.bincount(placed, x) / counts, None if found is None else found.p
    return RegressorTest(
        p, min(explained / total, 1.0), centres, size * means, size * errors, counts
    )


def _spectral_product(a: Vector, u: list[Vector]) -> float:
    """Return Σ_m r_e(m) r_u(m) as the integral of the product of their spectra.

    r_e is that of 1/A, r_u that of the record.
    """
    if len(a) == 1:
        return 1.0
    product = 0.0
    for one in u:
        # Zeros behind the record, so that it does not meet its start
        size = 1 << max(2 * len(one), 2048).bit_length()
        gain = (
            1 / np.maximum(np.abs(np.fft.fft(a, size)), np.finfo(float).eps * np.abs(a).sum()) ** 2
        )
        product += float(np.mean(np.abs(np.fft.fft(one, size)) ** 2 * gain) / np.mean(gain))
    return product


def _lag_blocks(e: list[Vector], u: list[Vector], a: Vector, lags: int) -> Iterator[Matrix]:
    """Yield rows of `(1, A u_k, …, A u_{k−lags}, A e_k)`.

    If rows are few also the first, with lags at the input's mean.
    """
    # A start from rest would excite all directions
    known = lags if 2 * lags * len(e) < sum(map(len, e)) else 0
    for one, other in zip(e, u, strict=True):
        if len(one) >= len(a):
            target = np.convolve(one, a, "valid")
            padded = np.concatenate([np.zeros(lags), np.convolve(other, a, "valid")])
            windows = np.lib.stride_tricks.sliding_window_view(padded, lags + 1)
            for i in range(known, len(target), _ROWS):
                part = target[i : i + _ROWS]
                yield np.column_stack([np.ones(len(part)), windows[i : i + _ROWS], part])


def _bin_blocks(
    e: list[Vector], placed: list[np.ndarray], a: Vector, bins: int
) -> Iterator[Matrix]:
    """Yield rows of the indicators of all bins, filtered by A, between 1 and `A e_k`."""
    memory = len(a) - 1
    for one, bin_of in zip(e, placed, strict=True):
        for i in range(memory, len(one), _ROWS):
            rows = slice(i - memory, i + _ROWS)
            member = (bin_of[rows, None] == np.arange(bins)).astype(float)
            filtered = sum(c * member[memory - j : len(member) - j] for j, c in enumerate(a))
            target = np.convolve(one[rows], a, "valid")
            yield np.column_stack([np.ones(len(target)), np.asarray(filtered), target])


def _bins(x: Vector) -> Int[np.ndarray, "_"] | None:
    """Return the bin of each sample, from 0; equal values share the bin of their middle rank."""
    bins = min(_BINS, len(x) // _ROWS_PER_BIN)
    if bins < 2 or not np.abs(x).max() < LARGEST:  # true for NaN, too
        return None
    _, place, counts = np.unique(x, return_inverse=True, return_counts=True)
    middle = np.cumsum(counts) - counts / 2
    _, number = np.unique(np.floor(middle * bins / len(x)), return_inverse=True)
    return number[place] if number[-1] > 0 else None


@dataclass(frozen=True, eq=False)
class _Relation:
    """Least squares `target = Z β + ε`: p-value of `β = 0`, and β with its covariance.

    Both are in the directions of Z's rank.
    """

    p: float
    rank: int
    coefficients: Vector
    covariance: Matrix


def _relation(blocks: Iterable[Matrix]) -> _Relation | None:
    """Return β of `target = Z β + constant + ε` from blocks of rows (1, Z, target).

    P by F(rank, rest).

    A Gram matrix suffices: only the part of the target that Z explains is needed, and directions
    that it cannot resolve are dropped. They depend on Z alone, so the level stays.
    """
    gram = np.asarray(sum(block.T @ block for block in blocks))
    if not gram.ndim:
        return None
    rows = gram[0, 0]
    gram = gram - np.outer(gram[0], gram[0]) / rows
    inner, moment, total = gram[1:-1, 1:-1], gram[1:-1, -1], gram[-1, -1]
    unit = 1 / np.sqrt(np.where(np.diag(inner) > 0, np.diag(inner), np.inf))
    values, vectors = np.linalg.eigh(inner * np.outer(unit, unit))
    kept = values > _RANK * max(values[-1], 1.0)
    rank, freedom = int(kept.sum()), rows - kept.sum() - 1
    if rank == 0 or freedom < 1 or total <= 0:
        return None
    # Of the inverse of the inner products
    root = unit[:, None] * vectors[:, kept] / np.sqrt(values[kept])
    explained = np.sum((root.T @ moment) ** 2)
    left = max(total - explained, np.finfo(float).eps * total) / freedom
    p = float(scipy.special.fdtrc(rank, freedom, explained / rank / left))
    return _Relation(p, rank, root @ (root.T @ moment), left * root @ root.T)
