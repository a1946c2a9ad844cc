"""A machine that changes: its mass grows, then its friction steps up; θ is followed online and the alarm is raised.

Run: python examples/online.py [FOLDER]
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

import orthaug as oa

TS, ROWS = 0.01, 3000
STEP = 2000  # the row at which friction doubles
CHANNELS = {
    "inputs": [oa.Channel("force", "N")],
    "outputs": [oa.Channel("position", "m")],
    "sampling_time": TS,
}


def measured(seed: int, mass, friction) -> oa.Record:
    """`m a = u − 2 v − 100 x − F tanh(v / 0.05) + noise` under random steps of force; m and F of every row."""
    rng = np.random.default_rng(seed)
    force = np.repeat(rng.normal(0, 20.0, ROWS // 10), 10)
    noise, x = rng.normal(0, 1.0, ROWS), np.zeros(ROWS)
    m, f = np.broadcast_to(mass, ROWS), np.broadcast_to(friction, ROWS)
    for k in range(2, ROWS):
        v = (x[k - 1] - x[k - 2]) / TS
        push = force[k - 1] - 2.0 * v - 100.0 * x[k - 1] - f[k] * np.tanh(v / 0.05) + noise[k]
        x[k] = 2 * x[k - 1] - x[k - 2] + TS**2 * push / m[k]
    return oa.Record.from_arrays(force, x, **CHANNELS)


def main(folder: Path) -> dict[str, float]:
    """Fit, follow, save and go on; what was found by name."""
    terms = [("theta1", "position[k-1]"), ("theta2", "position[k-2]"), ("theta3", "force[k-1]")]
    baseline = oa.Baseline.from_terms([oa.Term(*term) for term in terms])
    learner = oa.MLP(
        (8,), inputs=("(position[k-1] - position[k-2])/Ts",)
    )  # it sees the velocity, and finds friction
    fit = oa.estimate(measured(0, 1.0, 3.0), baseline, learner=learner)
    physics = oa.PhysicsMap.of(
        [
            oa.PhysicalParameter("m", 1.2, "kg", min=0),
            oa.PhysicalParameter("c", 1.0, "N s/m"),
            oa.PhysicalParameter("ks", 80.0, "N/m"),
        ],
        {"theta1": "2 - c*Ts/m - ks*Ts**2/m", "theta2": "c*Ts/m - 1", "theta3": "Ts**2/m"},
        {"Ts": TS},
    )

    rows = np.arange(ROWS)
    mass = 1.0 + 0.2 * np.minimum(rows / STEP, 1.0)
    record = measured(1, mass, np.where(rows < STEP, 3.0, 6.0))
    force, position = record.experiments[0].inputs, record.experiments[0].outputs

    online = oa.Recursive(fit, memory=1.0)  # seconds
    online.update(u=force[: STEP // 2], y=position[: STEP // 2])
    online.save(folder / "state")  # the controller is switched off here …

    online = oa.Recursive.load(folder / "state")  # … and on again
    for k in range(STEP // 2, STEP):  # a sample at a time
        online.update(u=force[k], y=position[k])
    followed = online.physical(physics)
    alarms = online.update(u=force[STEP:], y=position[STEP:])

    print(followed)
    print(online.summary())
    oa.plot(
        online, title="mass grows until 20 s, then friction doubles", path=folder / "online.png"
    )
    delay = alarms[0].time - STEP * TS if alarms else np.inf
    return {
        "m": float(followed.value[0]),
        "delay": float(delay),
        "early": float(len(online.alarms) - len(alarms)),
    }


if __name__ == "__main__":
    target = Path(sys.argv[1] if len(sys.argv) > 1 else "orthaug-out/online")
    target.mkdir(parents=True, exist_ok=True)
    print(main(target))
