"""Text for a terminal: tables, and lines that fit its width."""

from __future__ import annotations

import math
import re
import textwrap
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from itertools import zip_longest

WIDTH = 100  # columns of what is printed, at most
_NARROWEST = 40  # below, folded tables are harder to read than lines that the terminal breaks
_screen = [WIDTH]
_UNBROKEN = "\u00a0"
_BEFORE_PERCENT = re.compile(r"(?<=\d) (?=%)")  # a number and its per cent stay together
_LAST_CELL = re.compile(r"^.*\S {2,}(?=\S)|^ +(?=\S)")
_LATEST = 64  # column at which the last cell of a row may begin for it to be folded there
INTERVAL_HEAD = "95 % interval"  # of the column of intervals
BIASED_INTERVAL = "95 % interval with the bias"  # of one that covers noise and bias
_GAP = "  "
_FACTOR = re.compile(r"(?<=[^*]\*)(?=[^*])")  # behind the sign of a product, not of a power
_NUMBER = re.compile(r"(?:[-+−<]? ?[\d.]+(?:e[-+]?\d+)?(?: %)?|–|inf|)")  # a cell of figures
MOST_DIGITS = 15  # of a number in double precision
_LEAST_DIGITS = 3  # of a value with a standard error
_SMALL, _LARGE = -4, 7  # powers of ten between which a number is written without one


def fit_screen(columns: int) -> None:
    """Let what is printed from now on fit a terminal of so many columns, 40 to 100.

    0 where they are not known.
    """
    _screen[0] = min(WIDTH, max(columns, _NARROWEST)) if columns > 0 else WIDTH


@contextmanager
def narrow_screen(columns: int) -> Iterator[None]:
    """Let what is printed within fit so many columns, or the terminal where that has fewer."""
    before = _screen[0]
    _screen[0] = min(before, columns)
    try:
        yield
    finally:
        _screen[0] = before


def plural(number: int | float, thing: str) -> str:
    """Return `1 sample`, `2 samples`."""
    return f"{number} {thing}" + ("" if number == 1 else "s")


def join_words(words: Sequence[str]) -> str:
    """Return "a", "a and b", "a, b and c"; "nothing" for none."""
    return " and ".join(filter(None, (", ".join(words[:-1]), *words[-1:]))) or "nothing"


def first_words(words: Sequence[str], most: int, between: str = ", ") -> str:
    """Return so many words with commas, and how many more there are."""
    more = f" and {len(words) - most} more" if len(words) > most else ""
    return between.join(words[:most]) + more


def cut(text: str, most: int) -> str:
    """Return at most so many characters of a text, with … where it is longer."""
    return text if len(text) <= most else f"{text[: most - 1]}…"


def percent(share: float, digits: int = 2, *, sign: str = "") -> str:
    """Return a share in per cent with so many digits.

    It has no exponent unless it is tiny or huge.

    Examples:
        >>> [percent(share) for share in (0.0123, 0.999, 26.04)]
        ['1.2 %', '100 %', '2600 %']
        >>> percent(0.25, sign="+")
        '+25 %'
    """
    return f"{plain_number(100 * share, digits, sign=sign)} %"


def plain_number(value: float, digits: int = 2, *, sign: str = "") -> str:
    """Return a number with so many digits.

    It has no exponent unless it is tiny or huge.

    Examples:
        >>> [plain_number(value) for value in (0.0123, 1634.2)]
        ['0.012', '1600']
    """
    text = f"{value:{sign}.{digits}g}"
    rounded = float(text)
    return f"{rounded:{sign}.0f}" if 100 <= abs(rounded) < 1e7 else text


def digits_for(value: float | None, spread: float | None, least: int) -> int:
    """Return the digits of a value that show two of its spread, but at least `least`.

    Examples:
        >>> digits_for(1.45951, 9e-6, 5), digits_for(1.45951, 0.1, 5)
        (8, 5)
    """
    if not value or not spread or not math.isfinite(value / spread):
        return least
    return min(max(least, math.ceil(math.log10(abs(value / spread))) + 2), MOST_DIGITS)


