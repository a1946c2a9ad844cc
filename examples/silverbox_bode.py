"""The frequency response of Silverbox with 95 % bands, against what the data alone say.

    python examples/silverbox_bode.py

Linear physics with a learned cubic spring, trained on the free run over 2000 rows; the data alone are all rows of the
training part, whose larger swings stiffen the spring: their resonance lies higher than that at rest. The data are not
part of this project: see examples/README.md. They are read from the folder ORTHAUG_DATA, or from where
examples/silverbox.toml reads them.
"""

from __future__ import annotations

import os
from pathlib import Path

import orthaug as oa

HERE = Path(__file__).parent
ROWS, FIRST = [40650, 105712], 2000
LINEAR = ["V2[k-1]", "V2[k-2]", "V1[k]", "V1[k-1]", "V1[k-2]", "1"]
NAMES = ["a1", "a2", "b0", "b1", "b2", "offset"]


def training() -> oa.Record:
    """The multisines of the training part."""
    folder = Path(os.environ.get("ORTHAUG_DATA", HERE.parents[1] / "shared" / "data"))
    volt = {"inputs": [oa.Channel("V1", "V")], "outputs": [oa.Channel("V2", "V")]}
    return oa.read_record(
        folder / "silverbox" / "SNLS80mV.csv", **volt, sampling_time=0.001638468, rows=ROWS
    )


def main(folder: Path | None = None) -> oa.Linearization:
    """Fit, linearise at rest, print resonance and damping, and draw the response."""
    record = training()
    baseline = oa.Baseline.from_terms([oa.Term(n, r) for n, r in zip(NAMES, LINEAR, strict=True)])
    fit = oa.estimate(
        record.rows(0, FIRST),
        baseline,
        learner=oa.Terms(["V2[k-1]**3"]),
        criterion=oa.Simulation(segment=512, washout=40),
    )
    fit = fit.robust()  # what the model lacks colours its errors
    found = oa.linearize(fit.model, "V1 = 0", record)
    view = found[0]
    resonance, agreement = view.poles[0], found.agreement(view)
    (low, high), (least, most) = resonance.hertz_ci95, resonance.damping_ci95
    print(f"resonance {resonance.hertz:.3f} Hz, 95 % interval {low:.3f} to {high:.3f}")
    print(f"damping {resonance.damping:.4f}, 95 % interval {least:.4f} to {most:.4f}")
    print(
        f"against data alone: {agreement.decibel:.2f} dB, {agreement.degrees:.2f} degrees (medians)"
    )
    out = Path("orthaug-out") if folder is None else folder
    out.mkdir(parents=True, exist_ok=True)
    oa.plot(found, "bode", path=out / "silverbox_bode.png")
    return found


if __name__ == "__main__":
    main()
