"""Nonlinear least squares with known answers: NIST's regression problems and those of Moré, Garbow and Hillstrom.

The data and certified values of NIST's Statistical Reference Datasets are tests/references/nist_strd.json. The others
are from Moré, Garbow and Hillstrom, Testing unconstrained optimization software, ACM TOMS 7 (1981), 17-41, by their
numbers there, each with the sums of squares that the paper or its successors give for its minima.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from orthaug._base.jax import jax, jnp

NIST = Path(__file__).resolve().parents[1] / "tests" / "references" / "nist_strd.json"
DIGITS = 6  # of the certified values that count as reached


@cache
def _compiled(residuals: Callable[[Any], Any]) -> tuple[Any, Any]:
    return jax.jit(residuals), jax.jit(jax.jacfwd(residuals))


@dataclass(frozen=True, eq=False)
class Problem:
    """A problem `min ‖r(p)‖²` from one start, with what is known of its minima.

    Args:
        theta: certified parameters; None where only sums of squares are known.
        minima: sums of squares of all known minima, the least first.
    """

    name: str
    residuals: Callable[[Any], Any]
    start: tuple[float, ...]
    minima: tuple[float, ...]
    theta: tuple[float, ...] | None = None

    def residual(self, p: Any) -> np.ndarray:
        """Return r(p)."""
        return np.asarray(_compiled(self.residuals)[0](np.asarray(p, dtype=float)))

    def jacobian(self, p: Any) -> np.ndarray:
        """Return ∂r/∂p."""
        return np.asarray(_compiled(self.residuals)[1](np.asarray(p, dtype=float)))

    def loss(self, p: Any) -> float:
        """Return ‖r(p)‖²."""
        with np.errstate(all="ignore"):
            return float(np.sum(self.residual(p) ** 2))

    def digits(self, p: Any) -> float:
        """Return to how many digits p is an answer, at most 11: those that NIST certifies.

        In parameters where they are certified. Otherwise in the sum of squares, which a minimum of
        zero reaches where it is below 1e-12 of that at the start.
        """
        if not np.isfinite(p).all():
            return 0.0
        if self.theta is not None:
            known = np.asarray(self.theta)
            off = float(np.max(np.abs(p - known) / np.abs(known)))
        else:
            loss, first = self.loss(p), self.loss(self.start)
            off = min(
                abs(loss - least) / least if least else 1e6 * loss / first for least in self.minima
            )
        return float(np.clip(-np.log10(max(off, 1e-300)), 0.0, 11.0)) if np.isfinite(off) else 0.0


def gauss(b: Any, x: Any) -> Any:
    return (
        b[0] * jnp.exp(-b[1] * x)
        + b[2] * jnp.exp(-(((x - b[3]) / b[4]) ** 2))
        + b[5] * jnp.exp(-(((x - b[6]) / b[7]) ** 2))
    )


def lanczos(b: Any, x: Any) -> Any:
    return sum(b[i] * jnp.exp(-b[i + 1] * x) for i in (0, 2, 4))


def enso(b: Any, x: Any) -> Any:
    def wave(size: Any, other: Any, period: Any) -> Any:
        angle = 2 * jnp.pi * x / period
        return size * jnp.cos(angle) + other * jnp.sin(angle)

    return b[0] + wave(b[1], b[2], 12.0) + wave(b[4], b[5], b[3]) + wave(b[7], b[8], b[6])


def chwirut(b: Any, x: Any) -> Any:
    return jnp.exp(-b[0] * x) / (b[1] + b[2] * x)


def cubic_rational(b: Any, x: Any) -> Any:
    return (b[0] + b[1] * x + b[2] * x**2 + b[3] * x**3) / (
        1 + b[4] * x + b[5] * x**2 + b[6] * x**3
    )


NIST_MODELS: dict[str, Callable[..., Any]] = {
    "Misra1a": lambda b, x: b[0] * (1 - jnp.exp(-b[1] * x)),
    "Misra1b": lambda b, x: b[0] * (1 - (1 + b[1] * x / 2) ** -2),
    "Misra1c": lambda b, x: b[0] * (1 - (1 + 2 * b[1] * x) ** -0.5),
    "Misra1d": lambda b, x: b[0] * b[1] * x / (1 + b[1] * x),
    "DanWood": lambda b, x: b[0] * x ** b[1],
    "Chwirut1": chwirut,
    "Chwirut2": chwirut,
    "Lanczos1": lanczos,
    "Lanczos2": lanczos,
    "Lanczos3": lanczos,
    "Gauss1": gauss,
    "Gauss2": gauss,
    "Gauss3": gauss,
    "Kirby2": lambda b, x: (b[0] + b[1] * x + b[2] * x**2) / (1 + b[3] * x + b[4] * x**2),
    "Hahn1": cubic_rational,
    "Nelson": lambda b, x1, x2: b[0] - b[1] * x1 * jnp.exp(-b[2] * x2),
    "MGH09": lambda b, x: b[0] * (x**2 + x * b[1]) / (x**2 + x * b[2] + b[3]),
    "MGH10": lambda b, x: b[0] * jnp.exp(b[1] / (x + b[2])),
    "MGH17": lambda b, x: b[0] + b[1] * jnp.exp(-x * b[3]) + b[2] * jnp.exp(-x * b[4]),
    "Roszman1": lambda b, x: b[0] - b[1] * x - jnp.arctan(b[2] / (x - b[3])) / jnp.pi,
    "ENSO": enso,
    "Thurber": cubic_rational,
    "Rat42": lambda b, x: b[0] / (1 + jnp.exp(b[1] - b[2] * x)),
    "Rat43": lambda b, x: b[0] / (1 + jnp.exp(b[1] - b[2] * x)) ** (1 / b[3]),
    "Eckerle4": lambda b, x: b[0] / b[1] * jnp.exp(-0.5 * ((x - b[2]) / b[1]) ** 2),
    "BoxBOD": lambda b, x: b[0] * (1 - jnp.exp(-b[1] * x)),
    "Bennett5": lambda b, x: b[0] * (b[1] + x) ** (-1 / b[2]),
}


@cache
def nist() -> tuple[Problem, ...]:
    """Return NIST's problems, each from both of its starts."""
    given = json.loads(NIST.read_text(encoding="utf-8"))
    return tuple(problem for name in given for problem in _nist_problems(name, given[name]))


