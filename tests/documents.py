"""Runs the code of a page of the documents as it is written, block by block, in a fresh folder.

    python tests/documents.py docs/tutorials/measure.md      prints what every block prints, and how long it takes

- `python` blocks of a page share their names; `sh` blocks run line by line, `orthaug` by its entry in this process, all
  else by a shell; `toml` blocks with a title are written to that file and opened, others are parts of a spec, which
  replace those of the page's `spec.toml`; that is then opened with its data.
- A `text` block right below is what the block prints: words as they stand, whole numbers too, other numbers to 2 % or
  a unit and a half of their last digit. `...` stands for anything.
- Comments before a block: `<!-- given: run1.csv, record -->` is what the reader has already, made by `given.py`;
  `<!-- exit 2 -->` is how the last command ends; `<!-- not run: why -->` leaves the block out. README and the home page
  have no comments: `BESIDE` of `given.py` has theirs.
"""

from __future__ import annotations

import contextlib
import importlib
import io
import os
import re
import shlex
import subprocess
import sys
import time
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import given
import tomlkit
from test_cli import run

import orthaug

ROOT = Path(__file__).resolve().parents[1]
COMMENT = re.compile(r"<!-- (given|not run): (.+?) -->|<!-- exit (\d+) -->")
FENCE = re.compile(r'```(\w*)(?: title="([^"]+)")?')
NUMBER = re.compile(r"(?<![\w.])[-+−]?\d+(?:\.\d+)?(?:e[-+]?\d+)?(?![\w])")
SHELLS = ("sh", "bash", "console")
NEAR, UNITS = 0.02, 1.5


@dataclass
class Block:
    """A fenced block of a page."""

    language: str
    text: str
    line: int
    title: str | None = None
    given: list[str] = field(default_factory=list)
    not_run: str | None = None
    exits: int = 0
    prints: str | None = None


