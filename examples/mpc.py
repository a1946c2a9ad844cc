"""A mass with friction follows a reference: model predictive control by the fitted model and by physics alone.

    python examples/mpc.py [figure.png]

Both models are fitted to the same record, written as CasADi functions by `oa.export`, and are used in the same optimal
control problem: horizon, weights, limits and solver (IPOPT) are the same, and neither integrates the tracking error.
The plant is integrated finely; its friction has a static peak (Stribeck), which neither model contains. Needs casadi and
matplotlib.
"""

from __future__ import annotations

import importlib.util
import math
import sys
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import orthaug as oa

TS, FINE = 0.02, 80  # s, and steps of the plant's integrator in a sample
MASS, DAMPING, STIFFNESS = 1.0, 4.0, 100.0  # kg, N s/m, N/m
COULOMB, STATIC, STRIBECK, SMOOTH = 2.0, 3.0, 0.05, 0.005  # N, N, m/s, m/s
LIMIT, NOISE = 15.0, 2e-5  # N, and m of the sensor
HORIZON, EFFORT = 12, 1e-6  # steps, and m²/N² for changes of the force
STEPS = 250


class Run(NamedTuple):
    """A controlled run: position [m] and force [N] at every sample."""

    position: np.ndarray
    force: np.ndarray


def friction(v: float) -> float:
    """The force [N] against a velocity [m/s]: Coulomb, with a peak near standstill."""
    return (COULOMB + (STATIC - COULOMB) * math.exp(-((v / STRIBECK) ** 2))) * math.tanh(v / SMOOTH)


def advance(state: tuple[float, float], force: float) -> tuple[float, float]:
    """The plant one sample later, under a force that is held; by semi-implicit Euler steps."""
    x, v = state
    for _ in range(FINE):
        v += TS / FINE * (force - DAMPING * v - STIFFNESS * x - friction(v)) / MASS
        x += TS / FINE * v
    return x, v


