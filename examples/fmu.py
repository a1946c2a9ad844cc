"""The fitted model as an FMU in a simulation of somebody else: fmpy drives it, against the model itself.

    python examples/fmu.py [folder]

Exports the paper's mass-spring-damper with its network as an FMU 2.0 for co-simulation, validates it, and lets fmpy run
it under a recorded force. Needs gcc to write it and fmpy to run it.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import numpy as np

import orthaug as oa


def co_simulated(file: Path, force: np.ndarray, sampling_time: float) -> np.ndarray:
    """The position that fmpy finds at every sample, from rest."""
    import fmpy

    time = sampling_time * np.arange(len(force))
    given = np.array(list(zip(time, force, strict=True)), dtype=[("time", float), ("force", float)])
    found = fmpy.simulate_fmu(
        str(file),
        stop_time=time[-1],
        step_size=sampling_time,
        output_interval=sampling_time,
        input=given,
        output=["position"],
        validate=True,
    )
    return found["position"]


def main(place: str | None = None) -> float:
    """Fit, export, co-simulate, and print the largest deviation from `simulate` over the largest output."""
    example = oa.synthetic.mass_spring_damper()
    model = oa.estimate(example.train, example.baseline, learner=oa.MLP((16,)), restarts=1).model
    force = example.test.experiments[0].inputs[:, 0]
    rest = np.zeros(model.form.first_row)  # rows before the first one
    resting = oa.Record.from_arrays(np.r_[rest, force], sampling_time=0.01, inputs=["force"])
    expected = model.simulate(resting, initial="zero").model[len(rest) :, 0]
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(place or temporary) / "fmu"
        oa.export(model, folder, "fmu", name="plant", force=True)
        position = co_simulated(folder / "plant.fmu", force, model.sampling_time)
    deviation = float(np.abs(position - expected).max() / np.abs(expected).max())
    print(f"fmpy: {len(position)} samples, deviation {deviation:.1e} of the largest output")
    return deviation


if __name__ == "__main__":
    main(*sys.argv[1:2])
