"""The seeds of a row's draws.

Rows that share their draws miss together: one unlucky set of noise looked like a fault of five rows.
"""

from __future__ import annotations

import zlib


def seeds(draws: int, *row: object) -> list[int]:
    """Return a seed for each draw of a row, the same in every run and no other row's."""
    first = zlib.crc32(" | ".join(map(str, row)).encode())
    return list(range(first, first + draws))
