"""Analyses behind a finished training: where one fails numerically the result stands, and a warning says which."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np

from orthaug._base.warning import Warning

T = TypeVar("T")
_NUMERICAL = (ArithmeticError, np.linalg.LinAlgError)


def attempt(what: str, analysis: Callable[[], T], warnings: list[Any], otherwise: T) -> T:
    """What an analysis finds, or `otherwise` with one more warning where its numerics fail.

    Args:
        what: the analysis in words, to begin a sentence with.
        warnings: those of the result.
    """
    try:
        return analysis()
    except _NUMERICAL as error:
        told = f"{what} failed numerically ({str(error).rstrip('.')}): the result stands without it."
        warnings.append(Warning("analysis_failed", told))
        return otherwise


def attempt_warned(
    what: str, analysis: Callable[[], T | None], warnings: list[Any], without: Warning | None = None
) -> T | None:
    """As `attempt`, with the warnings that the finding has, or `without` where there is none; None where it fails."""

    def found() -> T | None:
        finding: Any = analysis()
        if finding is not None:
            warnings.extend(finding.warnings)
        elif without is not None:
            warnings.append(without)
        return finding

    return attempt(what, found, warnings, None)
