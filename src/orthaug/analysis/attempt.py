"""Analyses after training: where one fails the fit is kept, and a warning names the analysis."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np

from orthaug._base.errors import InputError, Warning
from orthaug._base.progress import LOG

T = TypeVar("T")
_NUMERICAL = (ArithmeticError, np.linalg.LinAlgError)
DEFECTS: tuple[type[BaseException], ...] = (
    AttributeError,
    IndexError,
    KeyError,
    TypeError,
    ValueError,
)


def attempt(what: str, analysis: Callable[[], T], warnings: list[Warning], otherwise: T) -> T:
    """Return the result of an analysis, or `otherwise` with one more warning where it fails.

    Training may have taken hours: a defect of an analysis does not discard it, and is logged.

    Args:
        what: the analysis in words, to begin a sentence with.
        warnings: those of the result.
    """
    try:
        return analysis()
    except _NUMERICAL as error:
        text = (
            f"{what} failed numerically ({str(error).rstrip('.')}): the result is given without it."
        )
    except InputError:
        raise
    except DEFECTS as error:
        LOG.info("%s failed", what, exc_info=True)
        text = (
            f"{what} failed by a defect of orthaug ({type(error).__name__}: {error}): the "
            "result is given without it."
        )
    warnings.append(Warning("analysis_failed", text))
    return otherwise


def attempt_warned(
    what: str,
    analysis: Callable[[], T | None],
    warnings: list[Warning],
    without: Warning | None = None,
) -> T | None:
    """Return the result of an analysis, or `without`; its own warnings are added too.

    None where it fails.
    """

    def warn_and_run() -> T | None:
        finding: Any = analysis()
        if finding is not None:
            warnings.extend(finding.warnings)
        elif without is not None:
            warnings.append(without)
        return finding

    return attempt(what, warn_and_run, warnings, None)
