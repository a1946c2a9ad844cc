"""Does `select` find the structure that generated the data, and what do its numbers mean?

Sparse NARX systems and linear ones with known structure, equation noise and sensor noise; the level and power of the
test for anything nonlinear; coverage of intervals of terms that one half of the data chose and the other fitted; time
against rows. SysIdentPy's FROLS gets the same data where that package is installed.
Run: python benchmarks/selection.py [silverbox | terms | orders | level | power | coverage | collinear | time]
[systems or draws]
"""

from __future__ import annotations

import sys
import tempfile
import time
from functools import cache
from pathlib import Path

import numpy as np
import scipy.signal
from machine import describe
from measured_sets import written

import orthaug as oa
from orthaug.analysis.scoring import score_part
from orthaug.commands.select import open_select, select_for
from orthaug.data.terms import TermLibrary
from orthaug.physics.problem import pose
from orthaug.selection.nonlinearity import nonlinearity

SIGNALS = [f"y[k-{i}]" for i in (1, 2, 3)] + [f"u[k-{i}]" for i in (1, 2, 3)]
PHYSICS = oa.Baseline.from_terms([oa.Term("a", "y[k-1]"), oa.Term("b", "u[k-1]")])
LAGS = oa.Lags(3, 3, 1)
FLOWN = oa.Simulation(segment=256, washout=20)
TRUE_TERMS = 3
BEFORE = 100  # samples of a run that are left out
CASES = (
    ("equation noise, 30 dB, one step", "equation", 30, oa.Prediction()),
    ("equation noise, 40 dB, one step", "equation", 40, oa.Prediction()),
    ("equation noise, 30 dB, free run", "equation", 30, FLOWN),
    ("sensor noise, 30 dB, free run", "sensor", 30, FLOWN),
    ("sensor noise, 40 dB, free run", "sensor", 40, FLOWN),
)
ORDER_CASES = (
    ("equation noise, 30 dB, one step", "equation", 30, oa.Prediction()),
    ("equation noise, 30 dB, free run", "equation", 30, FLOWN),
    ("sensor noise, 30 dB, free run", "sensor", 30, FLOWN),
    ("sensor noise, 20 dB, free run", "sensor", 20, FLOWN),
)


class Narx:
    """`y = a y[k-1] + b u[k-1] + Σ c_j t_j`, three terms of a library of degree 3, bounded, each of them felt."""

    def __init__(self, number: int) -> None:
        rng = np.random.default_rng([number, 77])
        full = TermLibrary.of(SIGNALS, 3)
        texts = [text for text in full.texts if text not in ("1", "y[k-1]", "u[k-1]")]
        place = {text: i for i, text in enumerate(full.texts)}
        while True:
            self.texts = [texts[i] for i in rng.choice(len(texts), TRUE_TERMS, replace=False)]
            self.products = [full.products[place[text]] for text in self.texts]
            self.coefficients = rng.uniform(0.1, 0.35, TRUE_TERMS) * rng.choice([-1, 1], TRUE_TERMS)
            self.a, self.b = rng.uniform(0.3, 0.8), rng.uniform(0.5, 1)
            self.number = number
            whole = self.run(4000, 0.0, 1)
            if whole is not None and whole[1].std() > 0.1 and self._felt(*whole):
                self.deviation = whole[1].std()
                return

    def _terms(self, u: np.ndarray, y: np.ndarray, k: int) -> list[float]:
        return [
            float(np.prod([(y if f < 3 else u)[k - f % 3 - 1] for f in product]))
            for product in self.products
        ]

    def _felt(self, u: np.ndarray, y: np.ndarray) -> bool:
        """Whether each term moves the output by a hundredth of its deviation."""
        each = np.array([self._terms(u, y, k) for k in range(3, len(u))])
        return bool(np.all(np.abs(self.coefficients) * each.std(axis=0) > 0.01 * y.std()))

    def run(self, rows: int, noise: float, seed: int) -> tuple[np.ndarray, np.ndarray] | None:
        """Input and output with equation noise; None where it runs away."""
        rng = np.random.default_rng([seed, self.number])
        u, y = rng.uniform(-1, 1, rows + BEFORE), np.zeros(rows + BEFORE)
        for k in range(3, len(y)):
            y[k] = (
                self.a * y[k - 1]
                + self.b * u[k - 1]
                + self.coefficients @ self._terms(u, y, k)
                + noise * rng.normal()
            )
            if abs(y[k]) > 20:
                return None
        return u[BEFORE:], y[BEFORE:]

    def record(self, kind: str, db: float, rows: int = 1000, seed: int = 2) -> oa.Record:
        """A record with noise in the equation or at the sensor."""
        noise = self.deviation * 10 ** (-db / 20)
        ran = self.run(rows, noise if kind == "equation" else 0.0, seed)
        assert ran is not None, "a system that is bounded without noise ran away"
        u, y = ran
        if kind == "sensor":
            y = y + noise * np.random.default_rng([self.number, seed, 9]).normal(size=rows)
        return oa.Record.from_arrays(u=u, y=y)


