"""Systems that write their own equations of motion, with initial values from a record.

A system is a declaration with a method `motion(record)`. It returns a `Motion` as any other, which
is trained on its free run, split from a learner, saved, exported and reported.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Protocol, runtime_checkable

import numpy as np
from annotated_types import Ge, Le

from orthaug._base.checks import Matrix, Vector
from orthaug._base.errors import InputError
from orthaug._base.registry import OneOf, Registry, check_fields
from orthaug.data.record import Record
from orthaug.physics.motion import Motion
from orthaug.physics.parameters import PhysicalParameter
from orthaug.physics.states import Output, State

_LARGEST_POLE = 0.98  # of a first guess: what least squares place beyond is moved there
_LEAST_GAIN = 0.05  # of the largest coefficient of B
_SIGNIFICANT = 6  # digits of first guesses


@runtime_checkable
class System(Protocol):
    """Interface of `estimate(record, system)`."""

    def motion(self, record: Record) -> Motion:
        """Return the equations of motion, with initial values that suit the record."""
        ...


@dataclass(frozen=True)
class HammersteinWiener:
    """A static curve of each input, a linear system, and a static curve of its output.

    With `h(u) = h1 u + h2 u² + …` and w the sum over the inputs of `q⁻ᵈ B(q)/A(q) h(u)`, A and B
    beginning with 1, the output is `y = y0 + w + g2 w² + …`. In states (controllable form) the
    curve of an input is all that enters the first of them. So a learner of that input gives a curve
    of any shape, whose straight part stays h1.

    Args:
        order: of A and B.
        delay: samples until the output answers, 1 or more.
        input_degree: of the curve h; 1 for a straight line.
        output_degree: of the curve of w; 1 for a straight line.
        offset: whether there is a constant: y0, or beside a learned curve of the input h0 of the
            first curve, which is split from the learned one as h1 is.
        learned: "input" to add a learner to the curves of the inputs, "output" to the output;
            "none".

    Raises:
        InputError: options out of their range.

    Examples:
        >>> system = HammersteinWiener(order=1, input_degree=2, offset=False)
        >>> u = [1.0, 2.0, 0.0, 3.0, 1.0, 0.0]
        >>> y = [0.0, 0.5, 1.25, 0.625, 1.8125, 1.40625]  # 0.5 (y[k-1] + u[k-1])
        >>> motion = system.motion(Record.from_arrays(u=u, y=y))
        >>> [f"{p.name} = {p.initial:g}" for p in motion.parameters]
        ['a1 = -0.5', 'h1 = 0.5', 'h2 = 0']
        >>> motion.states[0].derivative
        '-a1*x1 + h1*u + h2*u**2'
    """

    order: Annotated[int, Ge(1), Le(10)] = 2
    delay: Annotated[int, Ge(1), Le(50)] = 1
    input_degree: Annotated[int, Ge(1), Le(9)] = 3
    output_degree: Annotated[int, Ge(1), Le(9)] = 1
    offset: bool = True
    learned: Annotated[str, OneOf(("none", "input", "output"))] = "none"

    def __post_init__(self) -> None:
        check_fields(self)

    def motion(self, record: Record) -> Motion:
        """Return the equations, with A and B of least squares one step ahead.

        Raises:
            InputError: no input, several outputs, or too few rows.
        """
        if len(record.outputs) != 1 or not record.inputs:
            raise InputError(
                "a Hammerstein-Wiener system has one output and at least one input; the record has "
                f"{len(record.outputs)} and {len(record.inputs)}."
            )
        names, output = [channel.name for channel in record.inputs], record.outputs[0].name
        a, b, offset = self._first_guess(record)
        states, sums, learns = [], [], self.learned == "input"
        parameters = self._values([f"a{i}" for i in range(1, self.order + 1)], a)
        for i, (name, gains) in enumerate(zip(names, b, strict=True)):
            own = "" if len(names) == 1 else f"_{name}"
            chain = [f"x{i}{own}" for i in range(1, self.delay + self.order)]
            curve = [f"h{d}{own}" for d in range(1, self.input_degree + 1)]
            terms = [f"-a{i}*{x}" for i, x in enumerate(chain[: self.order], 1)]
            if self.offset and learns and i == 0:
                terms.append(f"+h0{own}")
                gain = gains.sum() / gains[0] / (1 + a.sum())
                level = offset / gain if abs(gain) > _LEAST_GAIN else 0.0
                parameters.append(PhysicalParameter(f"h0{own}", _rounded(level)))
            powers = (name, *(f"{name}**{d}" for d in range(2, self.input_degree + 1)))
            terms += [f"+{h}*{power}" for h, power in zip(curve, powers, strict=True)]
            first = " ".join((terms[0], *(f"{term[0]} {term[1:]}" for term in terms[1:])))
            states.append(State(chain[0], first, 0.0, learned=learns))
            states += [State(x, before, 0.0) for before, x in zip(chain, chain[1:], strict=False)]
            parameters.append(PhysicalParameter(curve[0], _rounded(gains[0])))
            parameters += [PhysicalParameter(h, 0.0) for h in curve[1:]]
            zeros = [f"b{i}{own}" for i in range(2, self.order + 1)]
            parameters += self._values(zeros, gains[1:] / gains[0])
            answers = chain[self.delay - 1 :]
            sums += [answers[0], *(f"{z}*{x}" for z, x in zip(zeros, answers[1:], strict=True))]
        curve = [f"g{d}" for d in range(2, self.output_degree + 1)]
        text = " + ".join(("w", *(f"{g}*w**{d}" for d, g in enumerate(curve, 2))))
        parameters += [PhysicalParameter(g, 0.0) for g in curve]
        if self.offset and not learns:
            text = f"y0 + {text}"
            parameters.append(PhysicalParameter("y0", _rounded(offset), record.outputs[0].unit))
        return Motion.from_equations(
            states,
            [Output(output, text, learned=self.learned == "output")],
            parameters,
            names,
            define={"w": " + ".join(sums)},
            integrator="discrete",
        )

    @staticmethod
    def _values(names: Sequence[str], values: Vector) -> list[PhysicalParameter]:
        return [
            PhysicalParameter(n, _rounded(value)) for n, value in zip(names, values, strict=True)
        ]

    def _first_guess(self, record: Record) -> tuple[Vector, Matrix, float]:
        """Return a (n,), b (nu, n) and y0 of least squares on the lags, with stable poles."""
        n, first = self.order, self.delay + self.order - 1
        rows, targets = [], []
        for one in record.experiments:
            k = np.arange(max(first, n), len(one))
            past = [-one.outputs[k - i] for i in range(1, n + 1)]
            inputs = [
                one.inputs[k - self.delay - i, j, None]
                for j in range(one.inputs.shape[1])
                for i in range(n)
            ]
            rows.append(np.concatenate([*past, *inputs, np.ones((len(k), 1))], axis=1))
            targets.append(one.outputs[k, 0])
        phi, y = np.concatenate(rows), np.concatenate(targets)
        if len(y) < phi.shape[1]:
            raise InputError(
                f"{len(y)} usable rows are too few for a system of order {n}; it has "
                f"{phi.shape[1]} coefficients. Lower `order` or `delay`."
            )
        if not self.offset:
            phi = phi[:, :-1]
        size = np.sqrt(np.mean(phi**2, axis=0))
        size = np.where(size > 0, size, 1.0)
        found = np.linalg.lstsq(phi / size, y, rcond=1e-8)[0] / size
        poles = np.roots([1.0, *found[:n]])
        beyond = np.maximum(np.abs(poles) / _LARGEST_POLE, 1.0)
        a = np.poly(poles / beyond).real[1:]
        b = found[n : n + n * record.experiments[0].inputs.shape[1]].reshape(-1, n)
        constant = found[-1] / max(float(1 + a.sum()), 1 - _LARGEST_POLE) if self.offset else 0.0
        least = _LEAST_GAIN * np.abs(b).max(
            axis=1, initial=0.0
        )  # B begins with 1: no gain may be 0
        least = np.where(least > 0, least, 1.0)
        b[:, 0] = np.where(np.abs(b[:, 0]) < least, np.copysign(least, b[:, 0]), b[:, 0])
        return a, b, float(constant)


def _rounded(value: float) -> float:
    return float(f"{value:.{_SIGNIFICANT}g}")


SYSTEMS = Registry("system", {"hammerstein_wiener": HammersteinWiener}, reserved=())
"""Systems by name."""