def _nist_problems(name: str, given: dict[str, Any]) -> list[Problem]:
    y, x = np.array(given["y"]), [np.array(column) for column in given["x"]]
    y = np.log(y) if name == "Nelson" else y  # its model is of the logarithm

    def residuals(b: Any) -> Any:
        return NIST_MODELS[name](b, *x) - y

    return [
        Problem(
            f"{name}, start {i}", residuals, tuple(start), (given["rss"],), tuple(given["theta"])
        )
        for i, start in enumerate(given["starts"], 1)
    ]


def _numbers(text: str) -> np.ndarray:
    return np.array(text.split(), dtype=float)


def _stack(*entries: Any) -> Any:
    return jnp.stack([jnp.asarray(entry) for entry in entries])


BARD = _numbers(".14 .18 .22 .25 .29 .32 .35 .39 .37 .58 .73 .96 1.34 2.10 4.39")
GAUSSIAN = _numbers(".0009 .0044 .0175 .0540 .1295 .2420 .3521 .3989")
MEYER = _numbers(
    "34780 28610 23650 19630 16370 13720 11540 9744 8261 7030 6005 5147 4427 3820 3307 2872"
)
KOWALIK = (
    _numbers(".1957 .1947 .1735 .1600 .0844 .0627 .0456 .0342 .0323 .0235 .0246"),
    _numbers("4 2 1 .5 .25 .167 .125 .1 .0833 .0714 .0625"),
)
OSBORNE = (
    _numbers(
        ".844 .908 .932 .936 .925 .908 .881 .850 .818 .784 .751 .718 .685 .658 .628 .603 .580 "
        ".558 .538 .522 .506 .490 .478 .467 .457 .448 .438 .431 .424 .420 .414 .411 .406"
    ),
    _numbers(
        "1.366 1.191 1.112 1.013 .991 .885 .831 .847 .786 .725 .746 .679 .608 .655 .616 .606 .602 "
        ".626 .651 .724 .649 .649 .694 .644 .624 .661 .612 .558 .533 .495 .500 .423 .395 .375 .372 "
        ".391 .396 .405 .428 .429 .523 .562 .607 .653 .672 .708 .633 .668 .645 .632 .591 .559 .597 "
        ".625 .739 .710 .729 .720 .636 .581 .428 .292 .162 .098 .054"
    ),
)


def _rosenbrock(x: Any) -> Any:
    return _stack(10 * (x[1] - x[0] ** 2), 1 - x[0])


def _freudenstein_roth(x: Any) -> Any:
    return _stack(
        -13 + x[0] + ((5 - x[1]) * x[1] - 2) * x[1], -29 + x[0] + ((x[1] + 1) * x[1] - 14) * x[1]
    )


