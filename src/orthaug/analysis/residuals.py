"""Residual analysis: whiteness, independence of the inputs, and flatness over the regressors.

The tests are those of Ljung, System Identification (1999), sect. 16.6. Experiments are pooled. On a
large record every test rejects. The sizes of the effects are given beside the p-values for that
reason. There is no verdict here.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.special

from orthaug._base.checks import Matrix, Vector, check_count, check_number, check_unique
from orthaug._base.errors import InputError
from orthaug.analysis.independence import CrossTest, RegressorTest, against_input, against_regressor
from orthaug.data.record import Experiment
from orthaug.fitting.whiteness import (
    LARGEST,
    LjungBox,
    Normality,
    autocorrelation,
    excess_of_products,
    ljung_box,
    ljung_box_of,
    normality,
    whitening_filter,
)
from orthaug.models.response import Response

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
    fitted: int = 0,
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
        fitted: dynamic parameters whose fit has used up degrees of freedom of Ljung-Box.

    Raises:
        InputError: experiments, rows or columns that do not match, a name twice, or a setting out
            of range.

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
    inputs: Channels,
    regressors: Channels,
    lags: int,
    level: float,
    fitted: int,
) -> ResidualTest:
    whole = np.concatenate(e)
    n, finite = len(whole), len(whole) > 0 and bool(np.abs(whole).max() < LARGEST)
    acf, box, a = autocorrelation(e, lags), ljung_box(e, lags, fitted), whitening_filter(e, lags)
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


def _channels(
    experiments: Sequence[Matrix], names: Sequence[str], what: str, lengths: Sequence[int]
) -> Channels:
    """Return every channel in one piece per experiment, by its name."""
    check_unique(names, f"`{what}`:")
    if len(experiments) != len(lengths) or not lengths:
        raise InputError(
            f"`{what}` has {len(experiments)} experiments but `residuals` has {len(lengths)}; "
            "at least 1."
        )
    for i, (one, rows) in enumerate(zip(experiments, lengths, strict=True)):
        if np.shape(one) != (rows, len(names)):
            shape = f"{np.shape(one)}; its residuals and names make {(rows, len(names))}"
            raise InputError(f"`{what}` of experiment {i} has the shape {shape}.")
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
