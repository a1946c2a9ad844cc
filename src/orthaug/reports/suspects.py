"""The table of suspects for a reader: how far each would move the parameters if it were there."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any


def shares(entry: dict[str, Any]) -> dict[str, float | None]:
    """The bias of every θ and physical parameter, in per cent of its value, by an entry of result.json.

    It is what the guessed coefficient gives; without a guess, what the term gives where it makes up 1 % of the
    outputs' deviation over the measure.
    """
    coefficient = entry["coefficient"]
    if coefficient is None:
        coefficient = 0.01 / entry["size"] if entry["size"] else None
    relative = {**(entry["relative_bias"] or {}), **(entry["relative_physical_bias"] or {})}
    per_cent = {
        name: None if v is None or coefficient is None else 100 * v * coefficient for name, v in relative.items()
    }
    exact = {name: 100 * e["relative"] for name, e in (entry["expected_physical_bias"] or {}).items() if e["relative"]}
    return per_cent | exact


def text(table: Sequence[dict[str, Any]]) -> list[str]:
    """The entries of result.json for a reader, biases as `shares`."""
    if not table:
        return []
    names = list(shares(table[0]))
    rows = [["suspect", "size", *names, "cosine", "removable"]]
    for entry in table:
        guess = entry["coefficient"]
        cosine = "–" if entry["cosine"] is None else f"{entry['cosine']:.3f}"
        verdict = entry["certificate"]["verdict"] if entry["certificate"] else None
        answer = {"unremovable": "no", "removable": "yes", "orthogonal": "yes"}.get(str(verdict), "–")
        size = "1 %" if guess is None else f"{100 * abs(guess) * entry['size']:.2g} %"
        biases = ("–" if share is None else f"{share:+.2g} %" for share in shares(entry).values())
        rows.append([entry["name"], size, *biases, cosine, answer])
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    return ["  ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)).rstrip() for row in rows]