def estimate_cells(
    value: float | None,
    std: float | None = None,
    ends: Sequence[float | None] | None = None,
) -> list[str]:
    """Return a value, its standard error and the two ends of its interval, with equal decimals.

    They have as many as show two digits of the standard error (of a quarter of the interval where
    there is none), and a common power of ten where one is needed. A dash means no number.

    Examples:
        >>> estimate_cells(0.4716983, 0.000341, (0.4710287, 0.4723671))
        ['0.471698', '0.000341', '0.471029', '0.472367']
        >>> estimate_cells(4.761e-05, 1.8e-8, (4.7575e-05, 4.7646e-05))
        ['4.76100e-05', '1.8e-08', '4.75750e-05', '4.76460e-05']
        >>> estimate_cells(100.0)
        ['100', '–', '–', '–']
    """
    low, high = map(_finite, (None, None) if ends is None else ends)
    value, std = _finite(value), _finite(std)
    known = [abs(x) for x in (value, low, high) if x is not None]
    scale = max(known, default=0.0)
    spread = std or ((high - low) / 4 if low is not None and high is not None else None)
    if not spread or not scale:
        return [*("–" if x is None else f"{x:.6g}" for x in (value, std, low, high))]
    power = math.floor(math.log10(scale))
    decimals = digits_for(scale, spread, _LEAST_DIGITS) - 1 - power
    if _SMALL <= power < _LARGE:
        form = f".{max(decimals, 0)}f"
        return ["–" if x is None else f"{x:{form}}" for x in (value, std, low, high)]

    def scaled(x: float | None) -> str:
        return "–" if x is None else f"{x / 10.0**power:.{decimals + power}f}e{power:+03d}"

    return [scaled(value), "–" if std is None else f"{std:.1e}", scaled(low), scaled(high)]


def estimate_rows(
    estimates: Iterable[tuple[float | None, float | None, Sequence[float | None] | None]],
) -> list[list[str]]:
    """Return for each value, standard error and interval its three cells, intervals aligned.

    Examples:
        >>> estimate_rows([(2.0, 0.5, (1.0, 3.0)), (-10.0, 1.0, (-12.0, -8.0))])
        [['2.00', '0.50', '[  1.00,  3.00]'], ['-10.00', '1.00', '[-12.00, -8.00]']]
    """
    rows = [estimate_cells(*estimate) for estimate in estimates]
    wide = [max((len(row[i]) for row in rows), default=0) for i in (2, 3)]
    return [
        [value, std, "–" if low == high == "–" else f"[{low:>{wide[0]}}, {high:>{wide[1]}}]"]
        for value, std, low, high in rows
    ]


def _finite(value: float | None) -> float | None:
    return None if value is None or not math.isfinite(value) else float(value)


def table(
    rows: Sequence[Sequence[str]], width: int | None = None, drop: Sequence[str] = ()
) -> list[str]:
    """Return rows of cells as lines of at most `width` columns, the first row the head.

    `width` None is that of the screen. Columns of numbers are aligned on the right.

    Rows may be of different lengths. Columns that do not fit are left out in the order of `drop`,
    their heads. Others are below, under the first column again; an interval stays beside its value.

    Examples:
        >>> table([["part", "RMSE", "FIT %"], ["test", "0.1 m", "90"]])
        ['part  RMSE   FIT %', 'test  0.1 m     90']
        >>> table([["part", "RMSE", "FIT %"], ["test", "0.1 m", "90"]], width=12)
        ['part  RMSE', 'test  0.1 m', '', 'part  FIT %', 'test     90']
        >>> table([["part", "RMSE", "FIT %"], ["test", "0.1 m", "90"]], width=12, drop=["RMSE"])
        ['part  FIT %', 'test     90']
    """
    count, most = max(len(row) for row in rows), width or _screen[0]
    whole = _without([[*row, *[""] * (count - len(row))] for row in rows], drop, most)
    widths = _widths(whole)
    right = [
        i > 0 and all(_NUMBER.fullmatch(row[i]) for row in whole[1:]) for i in range(len(widths))
    ]
    lines: list[str] = []
    for block in _blocks(whole[0], widths, most):
        lines += [""] if lines else []
        lines += [
            _GAP.join(
                row[i].rjust(widths[i]) if right[i] else row[i].ljust(widths[i]) for i in block
            ).rstrip()
            for row in whole
        ]
    return lines


def _without(
    rows: Sequence[Sequence[str]], drop: Sequence[str], most: int
) -> Sequence[Sequence[str]]:
    """Return rows without the columns of heads `drop`, in that order, until they fit."""
    for head in drop:
        if sum(_widths(rows)) + len(_GAP) * (len(rows[0]) - 1) <= most:
            break
        rows = [[row[i] for i, name in enumerate(rows[0]) if name != head] for row in rows]
    return rows