@cache
def systems(count: int) -> tuple[Narx, ...]:
    """The first systems."""
    return tuple(Narx(number) for number in range(count))


def linear(number: int) -> tuple[tuple[int, int, int], np.ndarray, np.ndarray]:
    """na, nb, nk of 1 to 3, and the two polynomials."""
    rng = np.random.default_rng([number, 5])
    na, nb, nk = (int(n) for n in rng.integers(1, 4, 3))
    poles: list[complex] = []
    if na >= 2:
        r, angle = rng.uniform(0.5, 0.9), rng.uniform(0.3, 1.5)
        poles += [r * np.exp(1j * angle), r * np.exp(-1j * angle)]
    if na % 2:
        poles.append(rng.uniform(0.3, 0.85))
    zeros = rng.uniform(0.3, 1, nb) * rng.choice([-1, 1], nb)
    return (na, nb, nk), np.real(np.poly(poles)), np.concatenate([np.zeros(nk), zeros])


def linear_record(number: int, kind: str, db: float, rows: int = 1000, seed: int = 6) -> oa.Record:
    """A record of a linear system with white input."""
    _, a, b = linear(number)
    rng = np.random.default_rng([number, seed])
    u = rng.normal(size=rows + BEFORE)
    y = scipy.signal.lfilter(b, a, u)
    e = rng.normal(size=rows + BEFORE) * y.std() * 10 ** (-db / 20)
    y = y + (scipy.signal.lfilter([1.0], a, e) if kind == "equation" else e)
    return oa.Record.from_arrays(u=u[BEFORE:], y=y[BEFORE:])


def terms(count: int = 20) -> dict[str, list[float]]:
    """% of true terms found, spurious terms, % of systems found exactly, and seconds, the means over the systems."""
    found: dict[str, list[float]] = {}
    for name, kind, db, criterion in CASES:
        rows = []
        for one in systems(count):
            began = time.monotonic()
            chosen = oa.select(
                one.record(kind, db), PHYSICS, lags=LAGS, criterion=criterion
            ).learner
            got = set() if chosen is None else set(chosen.terms)
            true = set(one.texts)
            took = time.monotonic() - began
            rows.append(
                (100 * len(got & true) / TRUE_TERMS, len(got - true), 100 * (got == true), took)
            )
        found[name] = np.mean(rows, axis=0).tolist()
        frols = [_frols(one.record(kind, db), one) for one in systems(count)]
        if all(row is not None for row in frols):
            found[f"{name}; FROLS"] = [*np.mean(np.array(frols, dtype=float), axis=0).tolist()]
    return found


def _frols(record: oa.Record, system: Narx) -> tuple[float, float, float, float] | None:
    """The same by SysIdentPy's FROLS with its own information criterion; None where that package is not installed."""
    try:
        from sysidentpy.basis_function import Polynomial
        from sysidentpy.model_structure_selection import FROLS
        from sysidentpy.parameter_estimation import LeastSquares
    except ImportError:
        return None
    began = time.monotonic()
    u, y = record.experiments[0].inputs, record.experiments[0].outputs
    options = {
        "order_selection": True,
        "n_info_values": 20,
        "info_criteria": "bic",
        "err_tol": None,
    }
    model = FROLS(
        ylag=3, xlag=3, basis_function=Polynomial(degree=3), estimator=LeastSquares(), **options
    )
    model.fit(X=u, y=y)
    got = set()
    for code in model.final_model:
        lags = sorted((("y", c - 1000) if c < 2000 else ("u", c - 2000)) for c in code if c)
        got.add(tuple((name, int(lag)) for name, lag in lags))
    full = {tuple(sorted((("y" if f < 3 else "u"), f % 3 + 1) for f in p)) for p in system.products}
    known = {(("y", 1),), (("u", 1),)}
    spurious = len(got - full - known)
    exact = 100 * (got - known == full)
    return 100 * len(got & full) / TRUE_TERMS, spurious, exact, time.monotonic() - began


