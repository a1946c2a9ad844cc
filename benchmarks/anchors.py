"""Anchors of numbers in the documents: where the numbers of a block of Markdown come from.

They are entries of claims.yaml, each with a piece of the block's text that no other block of the page has:

    - document: README.md
      text: Ten initial weights
      measured: published.picture
      numbers: '"(#)"'
      within: a factor 2
    - document: docs/scale.md
      text: Memory of a streamed fit
      machine: python benchmarks/memory.py
    - document: docs/noise.md
      section: Noise models
      stated: of the generated data

`measured` names `file.function` of benchmarks/, then which numbers of the block are meant: those of a table's columns
(`columns 2 to 7`), those at the `#` of quoted texts, or all of them; in order of appearance they are what the function
returns. `machine` and `stated` speak of the block's other numbers: they depend on the machine, or nobody measured them.
With `section`, a heading, they speak of all that stands below it.

Whoever writes a page may put an anchor before its block first, as a comment; `python benchmarks/claims.py --collect`
moves comments into claims.yaml:

    <!-- measured: output_unit.table; columns 2 to 7; within 20 % -->
    <!-- machine: python benchmarks/memory.py -->
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
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


Entry = Mapping[str, str]
"""An entry of claims.yaml."""


def anchor_of(entry: Entry) -> tuple[str, str]:
    """The kind and the text of an entry's anchor, as a comment would have them."""
    known = {"document", "text", "section", "numbers", "within"}
    kinds = [kind for kind in ("measured", "machine", "stated") if kind in entry]
    if (
        len(kinds) != 1
        or set(entry) - known - set(kinds)
        or ("text" in entry) == ("section" in entry)
    ):
        raise AnchorError(
            f"claims.yaml: {dict(entry)}: expected `document`, `text` or `section`, and one of "
            "`measured` (with `numbers` and `within`), `machine`, `stated`."
        )
    parts = [entry[kinds[0]]]
    if "numbers" in entry:
        parts.append(entry["numbers"])
    if "within" in entry:
        parts.append(f"within {entry['within']}")
    return kinds[0], "; ".join(parts)


def entry_of(kind: str, anchor: str) -> dict[str, str]:
    """The other way round, without document and place."""
    first, *rest = (part.strip() for part in anchor.split(";")) if kind == "measured" else [anchor]
    entry = {kind: first}
    for part in rest:
        if part.startswith("within "):
            entry["within"] = part.removeprefix("within ")
        else:
            entry["numbers"] = part
    return entry


def collect(page: str, text: str) -> tuple[str, list[dict[str, str]]]:
    """A page without the comments that are anchors, and these as entries of claims.yaml."""
    found = list(blocks(page, text))
    begins = {block.line: block for block in found}
    kept, waiting, entries = [], [], []
    for number, raw in enumerate(text.split("\n"), start=1):
        line = raw.strip()
        if anchor := ANCHOR.fullmatch(line):
            waiting.append((anchor[1], anchor[2]))
            continue
        kept.append(raw)
        if waiting and line:
            heading = re.match(r"#+ (.+)", line)
            place = (
                {"section": heading[1]}
                if heading
                else {"text": piece_of(begins[number].text, [block.text for block in found])}
            )
            entries += [{"document": page, **place, **entry_of(*one)} for one in waiting]
            waiting = []
    return re.sub(r"\n{3,}", "\n\n", "\n".join(kept)).lstrip("\n"), entries


def piece_of(text: str, texts: Sequence[str]) -> str:
    """The shortest beginning of a block, or first row of a table, that no other block of the page has."""
    if text.startswith("|"):
        pieces = [line for line in text.split("\n") if not line.startswith("|-")]
    else:
        words = text.split(" ")
        pieces = [" ".join(words[:count]) for count in range(min(4, len(words)), len(words) + 1)]
    for piece in pieces:
        if sum(piece in other for other in texts) == 1:
            return piece
    raise AnchorError(f"'{text[:40]}': another block of the page has the same text.")


def blocks(page: str, text: str, entries: Sequence[Entry] = ()) -> Iterator[Block]:
    """The blocks of a page of Markdown, without fenced code, with the anchors of comments and entries."""
    anchors: list[tuple[str, str]] = []
    lines: list[str] = []
    sections: dict[int, str] = {}
    begin, fenced = 0, False
    met = [0] * len(entries)

    def beside(key: str, found: Callable[[str], bool]) -> list[tuple[str, str]]:
        chosen = [i for i, one in enumerate(entries) if key in one and found(one[key])]
        for i in chosen:
            met[i] += 1
        return [anchor_of(entries[i]) for i in chosen]

    def end() -> Iterator[Block]:
        if lines:
            joined = (
                "\n".join(lines)
                if lines[0].startswith("|")
                else re.sub(r"\s+", " ", " ".join(lines))
            )
            here = (*anchors, *beside("text", lambda piece: piece in joined))
            yield Block(page, begin, joined, here, next(iter(sections.values()), None))
            lines.clear()
            anchors.clear()

    for number, raw in enumerate([*text.split("\n"), ""], start=1):
        line = raw.strip()
        heading, anchor = re.match(r"(#+) (.*)", line), ANCHOR.fullmatch(line)
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
                level, title = len(heading[1]), heading[2]
                sections = {above: told for above, told in sections.items() if above < level}
                anchors += beside("section", title.__eq__)
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
    for entry, count in zip(entries, met, strict=True):
        if count != 1:
            raise AnchorError(
                f"{page}: {count} blocks have '{entry.get('text') or entry.get('section')}' of "
                "claims.yaml; expected one."
            )
