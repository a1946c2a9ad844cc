"""Tests of residuals in results."""

from __future__ import annotations

from orthaug._base.content import Content, Flag, Number, Numbers, Whole, Wholes
from orthaug.fitting.whiteness import LjungBox, Normality


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
    ljung_box: LjungBox | None
    white: Flag | None
    order: Whole | None
    cross: dict[str, CrossResult | None]
    correlated_inputs: list[str]
    regressors: dict[str, RegressorResult | None]
    curved_regressors: list[str]
    normality: Normality | None
    largest_acf: Number
    largest_cross: Number
    largest_share: Number

    @property
    def crossed(self) -> dict[str, CrossResult]:
        """Inputs that the residual was compared with."""
        return {name: cross for name, cross in self.cross.items() if cross is not None}

    @property
    def cross_band(self) -> float:
        """Widest of their bands."""
        return max((cross.band or 0.0 for cross in self.crossed.values()), default=0.0)

    @property
    def strongest(self) -> dict[str, RegressorResult]:
        """Regressor on which the residual depends most clearly.

        It is the one of the most certain curvature, or that explains most where none has any.

        By its name; empty where none was tested.
        """
        curves = {name: curve for name, curve in self.regressors.items() if curve is not None}
        curved = [name for name in self.curved_regressors if name in curves]
        shares = {name: curve.share or 0.0 for name, curve in curves.items()}
        best = min(curved, key=lambda name: (curves[name].p or 0.0, -shares[name]), default=None)
        best = max(curves, key=lambda name: shares[name], default=None) if best is None else best
        return {} if best is None else {best: curves[best]}

    @property
    def strongest_acf(self) -> float | None:
        """Autocorrelation that is largest in size, with its sign."""
        return max(
            (value for value in (self.acf or [])[1:] if value is not None), key=abs, default=None
        )


class RunningTestResult(Content):
    """Whiteness and independence of one output's residual, from running sums over all rows."""

    name: str
    n: Whole
    mean: Number
    rms: Number
    acf: Numbers
    acf_band: Number
    ljung_box: LjungBox
    cross: dict[str, CrossResult | None]
