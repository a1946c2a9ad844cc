"""A few rows that make up most of a residual's squares: wrong samples, rather than noise, decide θ there."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from orthaug._base.lines import counted, percent
from orthaug._base.warning import Warning
from orthaug.analysis.residuals import errors_of
from orthaug.data.record import Experiment
from orthaug.models.response import Response

_HOLD = 0.5  # share of the squares
_FEW, _LEAST = 0.005, 6  # share of the rows that they are at most, and the number that is always few
_WILD = 20.0  # robust deviations; a normal residual reaches five
_MAD = 1.4826
_NAMED = 3


def wild_rows(response: Response, experiments: Sequence[Experiment]) -> tuple[Warning, ...]:
    """A warning for each output whose error is mostly that of a few rows, far from all others."""
    found = []
    errors = errors_of(response)
    starts = [t.start for t in response.trajectories]
    rows = [(i, starts[i] + k) for i, error in enumerate(errors) for k in range(len(error))]
    for j, output in enumerate(response.outputs):
        error = np.concatenate(errors)[:, j]
        size = np.abs(error - np.median(error))
        wild = np.flatnonzero(size > _WILD * _MAD * np.median(size))
        held = float(np.sum(size[wild] ** 2)) / max(float(np.sum(size**2)), 1e-300)
        if not len(wild) or len(wild) > max(_LEAST, _FEW * len(error)) or held < _HOLD or not np.median(size):
            continue
        named = [experiments[rows[k][0]].where(rows[k][1]) for k in wild[:_NAMED]]
        more = f" and {len(wild) - _NAMED} more" if len(wild) > _NAMED else ""
        text = (
            f"{percent(held, 3)} of the squares of the one-step residual of {output.name} stand in "
            f"{counted(len(wild), 'row')} of {len(error)}: {'; '.join(named)}{more}. If samples are wrong there, so is "
            'θ: mark them (step = "outliers" of data.prepare), or leave them out.'
        )
        found.append(Warning("wild_rows", text))
    return tuple(found)