def continued(
    rows: Sequence[Sequence[str]], indent: int = 0, drop: Sequence[str] = ()
) -> list[list[str]]:
    """Return rows whose table fits the screen: what is too long for a cell goes on in a row below.

    Columns of heads `drop` are left out first. Those that are narrower than an equal share keep
    their width, and the others share the rest. Products are cut behind a factor.

    Examples:
        >>> with narrow_screen(20):
        ...     continued([["seen", "determined"], ["u, v", "a, b, c, d, e, f"]])
        [['seen', 'determined'], ['u, v', 'a, b, c, d, e,'], ['', 'f']]
        >>> with narrow_screen(12):
        ...     continued([["n", "model"], ["1", "+ speed*level**2"]])
        [['n', 'model'], ['1', '+ speed*'], ['', 'level**2']]
    """
    rows = _without(rows, drop, _screen[0] - indent)
    widths = _widths(rows)
    left = _screen[0] - indent - len(_GAP) * (len(widths) - 1)
    share = list(range(len(widths)))
    while share and (narrow := [i for i in share if widths[i] <= left // len(share)]):
        left -= sum(widths[i] for i in narrow)
        share = [i for i in share if i not in narrow]
    for i in share:
        widths[i] = max(left // len(share), 1)
    whole: list[list[str]] = []
    for row in rows:
        cells = [_cut(cell, most) for cell, most in zip(row, widths, strict=True)]
        whole += [list(parts) for parts in zip_longest(*cells, fillvalue="")]
    return whole


def _cut(cell: str, most: int) -> list[str]:
    """Return the lines of a cell, cut at spaces and behind the factors of long products."""
    lines = [""]
    for word in cell.split():
        pieces = [word] if len(word) <= most else _FACTOR.split(word)
        for i, piece in enumerate(pieces):
            gap = " " if lines[-1] and not i else ""
            if len(lines[-1]) + len(gap) + len(piece) <= most or not lines[-1]:
                lines[-1] += gap + piece
            else:
                lines.append(piece)
    return lines


def _widths(rows: Sequence[Sequence[str]]) -> list[int]:
    return [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]


def _blocks(head: Sequence[str], widths: Sequence[int], width: int) -> list[list[int]]:
    """Return groups of columns for one block each.

    A last one that is too wide by itself is left for `fold`.
    """
    groups: list[list[int]] = []
    for i in range(1, len(head)):
        if groups and (not head[i] or head[i].startswith("95 %")):
            groups[-1].append(i)
        else:
            groups.append([i])
    blocks, taken = [[0]], widths[0]
    for group in groups:
        more = sum(len(_GAP) + widths[i] for i in group)
        if taken + more > width and len(blocks[-1]) > 1 and widths[0] + more <= width:
            blocks.append([0])
            taken = widths[0]
        blocks[-1] += group
        taken += more
    return blocks


def fold(lines: Iterable[str], width: int | None = None) -> list[str]:
    r"""Return lines of at most `width` columns (None: the screen's).

    Sentences go on indented, the last cell of a row under itself.

    Examples:
        >>> fold(["warning: the interval does not cover it"], width=30)
        ['warning: the interval does not', '  cover it']
        >>> fold(["regressor  position[k-1], force[k-1]"], width=28)
        ['regressor  position[k-1],', '           force[k-1]']
        >>> fold(["It may.\nThe run stays within its bounds here."], width=24)
        ['It may.', 'The run stays within its', '  bounds here.']
    """
    most = width or _screen[0]
    single = (one for line in lines for one in line.split("\n"))
    return [part for line in single for part in (_fold(line, most) if len(line) > most else [line])]


def _fold(line: str, width: int) -> list[str]:
    cell = _LAST_CELL.match(line)
    indent = cell.end() if cell and cell.end() <= _LATEST else 0 if cell else 2
    if cell and not indent:  # a table of numbers: it cannot be broken
        return [line]
    wrapped = textwrap.wrap(
        _BEFORE_PERCENT.sub(_UNBROKEN, line),
        width,
        subsequent_indent=" " * indent,
        break_long_words=False,
        break_on_hyphens=False,
        drop_whitespace=True,
        expand_tabs=False,
        replace_whitespace=False,
    )
    return [part.replace(_UNBROKEN, " ") for part in wrapped]


class Copied(tuple[str, ...]):
    """A block of lines that are to be copied: folded they would be no lines of a file."""


def join_blocks(blocks: Iterable[Sequence[str]]) -> str:
    """Return blocks of lines with empty lines between them, folded but for those to be copied."""
    folded = (lines if isinstance(lines, Copied) else fold(lines) for lines in blocks if lines)
    return "\n\n".join("\n".join(lines) for lines in folded)


def with_unit(name: str, unit: str | None) -> str:
    """Return a name with its unit in brackets."""
    return f"{name} [{unit}]" if unit else name