def orders(count: int = 20) -> dict[str, float]:
    """% of linear systems whose na, nb and nk are found."""
    found = {}
    for name, kind, db, criterion in ORDER_CASES:
        right = []
        for number in range(count):
            record = linear_record(number, kind, db)
            chosen = oa.select(
                record, None, learner=None, lags=oa.Lags(5, 8, 0), criterion=criterion
            ).orders.chosen
            right.append((chosen.na, chosen.nb[0], chosen.nk[0]) == linear(number)[0])
        found[name] = 100 * float(np.mean(right))
    return found


def level(draws: int = 2000) -> dict[str, float]:
    """% of linear records with true orders for which something nonlinear is said to be missing, at the level of 5 %."""
    found = {}
    for kind in ("equation", "sensor"):
        result = [
            _tested(number, linear_record(number, kind, 30, 600, 66)) for number in range(draws)
        ]
        found[f"{kind} noise"] = 100 * float(np.mean(result))
    return found


def _tested(number: int, record: oa.Record) -> bool:
    (na, nb, nk), _, _ = linear(number)
    lags = [f"y[k-{i}]" for i in range(1, na + 1)] + [f"u[k-{i}]" for i in range(nk, nk + nb)]
    tested = nonlinearity(pose(record, oa.Baseline.from_terms([oa.Term("offset", "1")])), lags, 499)
    assert tested is not None
    return tested.found


def power(draws: int = 100) -> dict[str, float]:
    """% of records with a cubic term of some size, by its share of the output's deviation in %, that are told."""
    found = {}
    for share in (0.0, 0.5, 1.0, 2.0, 4.0):
        entries = []
        for draw in range(draws):
            rng = np.random.default_rng([draw, 31])
            u, e = rng.normal(size=700), 0.03 * rng.normal(size=700)
            y = np.zeros(700)
            for k in range(1, 700):
                y[k] = 0.7 * y[k - 1] + u[k - 1] + share / 100 * 0.35 * u[k - 1] ** 3 + e[k]
            problem = pose(oa.Record.from_arrays(u=u[100:], y=y[100:]), PHYSICS)
            tested = nonlinearity(problem, ["y[k-1]", "u[k-1]"], 499)
            entries.append(tested is not None and tested.found)
        found[f"{share:g} %"] = 100 * float(np.mean(entries))
    return found


def coverage(draws: int = 200) -> dict[str, float]:
    """% of 95 % intervals that hold the true coefficient, of true terms chosen on one half and fitted on the other."""
    held = {"other half": [], "same data": []}
    for draw in range(draws):
        one = systems(20)[draw % 20]
        record = one.record("equation", 30, 2000, 100 + draw)
        truth = dict(zip(one.texts, one.coefficients, strict=True))
        for name, halves in (("other half", True), ("same data", False)):
            chosen = oa.select(record, PHYSICS, lags=LAGS, criterion=oa.Prediction(), halves=halves)
            if chosen.learner is None:
                continue
            # Which `chosen.estimate()` gives no intervals
            data = record if name == "same data" else chosen.record
            table = oa.estimate(data, PHYSICS, **chosen.options).terms
            for term, row in table.iterrows():
                true = truth.get(str(term), 0.0)
                held[name].append(row["ci95_low"] <= true <= row["ci95_high"])
    return {name: 100 * float(np.mean(rows)) for name, rows in held.items()}


HEAT = oa.Baseline.from_terms(
    [oa.Term("a1", "y[k-1]"), oa.Term("b1", "u[k-1]"), oa.Term("b0", "1")]
)


