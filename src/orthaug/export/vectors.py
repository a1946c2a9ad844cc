"""Test vectors: a free run of the model itself, by which an export is checked where it runs."""

from __future__ import annotations

import csv
import io
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from orthaug._base.jax import jax
from orthaug.export.program import Program
from orthaug.models.model import Model

_ROWS, _SEED = 64, 0
_HELD = 8  # rows of each level: under a new one in every row an inertia hardly moves


@dataclass(frozen=True, eq=False)
class Vectors:
    """Inputs, the state before each step and the outputs, a row per step; only rows with finite numbers."""

    inputs: Float[np.ndarray, "r nu"]
    states: Float[np.ndarray, "r n"]
    outputs: Float[np.ndarray, "r ny"]

    @classmethod
    def of(cls, model: Any, program: Program) -> Vectors:
        """A free run under random levels of the inputs, in the range that the model was trained on where that is known.

        It starts from zero, or from one where zero has no output.
        """
        rng = np.random.default_rng(_SEED)
        middle, reach = _range(model, program)
        drawn = middle + reach * np.repeat(rng.uniform(-1, 1, (_ROWS // _HELD, program.held)), _HELD, axis=0)
        inputs = drawn if program.ends == 1 else np.concatenate([drawn, np.roll(drawn, -1, axis=0)], axis=1)

        def run(state: Any, rows: Any) -> Any:
            def one(state: Any, row: Any) -> Any:
                following, y = model.step(state, row)
                return following, (state, y)

            return jax.lax.scan(one, state, rows)[1]

        run, count, states, outputs = jax.jit(run), 0, np.zeros(0), np.zeros(0)
        for start in (np.zeros(len(program.states)), np.ones(len(program.states))):
            states, outputs = map(np.asarray, run(start, inputs))
            finite = np.asarray(np.isfinite(np.concatenate([states, outputs], axis=1)).all(axis=1))
            count = finite.size if finite.all() else int(np.argmin(finite))
            if count:
                break
        return cls(inputs[:count], states[:count], outputs[:count])

    def csv(self, program: Program) -> str:
        """A column for each input, state and output, with `state:` or `output:` before names that stand twice."""
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        kinds = {"input": program.inputs, "state": program.states, "output": program.outputs}
        writer.writerow([f"{kind}:{signal.name}" for kind, signals in kinds.items() for signal in signals])
        for row in np.concatenate([self.inputs, self.states, self.outputs], axis=1):
            writer.writerow([repr(float(value)) for value in row])
        return text.getvalue()


def _range(model: Any, program: Program) -> tuple[Any, Any]:
    """Middle and half width of each input where the learner saw it by itself; 0 and 1 elsewhere."""
    middle, reach = np.zeros(program.held), np.ones(program.held)
    if model.form.bound is None:
        return middle, reach
    entries = model.form.features.entries if isinstance(model, Model) else model.form.features
    names = [signal.name for signal in program.inputs[: program.held]]
    for entry, centre, width in zip(entries, model.numbers.centre, model.numbers.halfwidth, strict=True):
        name = entry.text.partition("[")[0]
        if name in names and (entry.text == name or str(entry.lags[0] if entry.lags else "") == entry.text):
            middle[names.index(name)], reach[names.index(name)] = float(centre), float(width)
    return middle, reach
