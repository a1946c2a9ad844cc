"""Every measured number of the documents against the function that gives it.

    python benchmarks/claims.py                        all of them: about an hour
    python benchmarks/claims.py output_unit measure    those of some files; also file.function
    python benchmarks/claims.py --list                 which there are, and how long each took last
    python benchmarks/claims.py --last                 compute nothing, compare with what was computed last
    python benchmarks/claims.py --collect              move anchors that pages have as comments into claims.yaml

claims.yaml says which number of which document comes from where: see anchors.py. The exit code is 1 where one differs.
"""

from __future__ import annotations

import importlib
import json
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import yaml
from anchors import AnchorError, Block, Claim, blocks, collect
from machine import ROOT

from orthaug._base.parallel import one_blas_thread

STORE = ROOT / "orthaug-out" / "claims.json"


def pages() -> list[Path]:
    """The documents whose numbers are looked after."""
    named = ("README.md", "benchmarks/README.md", "examples/README.md")
    return [*(ROOT / name for name in named), *sorted((ROOT / "docs").rglob("*.md"))]


def entries() -> list[dict[str, str]]:
    """The anchors beside the documents."""
    file = ROOT / "benchmarks" / "claims.yaml"
    return yaml.safe_load(file.read_text(encoding="utf-8")) or [] if file.is_file() else []


def all_blocks() -> list[Block]:
    beside: dict[str, list[dict[str, str]]] = {}
    for entry in entries():
        beside.setdefault(entry["document"], []).append(entry)
    found = []
    for page in pages():
        name = page.relative_to(ROOT).as_posix()
        found += blocks(name, page.read_text(encoding="utf-8"), beside.pop(name, []))
    if beside:
        raise AnchorError(f"claims.yaml names no document of ours: {', '.join(sorted(beside))}.")
    return found


def move_comments() -> int:
    """Move the anchors that pages have as comments into claims.yaml, by document; return how many there were."""
    kept, moved = entries(), 0
    for page in pages():
        text, found = collect(page.relative_to(ROOT).as_posix(), page.read_text(encoding="utf-8"))
        if found:
            page.write_text(text, encoding="utf-8")
            kept, moved = kept + found, moved + len(found)
    order = [page.relative_to(ROOT).as_posix() for page in pages()]
    kept.sort(key=lambda entry: order.index(entry["document"]))
    written = yaml.safe_dump(kept, allow_unicode=True, sort_keys=False, width=110)
    (ROOT / "benchmarks" / "claims.yaml").write_text(written, encoding="utf-8")
    return moved


def all_claims() -> list[Claim]:
    return [claim for block in all_blocks() for claim in block.claims]


def function_of(name: str) -> Callable[[], object]:
    """The function `file.function` of this folder."""
    file, _, function = name.partition(".")
    return getattr(importlib.import_module(file), function)


def flat(values: object) -> Iterator[float | None]:
    """The numbers of nested rows, in order; None where one cannot be measured on this machine."""
    if values is None or isinstance(values, int | float):
        yield values
    else:
        for one in values:  # type: ignore[attr-defined]
            yield from flat(one)


def compare(claim: Claim, values: Sequence[float | None]) -> tuple[bool, str]:
    """Whether text and values agree, and a line that says so."""
    head = f"{claim.place}  {claim.function}"
    if len(values) != len(claim.numbers):
        return (
            False,
            f"differs  {head}: {len(claim.numbers)} numbers in the text, {len(values)} computed",
        )
    pairs = [
        (told, value)
        for told, value in zip(claim.numbers, values, strict=True)
        if value is not None
    ]
    wrong = [(told.value, value) for told, value in pairs if not claim.tolerance.met(told, value)]
    listed = ", ".join(f"{told:g} (computed {value:.4g})" for told, value in wrong)
    absent = f", {len(values) - len(pairs)} left out: no data" if len(pairs) < len(values) else ""
    count = f"{len(pairs)} number{'s' * (len(pairs) > 1)}"
    if wrong:
        return False, f"differs  {head}: {listed}{absent}"
    if not pairs:
        return True, f"skipped  {head}: no data"
    few = (
        ""
        if len(pairs) > 4
        else ": " + ", ".join(f"{told.value:g} ({value:.4g})" for told, value in pairs)
    )
    return True, f"met      {head}, {count}{few}{absent}"


def stored() -> dict[str, dict]:
    """Values and seconds of each function when it last ran."""
    return json.loads(STORE.read_text(encoding="utf-8")) if STORE.is_file() else {}


def computed(name: str) -> list[float | None]:
    """What a function returns, kept with its seconds."""
    began = time.perf_counter()
    with one_blas_thread():  # most matrices are small, and its threads would wait for JAX's
        values = [None if value is None else float(value) for value in flat(function_of(name)())]
    kept = stored() | {name: {"values": values, "seconds": time.perf_counter() - began}}
    STORE.parent.mkdir(exist_ok=True)
    STORE.write_text(json.dumps(kept, indent=1) + "\n", encoding="utf-8")
    return values


def chosen(names: Sequence[str]) -> dict[str, list[Claim]]:
    """The claims of each function; of those that are named, if any are."""
    found: dict[str, list[Claim]] = {}
    for claim in all_claims():
        if not names or claim.function in names or claim.function.partition(".")[0] in names:
            found.setdefault(claim.function, []).append(claim)
    unknown = {name for name in names if not any(name in (f, f.partition(".")[0]) for f in found)}
    if unknown:
        sys.exit(f"No number in the documents comes from {', '.join(sorted(unknown))}; see --list.")
    return found


def main(arguments: Sequence[str]) -> int:
    options = {argument for argument in arguments if argument.startswith("-")}
    if options - {"--list", "--last", "--collect"}:
        sys.exit(__doc__)
    if "--collect" in options:
        print(f"{move_comments()} anchors moved into benchmarks/claims.yaml")
        return 0
    wanted, last, met = chosen([a for a in arguments if a not in options]), stored(), True
    for name, claims in wanted.items():
        if "--list" in options:
            seconds = f"{last[name]['seconds']:.0f} s" if name in last else "–"
            print(f"{name:32} {seconds:>7}  {', '.join(claim.place for claim in claims)}")
            continue
        if "--last" in options and name not in last:
            print(f"unknown  {name} has not run yet")
            continue
        values = last[name]["values"] if "--last" in options else computed(name)
        for claim in claims:
            ok, line = compare(claim, values)
            met &= ok
            print(line, flush=True)
    return 0 if met else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
