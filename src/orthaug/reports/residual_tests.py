"""Tests of residuals as results hold them."""

from __future__ import annotations

from orthaug.reports.fields import Content, Flag, Number, Numbers, Whole, Wholes


class LjungBoxResult(Content):
    """Whether the residual is white."""

    statistic: Number
    freedom: Whole
    p: Number


class NormalityResult(Content):
    """Whether the whitened residual is normal."""

    statistic: Number
    p: Number
    skewness: Number
    kurtosis: Number


class CrossResult(Content):
    """A residual against an input."""

    values: Numbers
    band: Number
    p: Number
    lag: Whole
    largest: Number


class RegressorResult(Content):
    """A residual over a regressor, by bins."""

    p: Number
    share: Number
    centres: Numbers
    means: Numbers
    errors: Numbers
    counts: Wholes


class ResidualTestResult(Content):
    """All tests of one output's residual."""

    name: str
    n: Whole
    level: Number
    mean: Number
    rms: Number
    acf: Numbers | None
    acf_band: Number
    ljung_box: LjungBoxResult | None
    white: Flag | None
    order: Whole | None
    cross: dict[str, CrossResult | None]
    correlated_inputs: list[str]
    regressors: dict[str, RegressorResult | None]
    curved_regressors: list[str]
    normality: NormalityResult | None
    largest_acf: Number
    largest_cross: Number
    largest_share: Number


class RunningTestResult(Content):
    """Whiteness and independence of one output's residual, from running sums over all rows."""

    name: str
    n: Whole
    mean: Number
    rms: Number
    acf: Numbers
    acf_band: Number
    ljung_box: LjungBoxResult
    cross: dict[str, CrossResult | None]
