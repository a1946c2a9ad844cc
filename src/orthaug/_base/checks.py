"""Array types with their shapes, and the checks of arguments at the public edge."""

from __future__ import annotations

import difflib
import math
from collections.abc import Container, Iterable, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from orthaug._base.errors import LONGEST, InputError, show

_COMPARED = 1000  # names that a misspelt one is compared with
Vector = Float[np.ndarray, "_"]
Matrix = Float[np.ndarray, "_ _"]


def as_signal(values: Any, name: str, *, gaps: bool = False) -> Matrix:
    """Return samples as a float matrix (N, channels); a vector is one channel.

    NaN may mark missing ones if `gaps`.

    Raises:
        InputError: not numeric, more than two axes, or a cell that is not finite (named by its
            row).
    """
    try:
        array = np.asarray(values)
        if np.iscomplexobj(array):
            raise InputError(f"`{name}` is complex; expected real numbers.")
        array = np.array(array, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(
            f"`{name}` is not an array of numbers: {str(error).rstrip('.')}."
        ) from None
    if array.ndim == 1:
        array = array[:, None]
    if array.ndim != 2:
        raise InputError(
            f"`{name}` has {array.ndim} axes; expected (samples,) or (samples, channels)."
        )
    bad = np.argwhere(np.isinf(array) if gaps else ~np.isfinite(array))
    if bad.size:
        row, column = bad[0]
        raise InputError(
            f"`{name}` is not finite at row {row}, channel {column}: found {array[row, column]}. "
            "Remove the row or split the experiment there."
        )
    return array


def check_unique(names: Iterable[str], what: str) -> None:
    """Raise InputError where a name is given twice."""
    seen: set[str] = set()
    for name in names:
        if name in seen:
            raise InputError(f"{what} '{name}' is given twice; names must differ.")
        seen.add(name)


def free_name(name: str, taken: Container[str]) -> str:
    """Return the name, with underscores behind it where it is taken."""
    while name in taken:
        name += "_"
    return name


def check_label(value: Any, what: str) -> str:
    """Return `value` if it is text on one line, at most `LONGEST` long.

    Raise InputError otherwise.
    """
    if not isinstance(value, str) or not value.isprintable() or len(value) > LONGEST:
        raise InputError(
            f"{what} must be visible characters on one line, at most {LONGEST} of them; got "
            f"{show(value)}."
        )
    return value


def check_choice(value: str, choices: Iterable[str], what: str) -> str:
    """Return `value` if it is one of `choices`, otherwise raise InputError naming them."""
    choices = tuple(choices)
    if not isinstance(value, str) or value not in choices:
        raise InputError(f"{what} must be one of {', '.join(choices)}; got {show(value)}.")
    return value


def nearest(name: str, known: Iterable[str]) -> str:
    """Return `, did you mean 'x'?` for the closest known name, or nothing."""
    name, known = name[:LONGEST], list(known)[:_COMPARED]
    close = [k for k in known if k.lower().startswith(name.lower())] or difflib.get_close_matches(
        name, known, n=1
    )
    return f", did you mean '{close[0]}'?" if close else ""


def check_count(
    value: Any, name: str, least: int = 1, *, most: int | None = None, of: str = ""
) -> int:
    """Return `value` if it is a whole number from `least` to `most`, otherwise raise InputError.

    Without `most` it has no upper limit; `of` names what is counted in the message.
    """
    whole = isinstance(value, int | np.integer) and not isinstance(value, bool)
    if not whole or value < least or (most is not None and value > most):
        counted = f" of {of}" if of else ""
        reach = f", {least} or more" if most is None else f" from {least} to {most}"
        raise InputError(f"`{name}` must be a whole number{counted}{reach}; got {show(value)}.")
    return int(value)


def is_number(value: Any) -> bool:
    """Return whether `value` is a finite real number; a truth value is none."""
    if isinstance(value, bool) or not isinstance(value, int | float | np.integer | np.floating):
        return False
    try:
        return math.isfinite(value)
    except OverflowError:  # a whole number beyond double precision
        return False


def finite_or_none(value: float) -> float | None:
    """Return `value`, or None where it is not finite: JSON has no infinity."""
    return value if math.isfinite(value) else None


def check_number(value: Any, name: str, *, positive: bool = False) -> float:
    """Return `value` if it is a finite number, 0 or more (above 0 if `positive`).

    Raise InputError otherwise.
    """
    if not is_number(value) or value < 0 or (positive and value == 0):
        raise InputError(
            f"`{name}` must be {'a positive number' if positive else 'a number, 0 or more'}; "
            f"got {show(value)}."
        )
    return float(value)


def check_finite(value: Any, what: str) -> None:
    """Raise InputError unless `value` is a finite number."""
    if not is_number(value):
        raise InputError(f"{what} must be a finite number; got {show(value)}.")


def positive(scale: Vector) -> Vector:
    """Return the scale, 1 where it is not positive or not finite."""
    return np.where(np.isfinite(scale) & (scale > 0), scale, 1.0)


def check_all(values: Any, kind: type, name: str, example: str) -> None:
    """Raise InputError unless `values` is a sequence of a kind, such as [example]."""
    listed = isinstance(values, Sequence) and not isinstance(values, str)
    wrong = [value for value in values if not isinstance(value, kind)] if listed else [values]
    if wrong:
        raise InputError(f"`{name}` must be a list such as [{example}]; got {show(wrong[0])}.")


def check_type(value: object, kinds: Any, name: str, wanted: str) -> None:
    """Raise InputError unless `value` is an instance of `kinds` (a class itself is none)."""
    if isinstance(value, type) or not isinstance(value, kinds):
        raise InputError(f"`{name}` must be {wanted}; got {show(value)}.")
