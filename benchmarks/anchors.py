"""Anchors of numbers in the documents: comments before a block of Markdown that say where its numbers come from.

    <!-- measured: output_unit.table; columns 2 to 7; within 20 % -->
    <!-- measured: initial_states.compare; "off by # standard", "on # of # draws"; within 0.5 -->
    <!-- machine: python benchmarks/memory.py -->
    <!-- stated: limits of the excitation check -->

`measured` names `file.function` of benchmarks/, then which numbers of the block below are meant: those of a table's
columns, those at the `#` of quoted texts, or all of them; in order of appearance they are what the function returns.
`machine` and `stated` speak of the block's other numbers: they depend on the machine, or nobody measured them. Before
a heading they speak of its whole section. Several anchors may stand before one block.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field

ANCHOR = re.compile(r"<!-- (measured|machine|stated): (.+?) -->")
NUMBER = re.compile(
    r"(?<![\w.])(?P<bound>[<≤] ?)?(?P<value>[-−]?\d+(?:\.(?P<decimals>\d+))?(?:e(?P<power>[-+]?\d+))?)(?!\w|\.\d)"
)
MEASURED_LOOKING = re.compile(
    r"\d\.\d|\d ?%|\de[-+]?\d|\d (?:to|of) \d|\d (?:(?:ms|s|min|h|[mk]?V|[MG]B)\b|seconds|minutes|hours|times)"
)
NOT_MEASURED = re.compile(  # terms and names that hold such numbers
    r"`[^`]*`|\]\([^)]*\)|\b9[59] % (?:band|interval)s?|\bSect\. [\d.]+|\bPython [\d.]+"
)
WITHIN = re.compile(
    r"within (?:(?P<times>a factor )(?P<factor>[\d.]+)|(?P<size>[\d.e-]+)(?P<share> %)?)$"
)


class AnchorError(ValueError):
    """An anchor that does not say which numbers, or how close."""


@dataclass(frozen=True)
class Tolerance:
    """How far a number in a text may be from the measured one, besides half a unit of its last digit.

    Args:
        share: of the measured number.
        size: in the number's unit.
        factor: the ratio of both, either way.
    """

    share: float = 0.0
    size: float = 0.0
    factor: float = 1.0

    @classmethod
    def of(cls, text: str) -> Tolerance:
        """From `within 20 %`, `within 0.5` or `within a factor 3`."""
        found = WITHIN.fullmatch(text)
        if found is None:
            raise AnchorError(
                f"'{text}': expected `within 20 %`, `within 0.5` or `within a factor 3`."
            )
        if found["times"]:
            return cls(factor=float(found["factor"]))
        size = float(found["size"])
        return cls(share=size / 100) if found["share"] else cls(size=size)

    def met(self, told: Number, value: float) -> bool:
        """Whether the text's number stands for this value; one behind `<` or `≤` for any smaller value."""
        if told.bound:
            return value <= told.value
        if (
            self.factor > 1
            and told.value * value > 0
            and 1 / self.factor <= told.value / value <= self.factor
        ):
            return True
        return abs(told.value - value) <= self.share * abs(value) + self.size + 0.5 * told.digit * (
            1 + 1e-9
        )


@dataclass(frozen=True)
class Number:
    """A number of a text: its value, a unit of its last digit, whether it is an upper bound, and where it stands."""

    value: float
    digit: float
    bound: bool
    start: int
    end: int

    @classmethod
    def of(cls, found: re.Match[str], offset: int = 0) -> Number:
        digit = 10.0 ** (int(found["power"] or 0) - len(found["decimals"] or ""))
        value = float(found["value"].replace("−", "-"))
        return cls(
            value, digit, found["bound"] is not None, offset + found.start(), offset + found.end()
        )


def numbers_in(text: str, offset: int = 0) -> list[Number]:
    """All numbers of a text, in order."""
    return [Number.of(found, offset) for found in NUMBER.finditer(text)]


@dataclass(frozen=True)
class Block:
    """A paragraph, list item or table of a page: its text in one line (a table's in several) and its anchors."""

    page: str
    line: int
    text: str
    anchors: tuple[tuple[str, str], ...]
    section: str | None = None
    """What a `machine` or `stated` anchor before a heading says of all that stands below it."""

    @property
    def claims(self) -> list[Claim]:
        """What is measured here."""
        return [Claim.of(self, text) for kind, text in self.anchors if kind == "measured"]

    def unexplained(self) -> list[str]:
        """What looks like a measured number and has no anchor."""
        if self.section is not None or any(kind != "measured" for kind, _ in self.anchors):
            return []
        text = self.text
        for number in (number for claim in self.claims for number in claim.numbers):
            text = text[: number.start] + "·" * (number.end - number.start) + text[number.end :]
        text = NOT_MEASURED.sub(lambda found: "·" * len(found[0]), text)
        return [
            text[max(0, found.start() - 20) : found.end() + 10]
            for found in MEASURED_LOOKING.finditer(text)
        ]


