"""The noise model of each output of a fit: orders, coefficients with intervals, innovations."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from orthaug.fitting.whiteness import ljung_box
from orthaug.inference.covariance import interval
from orthaug.models.model import Model
from orthaug.physics.problem import Problem

LAGS, LEVEL = 25, 0.05  # of the innovations' whiteness: lags, and the level of the test


@dataclass(frozen=True)
class Coefficient:
    """A coefficient of a noise model; std and interval are None where there are none."""

    name: str
    value: float
    std: float | None = None
    ci95: tuple[float, float] | None = None


@dataclass(frozen=True)
class OutputNoise:
    """`D(q) v_k = C(q) e_k` of one output, D with `ar` coefficients and C with `ma`.

    `std` is that of the innovations e; `white_p` the probability that white ones are as correlated
    (Ljung-Box), None where they are too few.
    """

    output: str
    model: str
    ar: int
    ma: int
    coefficients: tuple[Coefficient, ...]
    std: float | None
    white_p: float | None

    @property
    def text(self) -> str:
        """Return the model in a line."""
        each = [
            f"{one.name} = {one.value:.4g}" + ("" if one.std is None else f" (std {one.std:.2g})")
            for one in self.coefficients
        ]
        end = [] if self.std is None else [f"innovations {self.std:.4g}"]
        if self.white_p is not None:
            end.append(f"white with p = {self.white_p:.2g}")
        return f"{self.output}: {', '.join([self.model, *each, *end])}"


def noise_of(model: Model, problem: Problem) -> tuple[OutputNoise, ...]:
    """Return the noise model of each output on the training rows."""
    noise, freedom = model.noise, model.statistics.freedom
    if noise is None:
        return ()
    variances = model.statistics.noise
    names = [output.name for output in model.outputs]
    std = None if noise.covariance is None else np.sqrt(np.diag(noise.covariance))
    known = iter(enumerate(noise.names(names)))
    runs = model.predict(problem.record).trajectories
    found = []
    for o, ((p, q), output) in enumerate(zip(noise.orders, names, strict=True)):
        coefficients = []
        for i, (_, name) in [next(known) for _ in range(p + q)]:
            value = float(noise.values[i])
            one = Coefficient(name, value)
            if std is not None:
                low, high = interval(value, std[i], freedom)
                one = Coefficient(name, value, float(std[i]), (float(low), float(high)))
            coefficients.append(one)
        pieces = [run.errors[noise.past :, o] for run in runs]
        box = ljung_box([piece for piece in pieces if len(piece)], LAGS, p + q)
        found.append(
            OutputNoise(
                output,
                noise.word(o),
                p,
                q,
                tuple(coefficients),
                None if variances is None else float(np.sqrt(variances[o, o])),
                None if box is None else box.p,
            )
        )
    return tuple(found)
