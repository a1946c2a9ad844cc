"""The figure of `orthaug select`."""

from __future__ import annotations

import numpy as np

from orthaug.reports.drawing import BLACK, BLUE, GREY, ORANGE, SIZE, TOP, Figure, grid, headline, label, legend, plain
from orthaug.reports.selection import SelectResult

_SIZES = {"orders": "linear lags", "terms": "terms beside the physics", "learner": "weights of the network"}
_GAP = 0.55  # inches between panels
_WIDE = 5.0  # ratio of scores from which their axis is logarithmic


@plain
def selection_figure(result: SelectResult, unit: str) -> Figure:
    """Score against size, a panel for each stage, the choice marked."""
    stages = list(dict.fromkeys(row.stage for row in result.models))
    figure = Figure(figsize=(SIZE[0], TOP + SIZE[1] * len(stages)))
    axes = grid(figure, len(stages), 1, gap=(_GAP, 0.0))[:, 0]
    headline(figure, "error of free runs on blocks that were held out")
    for axis, stage in zip(axes, stages, strict=True):
        rows = [row for row in result.models if row.stage == stage and row.score is not None]
        size, score = (np.array([getattr(row, name) for row in rows], dtype=float) for name in ("size", "score"))
        error = np.array([row.standard_error or 0.0 for row in rows])
        within, chosen = (np.array([getattr(row, name) for row in rows], dtype=bool) for name in ("within", "chosen"))
        axis.errorbar(size, score, error, fmt="none", ecolor=GREY, elinewidth=0.8)
        axis.plot(size[~within], score[~within], "o", ms=4, color=BLACK, mfc="white", label="worse")
        axis.plot(size[within], score[within], "o", ms=4, color=BLUE, label="as good as the best")
        axis.plot(size[chosen], score[chosen], "s", ms=9, color=ORANGE, mfc="none", mew=1.6, label="chosen")
        if len(score) and score.max() > _WIDE * score.min() > 0:
            axis.set_yscale("log", subs=(2, 5))
            axis.yaxis.set_major_formatter("{x:g}")
            axis.yaxis.set_minor_formatter("{x:g}")
        label(axis, x=_SIZES[stage], y=f"RMS error{f' [{unit}]' if unit else ''}")
    legend(axes[0])
    return figure