@dataclass(frozen=True)
class Claim:
    """Numbers of a block, and the function that gives them."""

    block: Block
    function: str
    tolerance: Tolerance = field(default_factory=Tolerance)
    numbers: tuple[Number, ...] = ()

    @classmethod
    def of(cls, block: Block, text: str) -> Claim:
        """From an anchor's text: function, selection, tolerance; the latter two may be left out."""
        function, *rest = (part.strip() for part in text.split(";"))
        tolerance, chosen = Tolerance(), numbers_in(block.text)
        for part in rest:
            if part.startswith('"'):
                quoted = re.findall(r'"([^"]+)"', part)
                chosen = [number for one in quoted for number in quoted_numbers(block, one)]
            elif part.startswith("columns "):
                chosen = column_numbers(block, part.removeprefix("columns "))
            else:
                tolerance = Tolerance.of(part)
        return cls(block, function, tolerance, tuple(chosen))

    @property
    def place(self) -> str:
        return f"{self.block.page}:{self.block.line}"


def quoted_numbers(block: Block, quoted: str) -> list[Number]:
    """The numbers at the `#` of a quoted text of the block."""
    pattern = NUMBER.pattern
    for name in ("bound", "value", "decimals", "power"):
        pattern = pattern.replace(f"?P<{name}>", "?:")
    found = re.search(
        f"({pattern})".join(re.escape(part) for part in quoted.split("#")), block.text
    )
    if found is None:
        raise AnchorError(f'{block.page}:{block.line}: no text "{quoted}" in the block below.')
    return [numbers_in(found[i], found.start(i))[0] for i in range(1, found.re.groups + 1)]


def column_numbers(block: Block, text: str) -> list[Number]:
    """The numbers in columns of a table, row after row without its head."""
    first, _, last = text.partition(" to ")
    wanted = range(int(first), int(last) + 1) if last else [int(one) for one in first.split(",")]
    chosen, offset = [], 0
    for i, line in enumerate(block.text.split("\n")):
        place = offset + 1
        for column, cell in enumerate(line[1:].split("|"), start=1):
            if i > 1 and column in wanted:
                chosen += numbers_in(cell, place)
            place += len(cell) + 1
        offset += len(line) + 1
    return chosen


def taken(page: str, line: int, anchors: list[tuple[str, str]]) -> list[tuple[str, str]]:
    """The anchors before a heading, none of which may be `measured`; the list is empty afterwards."""
    if any(kind == "measured" for kind, _ in anchors):
        raise AnchorError(
            f"{page}:{line}: `measured` stands before a heading; expected a paragraph, list or "
            "table."
        )
    found = anchors.copy()
    anchors.clear()
    return found


def blocks(page: str, text: str) -> Iterator[Block]:
    """The blocks of a page of Markdown, without fenced code."""
    anchors: list[tuple[str, str]] = []
    lines: list[str] = []
    sections: dict[int, str] = {}
    begin, fenced = 0, False

    def end() -> Iterator[Block]:
        if lines:
            joined = (
                "\n".join(lines)
                if lines[0].startswith("|")
                else re.sub(r"\s+", " ", " ".join(lines))
            )
            yield Block(page, begin, joined, tuple(anchors), next(iter(sections.values()), None))
            lines.clear()
            anchors.clear()

    for number, raw in enumerate([*text.split("\n"), ""], start=1):
        line = raw.strip()
        heading, anchor = re.match(r"(#+) ", line), ANCHOR.fullmatch(line)
        if line.startswith("```"):
            fenced = not fenced
        if fenced and anchors:
            raise AnchorError(
                f"{page}:{number}: an anchor stands before code; expected a paragraph, list or "
                "table."
            )
        if fenced or not line or line.startswith("```") or heading or anchor:
            yield from end()
            if anchor and not fenced:
                anchors.append((anchor[1], anchor[2]))
            elif heading and not fenced:
                level = len(heading[1])
                sections = {above: told for above, told in sections.items() if above < level}
                if anchors:
                    sections[level] = "; ".join(told for _, told in taken(page, number, anchors))
            continue
        if lines and (
            re.match(r"[-*] |\d+\. ", line) or line.startswith("|") != lines[-1].startswith("|")
        ):
            yield from end()
        if not lines:
            begin = number
        lines.append(line)
    yield from end()
    if anchors:
        raise AnchorError(f"{page}: the last anchor stands before nothing.")
