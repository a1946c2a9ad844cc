"""Shared parts of the paper's studies: entries of `orthaug reproduce`, pipelines, records.

An entry has its runs, its figures, and its numbers beside those of the paper and of its scripts.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from orthaug.data.record import Record
from orthaug.fitting.estimation import estimate
from orthaug.fitting.lagged_estimate import LaggedEstimate
from orthaug.fitting.solvers.adam_lbfgs import AdamLBFGS
from orthaug.fitting.solvers.levenberg_marquardt import LevenbergMarquardt
from orthaug.fitting.structures import Additive, Orthogonal, Structure
from orthaug.inference.measures import Samples
from orthaug.studies import published
from orthaug.studies.study import Study
from orthaug.studies.synthetic import NOISE_30_DB, Example, static

if TYPE_CHECKING:
    import pandas as pd

    from orthaug.studies.references import Spread

# Okabe-Ito, distinct for every reader; each structure keeps its colour and marker in all figures
COLOURS = {
    "orthogonal": "#0072B2",
    "additive": "#E69F00",
    "additive-initial": "#56B4E9",
    "uniform": "#009E73",
    "truth": "#000000",
    "orthogonal-penalty": "#CC79A7",
    "baseline-penalty": "#D55E00",
}
MARKERS = {
    "orthogonal": "o",
    "additive": "s",
    "additive-initial": "P",
    "uniform": "^",
    "orthogonal-penalty": "D",
    "baseline-penalty": "v",
}
LABELS = {
    "orthogonal": "orthogonal",
    "additive": "additive",
    "additive-initial": "additive from θ⁰",
    "uniform": "orthogonal, uniform measure",
    "orthogonal-penalty": "orthogonal penalty",
    "baseline-penalty": "baseline penalty",
}
ORTHOGONAL = Orthogonal()
STRUCTURES = {"orthogonal": ORTHOGONAL, "additive": Additive()}
PIPELINES = {
    "static": (500, 1000),
    "mass_spring_damper": (2500, 500),
}  # the paper's Adam and L-BFGS iterations
LARGEST_TRAINED = {
    "ours": 65_536,
    "paper": 16_384,
    "scripts": 4096,
}  # samples up to which a learner is trained: the run is to end
_NODES = np.polynomial.legendre.leggauss(64)
UNIFORM = Samples({"u[k]": 0.6 * _NODES[0]}, weights=_NODES[1], name="uniform")
"""Uniform on [−0.6, 0.6]: `measures.Uniform` with fewer nodes, which changes no digit shown and is
quicker.
"""


class Finding(NamedTuple):
    """A quantity, with the paper's number and those of its scripts.

    Each is counted once.
    """

    quantity: str
    ours: str
    verdict: str
    """Meaning of the numbers, in words."""
    published: str = ""
    scripts: str = ""
    as_published: bool | None = None
    """True if ours agrees with the paper; None where the paper has nothing to compare with."""
    as_scripts: bool | None = None
    """True if ours agrees with the scripts' runs; None where they have nothing to compare with."""

    @property
    def beyond(self) -> bool:
        """True if there is nothing to compare with.

        Such a row is neither met nor missed.
        """
        return self.as_published is None and self.as_scripts is None


class Counts(NamedTuple):
    """Numbers of comparisons that are met, and of all.

    They are counted apart by what ours is compared with; rows beyond the paper apart from both.
    """

    published_met: int
    published: int
    scripts_met: int
    scripts: int
    beyond: int

    @classmethod
    def of(cls, findings: Iterable[Finding]) -> Counts:
        rows = list(findings)
        paper = [row.as_published for row in rows if row.as_published is not None]
        scripts = [row.as_scripts for row in rows if row.as_scripts is not None]
        return cls(
            sum(paper), len(paper), sum(scripts), len(scripts), sum(row.beyond for row in rows)
        )


class Drawing(NamedTuple):
    """A figure, one sentence on what it shows, and sentences on how to read it."""

    figure: Figure
    shows: str
    reading: str = ""


@dataclass(frozen=True)
class Reproduction:
    """One entry of `orthaug reproduce`.

    `study(pipeline, small)` declares the runs: `pipeline` is one of `reproduction.PIPELINES`;
    `small` for the reduced size of the tests. `figures(table)` draws, by file name;
    `findings(table)` compares. `text` says what is run.
    """

    name: str
    title: str
    text: str
    study: Callable[[str, bool], Study]
    figures: Callable[[pd.DataFrame], Mapping[str, Drawing]]
    findings: Callable[[pd.DataFrame], list[Finding]]


def train(
    example: Example,
    which: str,
    pipeline: str,
    *,
    structure: Structure = ORTHOGONAL,
    seed: int = 0,
    iterations: int = 300,
    regularization: str = "none",
) -> LaggedEstimate:
    """Return one fit of an example by a pipeline; `which` names the paper's iterations.

    Args:
        pipeline: "ours", Levenberg-Marquardt with `iterations` and `regularization`; "paper", Adam
            and L-BFGS on normalised data; "scripts", the published scripts' own.
    """
    if pipeline == "scripts":
        return published.train(example, structure, PIPELINES[which], seed)
    solver = (
        AdamLBFGS(*PIPELINES[which])
        if pipeline == "paper"
        else LevenbergMarquardt(iterations, longest=iterations)
    )
    options: dict[str, Any] = {
        "structure": structure,
        "solver": solver,
        "regularization": regularization,
    }
    return estimate(example.train, example.baseline, seed=seed, **options)


