"""Text for a terminal: tables, and lines that fit its width."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterable, Sequence

WIDTH = 100  # columns of what is printed, at most
_NARROWEST = 40  # below, folded tables are harder to read than lines that the terminal breaks
_screen = [WIDTH]
_LAST_CELL = re.compile(r"^.*\S {2,}(?=\S)|^ +(?=\S)")
_LATEST = 64  # column at which the last cell of a row may begin for it to be folded there
_GAP = "  "


def fit_screen(columns: int) -> None:
    """Let what is printed from now on fit a terminal of so many columns, 40 to 100.

    0 where they are not known.
    """
    _screen[0] = min(WIDTH, max(columns, _NARROWEST)) if columns > 0 else WIDTH


def plural(number: int, thing: str) -> str:
    """Return `1 sample`, `2 samples`."""
    return f"{number} {thing}" + ("" if number == 1 else "s")


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


def table(rows: Sequence[Sequence[str]], width: int | None = None) -> list[str]:
    """Return rows of cells as lines of at most `width` columns, the first row the head.

    `width` None is that of the screen.

    Rows may be of different lengths. Columns that do not fit are below, under the first column
    again; an interval stays beside its value.

    Examples:
        >>> table([["part", "RMSE", "FIT %"], ["test", "0.1 m", "90"]])
        ['part  RMSE   FIT %', 'test  0.1 m  90']
        >>> table([["part", "RMSE", "FIT %"], ["test", "0.1 m", "90"]], width=12)
        ['part  RMSE', 'test  0.1 m', '', 'part  FIT %', 'test  90']
    """
    count = max(len(row) for row in rows)
    whole = [[*row, *[""] * (count - len(row))] for row in rows]
    widths = [max(len(row[i]) for row in whole) for i in range(count)]
    lines: list[str] = []
    for block in _blocks(whole[0], widths, width or _screen[0]):
        lines += [""] if lines else []
        lines += [_GAP.join(row[i].ljust(widths[i]) for i in block).rstrip() for row in whole]
    return lines


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
    return textwrap.wrap(
        line,
        width,
        subsequent_indent=" " * indent,
        break_long_words=False,
        break_on_hyphens=False,
        drop_whitespace=True,
        expand_tabs=False,
        replace_whitespace=False,
    )