def exchanger(seed: int, noise: float, mean: float, rows: int = 1500) -> oa.Record:
    """A slow plant with a persistent input: a saturating gain, a wall that stores heat, a drift."""
    rng = np.random.default_rng(seed)
    u = 0.4 + 0.2 * np.tanh(
        scipy.signal.lfilter([1], [1, -0.97], rng.normal(size=rows + 300))[300:] / 4
    )
    drift = scipy.signal.lfilter([0.02], [1, -0.995], rng.normal(size=rows))
    y, wall = np.zeros(rows), 0.0
    for k in range(1, rows):
        v = np.tanh(2.5 * (u[k - 1] - 0.4))
        wall += 0.05 * (v - wall)
        y[k] = y[k - 1] + 0.1 * (-8 * v * (1 + 0.3 * v) - 4 * wall + drift[k - 1] - y[k - 1])
    return oa.Record.from_arrays(u=u, y=mean + y + noise * rng.normal(size=rows))


def collinear(seeds: int = 4) -> dict[str, list[float]]:
    """By the limit: how much terms widen a standard error of θ (median, worst), error on blocks over physics alone."""
    found = {}
    for limit in (0.0, 0.005, 0.02, 0.05, 0.1):
        rows = []
        for seed in range(seeds):
            for noise, mean in ((0.02, 97.0), (0.1, 97.0), (0.02, 5.0)):
                record = exchanger(seed, noise, mean)
                one = oa.select(record, HEAT, criterion=oa.Prediction(), most=40, collinear=limit)
                assert one.physics is not None and one.terms is not None
                widened = max(
                    s.after_std / s.before_std
                    for s in one.physics.shifts
                    if s.after_std and s.before_std
                )
                rows.append((widened, one.terms.chosen.score / one.terms.rungs[0].score))
        widened, better = np.array(rows).T
        scale = float(np.exp(np.mean(np.log(better))))
        found[f"{limit:g}"] = [float(np.median(widened)), float(widened.max()), scale]
    return found


def seconds() -> dict[int, float]:
    """Seconds of a search of 80 terms against the rows; the slope of logarithms is in the last entry."""
    one, found = systems(1)[0], {}
    for rows in (50_000, 100_000, 200_000, 400_000):
        record = one.record("equation", 30, rows)
        oa.select(record, PHYSICS, lags=LAGS, most=4)
        began = time.monotonic()
        oa.select(record, PHYSICS, lags=LAGS, most=4)
        found[rows] = time.monotonic() - began
    return found


def term_table() -> list[list[float]]:
    """Rows of `terms` without seconds: ours, for each case."""
    return [row[:3] for name, row in terms().items() if not name.endswith("FROLS")]


def frols_table() -> list[list[float | None]]:
    """The same of FROLS; None where it is not installed."""
    found = {name: row[:3] for name, row in terms().items() if name.endswith("FROLS")}
    return [found.get(f"{name}; FROLS", [None] * 3) for name, *_ in CASES]


def order_table() -> list[float]:
    """% of systems whose orders are found, for each case."""
    return list(orders().values())


def level_table() -> list[float]:
    """% of linear records that are said to lack something, with equation noise and with sensor noise."""
    return list(level().values())


def power_table() -> list[float]:
    """% of records that are told, by the size of the cubic term."""
    return list(power().values())


def coverage_table() -> list[float]:
    """% of intervals that hold the truth, of terms fitted on the other half, and on the same data."""
    return list(coverage().values())


def silverbox() -> list[float | None]:
    """Number of terms, and RMSE in mV of the free run on multisine, arrow and inner arrow; None without the data."""
    with tempfile.TemporaryDirectory() as folder:
        path = written("silverbox_terms", Path(folder))
        if path is None:
            return [None] * 4
        job, spec = open_select(path)
        chosen = select_for(job, spec, path.parent, lambda stage, rung: None).selection
    fit = chosen.estimate()
    scored = [score_part(fit.model, part, [])[0].simulation.rmse for part in job.tests]
    return [len(fit.terms), *(1e3 * rmse[0] for rmse in scored)]


STUDIES = {
    "silverbox": lambda: {"terms, mV": silverbox()},
    "terms": terms,
    "orders": orders,
    "level": level,
    "power": power,
    "coverage": coverage,
    "collinear": collinear,
    "time": seconds,
}


if __name__ == "__main__":
    print(describe())
    chosen = [name for name in sys.argv[1:] if name in STUDIES] or list(STUDIES)
    numbers = [int(word) for word in sys.argv[1:] if word.isdigit()]
    for name in chosen:
        print(name, flush=True)
        for key, value in STUDIES[name](*numbers[: int(name not in ("time", "silverbox"))]).items():
            shown = value if isinstance(value, float) else [round(v, 2) for v in value]
            print(f"  {key}: {shown}", flush=True)
