"""The table of parameters with their intervals: as a DataFrame, and as lines."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from orthaug._base.checks import Matrix, Vector

if TYPE_CHECKING:
    import pandas as pd


def parameter_frame(parameters: Sequence[Any], values: Vector, std: Vector | None, ci: Matrix | None) -> pd.DataFrame:
    """A row per parameter: unit, initial, value, std, and the 95 % interval; NaN where there is none."""
    import pandas as pd

    nothing = np.full(len(parameters), np.nan)
    ci = np.stack([nothing, nothing], axis=-1) if ci is None else ci
    return pd.DataFrame(
        {
            "unit": [p.unit for p in parameters],
            "initial": [p.initial for p in parameters],
            "value": values,
            "std": nothing if std is None else std,
            "ci95_low": ci[:, 0],
            "ci95_high": ci[:, 1],
        },
        index=pd.Index([p.name for p in parameters], name="parameter"),
    )


def parameter_lines(parameters: Sequence[Any], values: Vector, std: Vector | None, ci: Matrix | None) -> list[str]:
    """The same as lines of text, a heading first; a dash where there is no interval."""
    width = max([9, *(len(p.name) for p in parameters)])
    lines = [f"{'parameter':<{width}}  {'value':>14}  {'std':>11}  {'95 % interval':^29}  {'initial':>11}  unit"]
    for i, parameter in enumerate(parameters):
        spread, reach = f"{'–':>11}", f"{'–':^29}"
        if std is not None and ci is not None and np.isfinite(std[i]):
            spread, reach = f"{std[i]:11.4g}", f"[{ci[i, 0]:13.7g}, {ci[i, 1]:13.7g}]"
        lines.append(
            f"{parameter.name:<{width}}  {values[i]:14.8g}  {spread}  {reach}  "
            f"{parameter.initial:11.5g}  {parameter.unit}".rstrip()
        )
    return lines