def draw_record(
    data_set: int, *, samples: int = 1024, draw: int = 0, noise: bool = False
) -> Example:
    """Return the static example's training record drawn anew.

    `draw` 0 is the paper's own, as `synthetic.static` has it.
    """
    example = static(data_set, noise=noise, samples=samples)
    if not draw:
        return example
    rng = np.random.default_rng([10, draw])
    half = 0.3 * rng.standard_normal(samples // 2 if data_set == 1 else samples)
    u = np.concatenate([half, -half]) if data_set == 1 else half - (0.01 if data_set == 3 else 0.0)
    y = (
        0.01
        + u
        - 0.5 * u**2
        + 0.1 * u**3
        + (rng.normal(0.0, NOISE_30_DB, len(u)) if noise else 0.0)
    )
    return Example(Record.from_arrays(u, y), example.test, example.baseline, example.theta)


def rows_of(table: pd.DataFrame, **values: object) -> pd.DataFrame:
    """Return the rows of a table with these values in these columns, in the table's order."""
    for column, value in values.items():
        table = table.loc[table[column] == value]
    return table


def mean_errors(rows: pd.DataFrame) -> pd.DataFrame:
    """Return the mean error of θ per number of samples."""
    return rows.groupby("samples").theta_error.mean().reset_index()


def slope(samples: Any, errors: Any) -> float:
    """Return the exponent p of errors ∝ Nᵖ, by least squares over logarithms."""
    return float(
        np.polyfit(
            np.log(np.asarray(samples, dtype=float)), np.log(np.asarray(errors, dtype=float)), 1
        )[0]
    )


def panels(
    count: int,
    *,
    width: float = 7.0,
    height: float = 3.0,
    sharex: bool = False,
    sharey: bool = False,
    rows: bool = False,
) -> tuple[Figure, list[Axes]]:
    """Return axes side by side at column width, or one above the other."""
    figure = Figure(figsize=(width, height), layout="constrained")
    shape = (count, 1) if rows else (1, count)
    axes = list(np.atleast_1d(figure.subplots(*shape, sharex=sharex, sharey=sharey)))
    for axis in axes:
        axis.grid(alpha=0.25)
        axis.spines[["top", "right"]].set_visible(False)
        axis.tick_params(which="both", labelsize=8)
    return figure, axes


def legend(figure: Figure, axes: Axes | Iterable[Axes], ncols: int = 4) -> None:
    """Draw one legend for all panels, above them."""
    unique = {}
    for axis in [axes] if isinstance(axes, Axes) else axes:
        handles, labels = axis.get_legend_handles_labels()
        unique.update(dict(zip(labels, handles, strict=True)))
    ncols = min(ncols, len(unique))
    figure.legend(
        unique.values(),
        unique.keys(),
        loc="outside upper center",
        ncols=ncols,
        frameon=False,
        fontsize=8,
    )


def against_samples(axis: Axes, title: str) -> None:
    """Make both axes logarithmic, over N."""
    axis.set_xscale("log")
    axis.set_yscale("log")
    axis.set_xlabel("samples N")
    axis.set_title(title, fontsize=9)


def extremes(rows: pd.DataFrame, by: str, column: str) -> pd.DataFrame:
    """Return median, smallest and largest value of a column, per value of `by`."""
    return rows.groupby(by)[column].agg(["median", "min", "max"]).reset_index()


def whiskers(
    axis: Axes, x: Any, of: pd.DataFrame, name: str, *, label: str = "", **style: Any
) -> None:
    """Draw medians with bars from the smallest to the largest value.

    A logarithmic axis shows such bars whole.
    """
    reach = np.stack([of["median"] - of["min"], of["max"] - of["median"]])
    style = {
        "color": COLOURS[name],
        "marker": MARKERS[name],
        "markersize": 4.0,
        "linewidth": 1.0,
        "capsize": 2.5,
    } | style
    axis.errorbar(x, of["median"], reach, label=label or LABELS[name], **style)


def scripts_bars(axis: Axes, x: Any, spreads: Sequence[Spread], name: str, **style: Any) -> None:
    """Draw the results of the scripts: a cross at each mean, a bar over all runs.

    The bar goes from the smallest to the largest run.
    """
    low, mean, high = (
        np.array([getattr(spread, part) for spread in spreads]) for part in ("low", "mean", "high")
    )
    style = {
        "marker": "x",
        "markersize": 5.0,
        "linewidth": 0.0,
        "elinewidth": 0.8,
        "capsize": 2.5,
    } | style
    style["label"] = f"scripts, {LABELS[name]}"
    axis.errorbar(
        x, mean, np.stack([mean - low, high - mean]), color=COLOURS[name], alpha=0.6, **style
    )


def signed_text(exponent: float) -> str:
    """Return two decimals with a true minus."""
    return f"{exponent:.2f}".replace("-", "−")


def agreement(values: object) -> str:
    """Return a text on the largest difference between starts, one row of values each."""
    apart = float(np.ptp(np.asarray(values, dtype=float), axis=0).max())
    return f"starts agree within {apart:.1g}" if apart else "the same number for every start"


def span(values: object) -> str:
    """Return `mean (smallest … largest)` in three digits.

    It is one number where they agree in all of them.
    """
    values = np.asarray(values, dtype=float)
    if np.ptp(values) <= 1e-6 * abs(values.mean()):
        return f"{values.mean():.5g}"
    return f"{values.mean():.3g} ({values.min():.3g} … {values.max():.3g})"