def _powell_badly_scaled(x: Any) -> Any:
    return _stack(1e4 * x[0] * x[1] - 1, jnp.exp(-x[0]) + jnp.exp(-x[1]) - 1.0001)


def _brown_badly_scaled(x: Any) -> Any:
    return _stack(x[0] - 1e6, x[1] - 2e-6, x[0] * x[1] - 2)


def _beale(x: Any) -> Any:
    return np.array([1.5, 2.25, 2.625]) - x[0] * (1 - x[1] ** np.arange(1, 4))


def _jennrich_sampson(x: Any) -> Any:
    i = np.arange(1, 11)
    return 2 + 2 * i - (jnp.exp(i * x[0]) + jnp.exp(i * x[1]))


def _helical_valley(x: Any) -> Any:
    # half a turn more left of the axis, as the paper defines it
    turn = jnp.arctan(x[1] / x[0]) / (2 * jnp.pi) + jnp.where(x[0] < 0, 0.5, 0.0)
    return _stack(10 * (x[2] - 10 * turn), 10 * (jnp.hypot(x[0], x[1]) - 1), x[2])


def _bard(x: Any) -> Any:
    u = np.arange(1, 16)
    v = 16 - u
    return BARD - (x[0] + u / (v * x[1] + np.minimum(u, v) * x[2]))


def _gaussian(x: Any) -> Any:
    t, y = (8 - np.arange(1, 16)) / 2, np.concatenate([GAUSSIAN, GAUSSIAN[-2::-1]])
    return x[0] * jnp.exp(-x[1] * (t - x[2]) ** 2 / 2) - y


def _meyer(x: Any) -> Any:
    return x[0] * jnp.exp(x[1] / (45 + 5 * np.arange(1, 17) + x[2])) - MEYER


def _gulf(x: Any) -> Any:
    t = np.arange(1, 100) / 100
    y = 25 + (-50 * np.log(t)) ** (2 / 3)
    return jnp.exp(-(jnp.abs(y - x[1]) ** x[2]) / x[0]) - t


def _box(x: Any) -> Any:
    t = np.arange(1, 11) / 10
    return jnp.exp(-t * x[0]) - jnp.exp(-t * x[1]) - x[2] * (np.exp(-t) - np.exp(-10 * t))


def _powell_singular(x: Any) -> Any:
    return _stack(
        x[0] + 10 * x[1],
        np.sqrt(5) * (x[2] - x[3]),
        (x[1] - 2 * x[2]) ** 2,
        np.sqrt(10) * (x[0] - x[3]) ** 2,
    )


def _wood(x: Any) -> Any:
    return _stack(
        10 * (x[1] - x[0] ** 2),
        1 - x[0],
        np.sqrt(90) * (x[3] - x[2] ** 2),
        1 - x[2],
        np.sqrt(10) * (x[1] + x[3] - 2),
        (x[1] - x[3]) / np.sqrt(10),
    )


def _kowalik_osborne(x: Any) -> Any:
    y, u = KOWALIK
    return y - x[0] * (u**2 + u * x[1]) / (u**2 + u * x[2] + x[3])


def _brown_dennis(x: Any) -> Any:
    t = np.arange(1, 21) / 5
    return (x[0] + t * x[1] - np.exp(t)) ** 2 + (x[2] + x[3] * np.sin(t) - np.cos(t)) ** 2


def _osborne_1(x: Any) -> Any:
    t = 10.0 * np.arange(33)
    return OSBORNE[0] - (x[0] + x[1] * jnp.exp(-t * x[3]) + x[2] * jnp.exp(-t * x[4]))


def _biggs(x: Any) -> Any:
    t = np.arange(1, 14) / 10
    y = np.exp(-t) - 5 * np.exp(-10 * t) + 3 * np.exp(-4 * t)
    return x[2] * jnp.exp(-t * x[0]) - x[3] * jnp.exp(-t * x[1]) + x[5] * jnp.exp(-t * x[4]) - y


def _osborne_2(x: Any) -> Any:
    t = np.arange(65) / 10
    bumps = sum(x[i] * jnp.exp(-((t - x[7 + i]) ** 2) * x[4 + i]) for i in (1, 2, 3))
    return OSBORNE[1] - (x[0] * jnp.exp(-t * x[4]) + bumps)


