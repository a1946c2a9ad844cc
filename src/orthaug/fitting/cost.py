"""What a fit would cost at least, in memory and time, and the refusal of what is past the limits."""

from __future__ import annotations

import math
import os
from typing import Any

from orthaug._base.errors import InputError
from orthaug._base.memory import check_limit, check_memory, in_words
from orthaug.models.rows import Room

LONGEST_FIT = 30 * 86400.0  # s
_RATE, _STEP = 2e10, 2e-4  # products per second and core; seconds of an iteration at least
_MOST = 10**18  # weights or runs; more are as impossible, and would overflow
_COPIES = 32  # of regressors and outputs, in a fit with its scores and findings; measured on 10⁶ rows
_FEWEST = 50  # iterations that are counted on where more are allowed: most runs converge


def check_cost(
    learner: Any,
    *,
    rows: int,
    features: int,
    outputs: int,
    iterations: int,
    runs: int,
    held: int | None = None,
    room: Room | None = None,
) -> None:
    """Raise InputError where the normal equations do not fit into memory, or training takes longer than a month.

    Args:
        learner: None for physics alone, which costs nothing; one that cannot tell its `weights` is let pass.
        rows: usable ones.
        features, outputs: of the learner.
        iterations: of a run at most.
        runs: restarts times regularizations.
        held: rows that are in memory; None for all.
        room: of the workers or devices that add up; None where that is this process.
    """
    held = rows if held is None else held
    check_limit(8.0 * _COPIES * held * (features + outputs), f"a fit of {held} rows")
    if not hasattr(learner, "weights"):
        return
    weights, cores = min(learner.weights(features, outputs), _MOST), os.cpu_count() or 1
    runs = min(runs, _MOST)
    side_by_side = min(runs, cores)
    what = f"training a learner of {weights} weights" + (f" in {runs} runs" if runs > 1 else "")
    check_memory(8.0 * (3 * side_by_side * weights**2 + runs * weights + held * (features + outputs)), what)
    if room is not None and (size := 8.0 * room.matrices * weights**2) > room.size:
        raise InputError(
            f"{what} takes {in_words(size)} on each worker or device, for {room.matrices} matrices of its weights; "
            f"{room.place} has {in_words(room.size)}. Take a smaller learner, or larger workers."
        )
    products = rows * outputs * weights**2 + weights**3 / 3
    seconds = runs * min(iterations, _FEWEST) * max(products / _RATE, _STEP) / cores
    if seconds > LONGEST_FIT:
        raise InputError(
            f"{what} on {rows} rows would take {_days(seconds)} or more; {_days(LONGEST_FIT)} are the limit. Take "
            "fewer restarts, a smaller learner, or every n-th row."
        )


def _days(seconds: float) -> str:
    days = seconds / 86400
    return f"{days:.0f} days" if days < 1000 else f"{days / 365.25:.3g} years" if math.isfinite(days) else "ages"
