"""The noise model of each output of a fit: orders, coefficients with intervals, innovations."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from orthaug.fitting.whiteness import ljung_box
from orthaug.inference.covariance import interval
from orthaug.models.model import Model
from orthaug.physics.innovations import InnovationsModel
from orthaug.physics.noise import NoiseModel
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

    Of a motion in innovations form it has no orders: the coefficients are the output's column of
    the predictor's gain K.

    `std` is that of the innovations e; `white_p` the probability that white ones are as correlated
    (Ljung-Box), None where they are too few.
    """

    output: str
    model: str
    ar: int | None
    ma: int | None
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
            white = self.white_p >= LEVEL
            p = f"{self.white_p:.2g}"
            end.append(f"white with p = {p}" if white else f"not white (p = {p})")
        return f"{self.output}: {', '.join([self.model, *each, *end])}"


def noise_of(model: Model, problem: Problem) -> tuple[OutputNoise, ...]:
    """Return the noise model of each output on the training rows."""
    noise, freedom = model.noise, model.statistics.freedom
    if noise is None:
        return ()
    variances = model.statistics.noise
    std = None if noise.covariance is None else np.sqrt(np.diag(noise.covariance))
    free = noise.white and isinstance(noise, InnovationsModel)
    runs = (model.simulate if free else model.predict)(problem.record).trajectories
    found = []
    for o, output in enumerate(channel.name for channel in model.outputs):
        word, orders, past, places = _declared(noise, model, o)
        coefficients = []
        for i, name in places:
            value = float(noise.values[i])
            one = Coefficient(name, value)
            if std is not None:
                low, high = interval(value, std[i], freedom)
                one = Coefficient(name, value, float(std[i]), (float(low), float(high)))
            coefficients.append(one)
        pieces = [errors[~np.isnan(errors)] for errors in (run.errors[past:, o] for run in runs)]
        box = ljung_box([piece for piece in pieces if len(piece)], LAGS, len(places))
        found.append(
            OutputNoise(
                output,
                word,
                *orders,
                tuple(coefficients),
                None if variances is None else float(np.sqrt(variances[o, o])),
                None if box is None else box.p,
            )
        )
    return tuple(found)


def _declared(
    noise: NoiseModel | InnovationsModel, model: Model, o: int
) -> tuple[str, tuple[int | None, int | None], int, list[tuple[int, str]]]:
    """Return of an output: word, orders, rows that are past only, places and names of values."""
    names = [output.name for output in model.outputs]
    if isinstance(noise, InnovationsModel):
        places = [
            (i * len(names) + o, f"K[{state}]") for i, state in enumerate(model.form.state_names)
        ]
        return (
            ("white", (None, None), 0, [])
            if noise.white
            else ("innovations", (None, None), 0, places)
        )
    first = sum(map(sum, noise.orders[:o]))
    count = sum(noise.orders[o])
    own = enumerate(name for _, name in noise.names(names)[first : first + count])
    return noise.word(o), noise.orders[o], noise.past, [(first + i, name) for i, name in own]
