"""The paper's static example: ten initialisations, additive against orthogonal, and the picture of docs/guide/theory.md.

    python examples/static_example.py [picture.png]

`y = 0.01 + u - 0.5 u² + 0.1 u³` is modelled as `θ1 u + θ3 u³` plus a network. Both structures fit the data
to 3e-6. The additive one, trained as is usual, from θ⁰ and with the weights, shares the odd part between physics and
network as its start pleases; the orthogonal one leaves to the network exactly what the physics cannot express.
"""

from __future__ import annotations

import sys

import numpy as np
from matplotlib.figure import Figure

import orthaug as oa

BLACK, BLUE, ORANGE = "#000000", "#0072B2", "#E69F00"
SEEDS = range(10)


def estimates(example: oa.synthetic.Example) -> dict[str, list[oa.Estimate]]:
    """Each structure from every initialisation."""
    return {
        structure.name: [
            oa.estimate(
                example.train,
                example.baseline,
                structure=structure,
                seed=seed,
                regularization="none",
            )
            for seed in SEEDS
        ]
        for structure in (oa.Additive(from_initial=True), oa.Orthogonal())
    }


def largest_rmse(example: oa.synthetic.Example, fits: list[oa.Estimate]) -> float:
    """On the test record."""
    return max(fit.model.predict(example.test).scores().rmse[0] for fit in fits)


def main(picture: str | None = None) -> dict[str, np.ndarray]:
    """Fit, print θ of every initialisation, and draw if a file is named."""
    example = oa.synthetic.static(data_set=1)
    fits = estimates(example)
    for name, group in fits.items():
        thetas = np.array([fit.theta for fit in group])
        spread = ", ".join(f"{t.min():.6f} … {t.max():.6f}" for t in thetas.T)
        print(
            f"{name:<11} θ = {spread}; true {example.theta}; test RMSE ≤ {largest_rmse(example, group):.1e}"
        )
    if picture:
        draw(example, fits).savefig(picture, dpi=160)
    return {name: np.array([fit.theta for fit in group]) for name, group in fits.items()}


def draw(example: oa.synthetic.Example, fits: dict[str, list[oa.Estimate]]) -> Figure:
    """Left: what the network learned, against what the physics leaves out. Right: the parameters."""
    figure = Figure(figsize=(9.0, 3.4), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(1.5, 1))
    u = np.linspace(-0.8, 0.8, 201)
    grid = oa.Record.from_arrays(u=u, y=np.zeros_like(u))
    for name, color in (("additive", ORANGE), ("orthogonal", BLUE)):
        for i, fit in enumerate(fits[name]):
            learner = fit.model.components(grid).trajectories[0].learner[:, 0]
            label = f"network, {name}, {len(SEEDS)} initialisations" if i == 0 else None
            left.plot(
                u, learner, color=color, linewidth=1.0 if name == "additive" else 2.2, label=label
            )
    left.plot(
        u,
        0.01 - 0.5 * u**2,
        color=BLACK,
        linestyle=(0, (4, 3)),
        linewidth=1.4,
        label="true, not in the physics",
    )
    left.set_xlabel("input u")
    left.set_ylabel("output of the network")
    left.legend(fontsize=8, frameon=False, loc="lower center")
    for row, (name, color) in enumerate((("additive", ORANGE), ("orthogonal", BLUE))):
        thetas = np.array([fit.theta for fit in fits[name]])
        right.scatter(thetas[:, 0], thetas[:, 1], s=28, color=color, label=name, zorder=2 + row)
    right.scatter(
        *example.baseline.initial,
        marker="x",
        s=60,
        color=BLACK,
        linewidth=1.2,
        label="θ⁰, start",
        zorder=5,
    )
    right.scatter(
        *example.theta, marker="+", s=160, color=BLACK, linewidth=1.6, label="true", zorder=5
    )
    right.set_xlabel("estimated θ1")
    right.set_ylabel("estimated θ3")
    right.legend(fontsize=8, frameon=False)
    for axis in (left, right):
        axis.grid(alpha=0.25)
        axis.spines[["top", "right"]].set_visible(False)
    return figure


if __name__ == "__main__":
    main(*sys.argv[1:2])
