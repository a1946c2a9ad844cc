"""Signals that a design tries: families of `orthaug.signals`, and periodic patterns with their neighbours."""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

import numpy as np

from orthaug._base.checks import Vector

LONGEST_PATTERN = 32  # held samples; a longer period needs a longer hold
_STEPS = (2.0, 1.0, 0.5, 0.25, 0.1)  # changes of one level of a pattern, in units of the amplitude


class Pattern(NamedTuple):
    """Levels in [−1, 1], each held, repeated; with `odd` they are followed by their negatives."""

    levels: tuple[float, ...]
    hold: int
    odd: bool

    @property
    def name(self) -> str:
        shown = "".join("-0+"[int(v) + 1] for v in self.levels)
        if any(v not in (-1, 0, 1) for v in self.levels):
            shown = " ".join(f"{v:.3g}" for v in self.levels)
        return f"pattern [{shown}]{', then its negative' * self.odd}{f', hold {self.hold}' * (self.hold > 1)}"

    def __call__(self, samples: int) -> Vector:
        unit = np.array(self.levels + tuple(-v for v in self.levels) * self.odd)
        return unit[np.arange(samples) // self.hold % len(unit)]

    def neighbours(self) -> list[Pattern]:
        """Patterns with one level or the signs of a pair changed, or a level taken out or given twice."""
        x, near = self.levels, set()
        for i, v in enumerate(x):
            near |= {(*x[:i], min(max(v + s * d, -1.0), 1.0), *x[i + 1 :]) for d in _STEPS for s in (-1, 1)}
            near |= {(*x[:i], -v, *x[i + 1 : j], -x[j], *x[j + 1 :]) for j in range(i + 1, len(x))}
            near |= {(*x[:i], *x[i + 1 :])} if len(x) > 2 else set()
            near |= {(*x[:i], v, *x[i:])} if len(x) < LONGEST_PATTERN else set()
        return [Pattern(levels, self.hold, self.odd) for levels in sorted(near - {x})]


def starting_patterns(period: int, seed: int) -> list[Pattern]:
    """Squares of about this period cut at every length, short binary and four-level patterns, and some at random."""
    rng, patterns = np.random.default_rng(seed), []
    for hold in sorted({1} if period <= 16 else {round(period / 6), round(period / 12)}):
        square = [1.0 if k * hold % period < period / 2 else -1.0 for k in range(LONGEST_PATTERN)]
        for n, odd in product(range(2, LONGEST_PATTERN + 1), (False, True)):
            patterns += [Pattern(tuple(x), hold, odd) for x in (square[:n], rng.choice([-1.0, 1.0], n).tolist())]
        patterns += [Pattern(levels, hold, False) for n in range(3, 8) for levels in product((-1.0, 1.0), repeat=n)]
        patterns += [Pattern(levels, hold, True) for levels in product((-1.0, -0.5, 0.5, 1.0), repeat=4)]
    return sorted(set(patterns))


def families(samples: int, seed: int) -> tuple[dict[str, Vector], dict[str, int]]:
    """Named signals of amplitude 1, and the periods of the square waves among them."""
    from orthaug.analysis import signals  # scipy.signal is slow to import

    def spaced(first: int, last: int) -> list[int]:
        return sorted({*range(first, min(last, 8) + 1), *(round(8 * 1.4**i) for i in range(60) if 8 * 1.4**i <= last)})

    squares = {f"square, period {2 * half}": 2 * half for half in spaced(1, samples // 8)}
    waves = {"white Gaussian": signals.white_gaussian(samples, amplitude=1, seed=seed)}
    waves["white uniform"] = signals.white_uniform(samples, amplitude=1, seed=seed)
    for h in spaced(1, max(samples // 64, 1))[::2]:
        waves[f"white binary, hold {h}"] = signals.white_binary(samples, amplitude=1, seed=seed, hold=h)
        waves[f"PRBS, hold {h}"] = signals.prbs(samples, amplitude=1, hold=h)
    even = samples + samples % 2
    for part in [s for s in (1.0, 0.5, 0.2, 0.1, 0.03, 0.01) if s * samples > 16]:
        band, name = (1 / samples, part / 2), f"up to {part:g} Nyquist"
        waves[f"multisine {name}"] = signals.multisine(samples, amplitude=1, band=band)
        waves[f"odd multisine {name}"] = signals.multisine(even, amplitude=1, band=band, odd=True)[:samples]
        waves[f"swept square {name}"] = signals.swept_square(samples, amplitude=1, band=band, logarithmic=True)
    waves |= {name: signals.square(samples, amplitude=1, period=period) for name, period in squares.items()}
    return waves, squares