def _watson(x: Any) -> Any:
    t, j = np.arange(1, 30)[:, None] / 29, np.arange(len(x))
    slope = (t ** np.maximum(j - 1, 0) * j) @ x
    first = slope - (t**j @ x) ** 2 - 1
    return jnp.concatenate([first, _stack(x[0], x[1] - x[0] ** 2 - 1)])


def _variably_dimensioned(x: Any) -> Any:
    total = jnp.sum(np.arange(1, len(x) + 1) * (x - 1))
    return jnp.concatenate([x - 1, _stack(total, total**2)])


def _brown_almost_linear(x: Any) -> Any:
    n = len(x)
    return jnp.concatenate([x[:-1] + jnp.sum(x) - (n + 1), _stack(jnp.prod(x) - 1)])


def _broyden_tridiagonal(x: Any) -> Any:
    wide = jnp.concatenate([np.zeros(1), x, np.zeros(1)])
    return (3 - 2 * x) * x - wide[:-2] - 2 * wide[2:] + 1


def _scaled(start: tuple[float, ...], times: float) -> tuple[float, ...]:
    return tuple(times * value for value in start)


@cache
def more() -> tuple[Problem, ...]:
    """Return the problems of Moré, Garbow and Hillstrom, from their standard starts.

    Those that have more than one known minimum end at any of them.
    """
    n = 10
    return (
        Problem("1 Rosenbrock", _rosenbrock, (-1.2, 1.0), (0.0,)),
        Problem("1 Rosenbrock, ten times as far", _rosenbrock, _scaled((-1.2, 1.0), 10), (0.0,)),
        Problem("2 Freudenstein-Roth", _freudenstein_roth, (0.5, -2.0), (0.0, 48.98425)),
        Problem("3 Powell badly scaled", _powell_badly_scaled, (0.0, 1.0), (0.0,)),
        Problem("4 Brown badly scaled", _brown_badly_scaled, (1.0, 1.0), (0.0,)),
        Problem("5 Beale", _beale, (1.0, 1.0), (0.0,)),
        Problem("6 Jennrich-Sampson", _jennrich_sampson, (0.3, 0.4), (124.3621824,)),
        Problem("7 Helical valley", _helical_valley, (-1.0, 0.0, 0.0), (0.0,)),
        Problem("8 Bard", _bard, (1.0, 1.0, 1.0), (8.214877e-3, 17.42869)),
        Problem("9 Gaussian", _gaussian, (0.4, 1.0, 0.0), (1.127933e-8,)),
        Problem("10 Meyer", _meyer, (0.02, 4000.0, 250.0), (87.94586,)),
        Problem("11 Gulf research", _gulf, (5.0, 2.5, 0.15), (0.0,)),
        Problem("12 Box 3D", _box, (0.0, 10.0, 20.0), (0.0,)),
        Problem("13 Powell singular", _powell_singular, (3.0, -1.0, 0.0, 1.0), (0.0,)),
        Problem("14 Wood", _wood, (-3.0, -1.0, -3.0, -1.0), (0.0,)),
        Problem("15 Kowalik-Osborne", _kowalik_osborne, (0.25, 0.39, 0.415, 0.39), (3.075056e-4,)),
        Problem("16 Brown-Dennis", _brown_dennis, (25.0, 5.0, -5.0, -1.0), (85822.20,)),
        Problem("17 Osborne 1", _osborne_1, (0.5, 1.5, -1.0, 0.01, 0.02), (5.464895e-5,)),
        Problem("18 Biggs EXP6", _biggs, (1.0, 2.0, 1.0, 1.0, 1.0, 1.0), (0.0, 5.655650e-3)),
        Problem(
            "19 Osborne 2",
            _osborne_2,
            (1.3, 0.65, 0.65, 0.7, 0.6, 3.0, 5.0, 7.0, 2.0, 4.5, 5.5),
            (4.013774e-2,),
        ),
        Problem("20 Watson, 6", _watson, (0.0,) * 6, (2.287670e-3,)),
        Problem("20 Watson, 9", _watson, (0.0,) * 9, (1.399760e-6,)),
        Problem("20 Watson, 12", _watson, (0.0,) * 12, (4.722381e-10,)),
        Problem(
            "25 Variably dimensioned",
            _variably_dimensioned,
            tuple(1 - i / n for i in range(1, n + 1)),
            (0.0,),
        ),
        Problem("27 Brown almost linear", _brown_almost_linear, (0.5,) * n, (0.0, 1.0)),
        Problem("30 Broyden tridiagonal", _broyden_tridiagonal, (-1.0,) * n, (0.0,)),
    )
