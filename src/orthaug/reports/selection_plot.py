"""The figure of `orthaug select`."""

from __future__ import annotations

import numpy as np

from orthaug.reports.drawing import BLACK, BLUE, GREY, ORANGE, SIZE, TOP, Figure, grid, headline, label, legend, plain
from orthaug.reports.selection import SelectResult


@plain
def selection_figure(result: SelectResult, unit: str) -> Figure:
    """Score against size, a panel for each stage, the choice marked."""
    stages = list(dict.fromkeys(row.stage for row in result.models))
    figure = Figure(figsize=(SIZE[0], TOP + SIZE[1] * len(stages)))
    axes = grid(figure, len(stages), 1)[:, 0]
    headline(figure, "error of free runs on blocks that were held out")
    sizes = {"orders": "lags", "terms": "terms", "learner": "weights"}
    for axis, stage in zip(axes, stages, strict=True):
        rows = [row for row in result.models if row.stage == stage and row.score is not None]
        place, score = (np.array([getattr(row, name) for row in rows], dtype=float) for name in ("size", "score"))
        error = np.array([row.standard_error or 0.0 for row in rows])
        within = np.array([row.within for row in rows], dtype=bool)
        axis.errorbar(place, score, error, fmt="none", ecolor=GREY, elinewidth=0.8)
        axis.plot(place[~within], score[~within], "o", ms=4, color=BLACK, mfc="white", label="worse")
        axis.plot(place[within], score[within], "o", ms=4, color=BLUE, label="as good as the best")
        chosen = [i for i, row in enumerate(rows) if row.chosen]
        axis.plot(place[chosen], score[chosen], "s", ms=9, color=ORANGE, mfc="none", mew=1.6, label="chosen")
        if len(score) and score.max() > 5 * score.min() > 0:
            axis.set_yscale("log")
        label(axis, x=f"{sizes[stage]}", y=f"RMS error{f' [{unit}]' if unit else ''}", title=stage)
        legend(axis)
    return figure