def pages() -> list[Path]:
    return [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


def blocks(text: str) -> Iterator[Block]:
    """The blocks of a page, each with the comments before it and the output below it."""
    lines, comments, last, i = text.split("\n"), [], None, 0
    while i < len(lines):
        fence = FENCE.fullmatch(lines[i].strip())
        if fence is None:
            comment = COMMENT.fullmatch(lines[i].strip())
            comments = [*comments, comment] if comment else comments if not lines[i].strip() else []
            last = last if not lines[i].strip() else None
            i += 1
            continue
        end = lines.index("```", i + 1)
        body = "\n".join(lines[i + 1 : end]) + "\n"
        if fence[1] == "text":
            if last is not None:
                last.prints = body
            last = None
        else:
            last = Block(fence[1], body, i + 1, fence[2])
            for comment in comments:
                if comment[1] == "given":
                    last.given += comment[2].split(", ")
                elif comment[1] == "not run":
                    last.not_run = comment[2]
                else:
                    last.exits = int(comment[3])
            yield last
        comments, i = [], end + 1


def blocks_of(path: Path) -> list[Block]:
    """The blocks of a page, with what stands beside it where the page has no comments."""
    found = list(blocks(path.read_text(encoding="utf-8")))
    name = path.relative_to(ROOT).as_posix() if path.is_relative_to(ROOT) else ""
    for first, text in given.BESIDE.get(name, {}).items():
        (block,) = (one for one in found if one.text.startswith(first))
        kind, _, result = text.partition(": ")
        if kind == "given":
            block.given += result.split(", ")
        else:
            block.not_run = result
    return found


def pattern(expected: str) -> tuple[str, list[str]]:
    """A regular expression for what is printed, and its numbers in order."""
    numbers: list[str] = []
    parts = []
    for word in expected.split():
        for piece in re.split(r"(\.\.\.)", word):
            if piece == "...":
                parts.append(".*?")
                continue
            at = 0
            for found in NUMBER.finditer(piece):
                numbers.append(found[0])
                parts += [
                    re.escape(piece[at : found.start()]),
                    r"([-+−]?\d+(?:\.\d+)?(?:e[-+]?\d+)?)",
                ]
                at = found.end()
            parts.append(re.escape(piece[at:]))
        parts.append(r"\s*")
    return "".join(parts), numbers


def same(expected: str, printed: str) -> bool:
    """Whether a number that was printed stands for the expected one."""
    if re.fullmatch(r"[-+−]?\d+", expected):
        return expected == printed
    one, other = (float(text.replace("−", "-")) for text in (expected, printed))
    mantissa, _, power = expected.partition("e")
    unit = 10.0 ** (int(power or 0) - len(mantissa.partition(".")[2]))
    return abs(one - other) <= NEAR * max(abs(one), abs(other)) + UNITS * unit


def differences(expected: str, printed: str) -> list[str]:
    """What is not as expected; none if all is."""
    regex, numbers = pattern(expected)
    found = re.fullmatch(regex, printed.strip(), re.DOTALL)
    if found is None:
        return [f"expected:\n{expected}\nprinted:\n{printed}"]
    pairs = zip(numbers, found.groups(), strict=True)
    return [f"{one} is now {other}" for one, other in pairs if not same(one, other)]


def commands(block: Block) -> Iterator[tuple[str, str | None]]:
    """The commands of a shell block; in a `console` block with what stands below each."""
    text = block.text.replace("\\\n", " ")
    if block.language != "console":
        for line in text.splitlines():
            if shlex.split(line, comments=True):
                yield line, None
        return
    for part in re.split(r"^\$ ", text, flags=re.MULTILINE)[1:]:
        line, _, printed = part.partition("\n")
        yield line, printed or None


def shell(line: str) -> tuple[int, str]:
    """Exit code and output of a command in the working folder."""
    words = shlex.split(line, comments=True)
    if words[0] == "orthaug" and not {"|", ">", "&&", ";"} & set(words):
        done = run(*words[1:])
        return done.code, done.out + done.err
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    ended = subprocess.run(
        ["bash", "-c", line], capture_output=True, text=True, env={**os.environ, "PATH": path}
    )
    return ended.returncode, ended.stdout + ended.stderr


def opened(text: str) -> None:
    """Puts a part of a spec into the page's spec, in the place of what it replaces, and opens that with its data."""
    part = tomllib.loads(text)
    whole = tomllib.loads(Path("spec.toml").read_text(encoding="utf-8"))
    data = {**whole.get("data", {}), **part.pop("data", {})}
    for name in ("baseline", "lags", "physics") if "motion" in part else ():
        whole.pop(name, None)
    path = Path("spec.toml")
    path.write_text(tomlkit.dumps({**whole, **part, "data": data}), encoding="utf-8")
    orthaug.load_spec(path)


class Page:
    """A page that is run in the working folder."""

    def __init__(self, path: Path):
        self.path = path
        self.names: dict = {"__name__": "__main__"}
        self.blocks = blocks_of(path)

    def printed(self, block: Block) -> str:
        """Runs a block and returns what it printed; fails where a command ends otherwise than it should."""
        given.give(block.given, self.names)
        if block.language == "toml" and block.title == "pyproject.toml":
            assert tomllib.loads(block.text)["project"]  # of another package
        elif block.language == "toml" and block.title:
            Path(block.title).write_text(block.text, encoding="utf-8")
            orthaug.load_spec(Path(block.title))
        elif block.language == "toml":
            opened(block.text)
        elif block.language == "python" and block.title:
            Path(block.title).write_text(block.text, encoding="utf-8")
        elif block.language == "python":
            code = "\n" * block.line + block.text
            importlib.invalidate_caches()  # a block before may have written a module in the same instant
            with contextlib.redirect_stdout(io.StringIO()) as out:
                exec(compile(code, str(self.path), "exec", dont_inherit=True), self.names)
            return out.getvalue()
        elif block.language in SHELLS:
            return "".join(self.commanded(block))
        else:
            raise AssertionError(
                f"{self.path.name}:{block.line}: a block in '{block.language}' cannot be run"
            )
        return ""

    def commanded(self, block: Block) -> Iterator[str]:
        found = list(commands(block))
        for i, (line, expected) in enumerate(found):
            code, printed = shell(line)
            wanted = block.exits if i == len(found) - 1 else 0
            assert code == wanted, (
                f"{self.path.name}:{block.line}: `{line}` ends with {code}\n{printed}"
            )
            assert expected is None or not differences(expected, printed), differences(
                expected or "", printed
            )
            yield printed


def main() -> None:
    import tempfile

    for name in sys.argv[1:]:
        page = Page(Path(name).resolve())
        with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
            for block in page.blocks:
                if block.not_run:
                    continue
                begin = time.perf_counter()
                printed = page.printed(block)
                print(
                    f"=== {name}:{block.line} {block.language}, "
                    f"{time.perf_counter() - begin:.2f} s\n{printed}"
                )
                if block.prints is not None:
                    print("\n".join(f"!!! {one}" for one in differences(block.prints, printed)))


if __name__ == "__main__":
    main()
