"""Write the two records of the project's README, run1.csv and run2.csv, into the current folder.

A mass of 1 kg, a spring of 100 N/m, a damper of 2 N s/m and dry friction of 4 N; 1 mm of noise on the position.
"""

from __future__ import annotations

import numpy as np


def record(rows: int, seed: int) -> np.ndarray:
    """Return force [N] and measured position [m] at every 20 ms, (rows, 2)."""
    rng = np.random.default_rng(seed)
    force, position = np.repeat(rng.uniform(-20, 20, rows // 10), 10), np.zeros(rows)
    x = v = 0.0
    for i in range(rows):
        position[i] = x
        for _ in range(200):
            v += 1e-4 * (force[i] - 2 * v - 100 * x - 4 * np.tanh(v / 0.05))
            x += 1e-4 * v
    return np.column_stack([force, position + 1e-3 * rng.normal(size=rows)])


def main() -> None:
    for name, rows, seed in (("run1.csv", 400, 1), ("run2.csv", 200, 2)):
        columns = {"header": "force,position", "comments": ""}
        np.savetxt(name, record(rows, seed), delimiter=",", fmt="%.9g", **columns)


if __name__ == "__main__":
    main()
