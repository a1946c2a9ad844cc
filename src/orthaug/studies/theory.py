"""The paper's assumptions, conditions, lemmas and theorems: where each is computed, and what shows it."""

from __future__ import annotations

from typing import NamedTuple


class Statement(NamedTuple):
    """One statement of the paper, by its label."""

    label: str
    says: str
    computed: str
    shown: str


THEORY: tuple[Statement, ...] = ()