def record(rows: int = 3000, seed: int = 0) -> oa.Record:
    """The plant under a random force."""
    rng = np.random.default_rng(seed)
    force = np.repeat(rng.uniform(-LIMIT, LIMIT, rows // 10), 10) + rng.uniform(-2, 2, rows)
    state, position = (0.0, 0.0), []
    for f in force:
        position.append(state[0])
        state = advance(state, f)
    measured = np.array(position) + NOISE * rng.normal(size=rows)
    return oa.Record.from_arrays(
        force, measured, sampling_time=TS, inputs=["force"], outputs=["position"]
    )


def fitted() -> dict[str, oa.Model]:
    """Physics alone, and with a learned correction; from the same record."""
    data = record()
    names = ("position[k-1]", "position[k-2]", "force[k-1]", "force[k-2]")
    physics = oa.Baseline.from_terms(
        [oa.Term(f"theta{i + 1}", name) for i, name in enumerate(names)]
    )
    velocity = f"(position[k-1] - position[k-2])/{TS}"
    network = oa.MLP((16,), inputs=(velocity, "position[k-1]", "force[k-1]", "force[k-2]"))
    alone = oa.estimate(data, physics, learner=None)
    both = oa.estimate(data, physics, learner=network, restarts=1)
    return {"physics alone": alone.model, "with the learned part": both.model}


def exported(model: oa.Model, folder: Path) -> Any:
    """The model's step as a CasADi function: (state, force) → (next state, position)."""
    oa.export(model, folder, "casadi", name="plant")
    spec = importlib.util.spec_from_file_location(
        folder.name.replace(" ", "_"), folder / "plant.py"
    )
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.step()


class Controller:
    """min Σ (y_k − r_k)² + λ Σ (u_k − u_{k−1})² over the horizon, the model as a constraint at every step.

    A mass that sticks does not move for a little more force: a plan that sticks has no slope that would end it. So the
    search begins at the best of the last plan and that plan with a force added.
    """

    ADDED = (0.0, -2.0, 2.0, -4.0, 4.0, -6.0, 6.0)  # N

    def __init__(self, step: Any) -> None:
        import casadi as ca

        y, u, r = (ca.SX.sym(name, HORIZON) for name in "yur")
        known = ca.SX.sym("known", 4)  # positions now and before, the two last forces
        forces = ca.vertcat(known[3], known[2], u)

        def after(positions: Any, k: int) -> Any:
            """The next position; the state is position[k-1], position[k-2], force[k-1], force[k-2]."""
            state = ca.vertcat(positions[k + 1], positions[k], forces[k + 2], forces[k + 1])
            return step(state, 0)[1]  # a force acts from the next sample on

        def cost(positions: Any) -> Any:
            return ca.sumsqr(positions - r) + EFFORT * ca.sumsqr(ca.diff(forces[1:]))

        planned, run = ca.vertcat(known[1], known[0], y), ca.vertcat(known[1], known[0])
        for k in range(HORIZON):
            run = ca.vertcat(run, after(run, k))
        self.run = ca.Function("run", [u, known, r], [cost(run[2:]), run[2:]])
        defects = ca.vertcat(*(y[k] - after(planned, k) for k in range(HORIZON)))
        problem = {"x": ca.vertcat(u, y), "p": ca.vertcat(known, r), "f": cost(y), "g": defects}
        quiet = {"print_time": False, "ipopt": {"print_level": 0, "sb": "yes", "max_iter": 100}}
        self.solver = ca.nlpsol("mpc", "ipopt", problem, quiet)
        self.limits = np.r_[np.full(HORIZON, LIMIT), np.full(HORIZON, np.inf)]
        self.forces = np.zeros(HORIZON)

    def force(self, known: list[float], reference: np.ndarray) -> float:
        """The force to hold now so that the positions of the next samples follow the reference."""
        begins = np.clip(self.forces[:, None] + np.array(self.ADDED), -LIMIT, LIMIT)
        costs, runs = self.run(begins, known, reference)
        best = int(np.argmin(np.array(costs)))
        begin = np.concatenate([begins[:, best], np.array(runs)[:, best]])
        given = np.concatenate([known, reference])
        found = self.solver(x0=begin, p=given, lbx=-self.limits, ubx=self.limits, lbg=0, ubg=0)
        plan = np.array(found["x"])[:HORIZON, 0]
        self.forces = np.append(plan[1:], plan[-1])
        return float(plan[0])


def reference(steps: int) -> np.ndarray:
    """Slow swings, then ramps between levels, in m; nothing like the training data."""
    t = TS * np.arange(steps)
    swing = 0.04 * np.sin(2 * np.pi * 0.5 * t) + 0.02 * np.sin(2 * np.pi * 0.23 * t)
    levels = np.interp(t, [0, 3.0, 3.2, 4.0, 4.2, 9.0], [0, 0, 0.05, 0.05, -0.03, -0.03])
    return np.where(
        t < 3.0, swing, swing[np.searchsorted(t, 3.0) - 1] * np.exp(-(t - 3) / 0.1) + levels
    )


def controlled(step: Any, wanted: np.ndarray, seed: int = 1) -> Run:
    """The plant under a controller that measures its position."""
    controller, noise = Controller(step), NOISE * np.random.default_rng(seed).normal(size=STEPS)
    state, position, force, measured = (0.0, 0.0), [], [0.0, 0.0], [0.0]
    for k in range(STEPS):
        position.append(state[0])
        measured.append(state[0] + noise[k])
        known = [measured[-1], measured[-2], force[-1], force[-2]]
        force.append(controller.force(known, wanted[k + 1 : k + 1 + HORIZON]))
        state = advance(state, force[-1])
    return Run(np.array(position), np.array(force[2:]))


def main(picture: str | None = None) -> dict[str, float]:
    """Fit, control with both models, print the tracking errors (RMS, m), and draw if a file is named."""
    wanted, runs = reference(STEPS + HORIZON + 1), {}
    with tempfile.TemporaryDirectory() as folder:
        for name, model in fitted().items():
            runs[name] = controlled(exported(model, Path(folder) / name.split()[0]), wanted)
    errors = {
        name: float(np.sqrt(np.mean((run.position - wanted[:STEPS]) ** 2)))
        for name, run in runs.items()
    }
    for name, error in errors.items():
        print(f"{name:<22} tracking error {1000 * error:.3f} mm (RMS)")
    if picture:
        draw(runs, wanted[:STEPS], errors).savefig(picture, dpi=160)
    return errors


def draw(runs: dict[str, Run], wanted: np.ndarray, errors: dict[str, float]) -> Any:
    """The positions with the reference, what they miss it by, and the forces."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.0, 6.4), layout="constrained")
    above, middle, below = figure.subplots(3, 1, sharex=True)
    time = TS * np.arange(STEPS)
    above.plot(
        time,
        1000 * wanted,
        color="#000000",
        linestyle=(0, (4, 3)),
        linewidth=1.4,
        label="reference",
        zorder=3,
    )
    for (name, run), color in zip(runs.items(), ("#E69F00", "#0072B2"), strict=True):
        above.plot(time, 1000 * run.position, color=color, linewidth=1.4, label=name)
        label = f"{name}: {1000 * errors[name]:.2f} mm RMS"
        middle.plot(time, 1000 * (run.position - wanted), color=color, linewidth=1.2, label=label)
        below.step(time, run.force, color=color, linewidth=1.0, where="post", label=name)
    for axis, label in (
        (above, "position [mm]"),
        (middle, "tracking error [mm]"),
        (below, "force [N]"),
    ):
        axis.set_ylabel(label)
        axis.grid(alpha=0.25)
        axis.spines[["top", "right"]].set_visible(False)
        axis.legend(
            fontsize=8, frameon=False, ncols=3, loc="lower right", bbox_to_anchor=(1.0, 0.98)
        )
    below.set_xlabel("time [s]")
    return figure


if __name__ == "__main__":
    main(*sys.argv[1:2])
