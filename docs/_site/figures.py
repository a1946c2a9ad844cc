"""The pictures of the documents, each drawn from what the code of its own page computes.

    python docs/_site/figures.py                               all of them: some minutes
    python docs/_site/figures.py tutorials/memory observer     those of some pages

The blocks of a page run as tests/documents.py runs them, in a folder of their own; a function here draws from the names
that they leave behind. Pictures of the page in the browser come from Chromium. All are written to docs/figures.
"""

from __future__ import annotations

import contextlib
import io
import os
import shutil
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch
from PIL import Image

ROOT = Path(__file__).resolve().parents[2]
FIGURES = ROOT / "docs" / "figures"
sys.path[:0] = [str(ROOT / "tests"), str(ROOT / "examples")]
BLACK, GREY, BLUE, ORANGE, GREEN = "#000000", "#B0B0B0", "#0072B2", "#E69F00", "#009E73"
STYLE = {
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.alpha": 0.25,
    "font.size": 9,
    "axes.titlesize": 10,
    "axes.titlelocation": "left",
    "legend.frameon": False,
    "legend.fontsize": 8,
    "figure.constrained_layout.use": True,
    "figure.constrained_layout.w_pad": 0.1,
    "figure.constrained_layout.h_pad": 0.08,
}
Names = dict[str, Any]
Drawing = Callable[[Names], Figure | None]
PICTURES: dict[str, tuple[int | None, bool, Drawing]] = {}
"""By page: how many of its blocks run (None for all), whether commands run too, and what draws its picture."""


def picture(page: str, *, blocks: int | None = None, commands: bool = False) -> Callable:
    def entered(draw: Drawing) -> Drawing:
        PICTURES[page] = blocks, commands, draw
        return draw

    return entered


def file_of(page: str) -> Path:
    return FIGURES / f"{page.rpartition('/')[2].lower()}.png"


def names_of(page: str, count: int | None, commands: bool) -> Names:
    """Run the blocks of a page in the working folder, and return what they define."""
    from documents import Page

    path = ROOT / "README.md" if page == "README" else ROOT / "docs" / f"{page}.md"
    if not path.is_file():
        return {}
    run = Page(path)
    for block in run.blocks[:count]:
        wanted = block.language == "python" or commands
        if wanted and block.not_run is None:
            with contextlib.redirect_stdout(io.StringIO()):
                run.printed(block)
    return run.names


def names_of_blocks(page: str) -> list:
    from documents import blocks

    return list(blocks((ROOT / f"{page}.md").read_text(encoding="utf-8")))


def save(figure: Figure, path: Path) -> None:
    """Write a PNG of few colours, which is small and looks the same."""
    made = io.BytesIO()
    figure.savefig(made, dpi=120, facecolor="white")
    shrink(Image.open(made), path)
    plt.close(figure)


def shrink(image: Image.Image, path: Path, colours: int = 64) -> None:
    few = image.convert("RGB").quantize(colours, dither=Image.Dither.NONE)
    few.save(path, optimize=True)


def two(width: float = 9.0, height: float = 3.0, **ratios: Any) -> tuple[Figure, Any]:
    return plt.subplots(1, 2, figsize=(width, height), **ratios)


def in_per_cent(
    axis: Axes, rows: list[tuple[str, list[float], list[float], str]], names: list[str]
):
    """Draw intervals of parameters of several fits about the true values, in per cent of these."""
    for i, (label, values, halves, colour) in enumerate(rows):
        place = np.arange(len(names))[::-1] - 0.28 * (i - (len(rows) - 1) / 2)
        axis.errorbar(
            values, place, xerr=halves, fmt="o", ms=4, capsize=3, color=colour, label=label
        )
    axis.axvline(0, color=BLACK, linewidth=0.9)
    axis.set_yticks(np.arange(len(names))[::-1], names)
    axis.set_ylim(-0.6, len(names) - 0.4)
    axis.set_xlabel("distance from the truth [%]")
    axis.legend()


@picture("README", blocks=0)
def readme(names: Names) -> Figure:
    import given

    import orthaug as oa
    from orthaug.reports.learned_part import learned_of

    given.give(["friction"], names)
    (spec,) = (b for b in names_of_blocks("README") if b.title == "spec.toml")
    Path("spec.toml").write_text(spec.text, encoding="utf-8")
    fit = oa.fit_spec("spec.toml").fit
    channels = {"inputs": ["force"], "outputs": ["position"], "sampling_time": 0.02}
    test = oa.read_record("run2.csv", **channels)
    alone = fit.physics_alone.model.simulate(test).trajectories[0].model
    run = fit.model.simulate(test).trajectories[0]
    figure, (left, right) = two(width_ratios=(1.7, 1))
    time, shown = np.arange(len(run.model)) * 0.02, slice(0, 200)
    left.plot(time[shown], 1e3 * run.measured[shown, 0], color=GREY, lw=4, label="measured")
    left.plot(time[shown], 1e3 * alone[shown, 0], color=ORANGE, lw=1.2, label="physics alone")
    left.plot(
        time[shown], 1e3 * run.model[shown, 0], color=BLUE, lw=1.2, label="physics and learner"
    )
    left.set(
        xlabel="time [s]",
        ylabel="position [mm]",
        title="free run over a record that was not fitted",
    )
    low, high = left.get_ylim()
    left.set_ylim(low, high + 0.2 * (high - low))
    left.legend(ncols=3, loc="upper left")
    part = learned_of(fit, fit.problem.record)
    curve = part.curve("v")
    v = curve.along[curve.inside]
    m, c = (fit.parameters.loc[name, "value"] for name in ("m", "c"))
    right.plot(
        v,
        2 * v + 4 * np.tanh(v / 0.05),
        color=BLACK,
        ls=(0, (4, 3)),
        lw=1.3,
        label="true",
        zorder=3,
    )
    right.plot(v, c * v - m * curve.learned[curve.inside, 0], color=BLUE, lw=2.4, label="found")
    right.plot(v, c * v, color=ORANGE, lw=1.2, label="nearest damper")
    right.set(xlabel="velocity [m/s]", ylabel="damping and friction [N]", title="what was learned")
    right.legend()
    return figure


def fitted_example(name: str, part: str) -> tuple[Any, Any, np.ndarray | None]:
    """Fit a spec of examples/; return it with the free run of a part and that of physics alone."""
    import generate

    import orthaug as oa

    if not (ROOT / "examples" / "generated").is_dir():
        generate.write(ROOT / "examples" / "generated")
    fitted = oa.fit_spec(ROOT / "examples" / f"{name}.toml")
    part = f"tests.{part}"
    run = fitted.responses[part][1].trajectories[0]
    alone = fitted.alone.get(part)
    return fitted, run, None if alone is None else alone[1].trajectories[0].model


def draw_runs(axis: Axes, run: Any, alone: np.ndarray | None, step: float, shown: slice) -> None:
    """Draw the first output of free runs over its measurements, with a legend above them."""
    time = np.arange(len(run.model))[shown] * step
    axis.plot(time, run.measured[shown, 0], color=GREY, lw=4, label="measured")
    if alone is not None:
        axis.plot(time, alone[shown, 0], color=ORANGE, lw=1.2, label="physics alone")
    axis.plot(time, run.model[shown, 0], color=BLUE, lw=1.2, label="physics and learner")
    axis.set(xlabel="time [s]", title="free run over a record that was not fitted")
    low, high = axis.get_ylim()
    axis.set_ylim(low, high + 0.25 * (high - low))
    axis.legend(ncols=3, loc="upper left")


def draw_learned(axis: Axes, fit: Any, feature: str, scale: float = 1.0, output: int = 0) -> None:
    """Draw the learned part over one variable within the data, times a factor."""
    from orthaug.reports.learned_part import learned_of

    curve = learned_of(fit, fit.problem.record).curve(feature)
    inside = curve.inside
    axis.plot(curve.along[inside], scale * curve.learned[inside, output], color=BLUE, lw=2.2)
    axis.axhline(0, color=BLACK, lw=0.6)


@picture("gallery/dc_motor")
def dc_motor(names: Names) -> Figure:
    fitted, run, alone = fitted_example("dc_motor", "other_steps")
    figure, (left, right) = two(width_ratios=(1.7, 1))
    draw_runs(left, run, alone, 0.002, slice(0, 600))
    left.set_ylabel("speed [rad/s]")
    inertia = fitted.fit.parameters.loc["J", "value"]
    draw_learned(right, fitted.fit, "w", -1e3 * inertia)
    right.set(xlabel="speed [rad/s]", ylabel="torque [mN m]", title="friction beside the damper")
    return figure


@picture("gallery/two_link_arm")
def two_link_arm(names: Names) -> Figure:
    _, run, alone = fitted_example("two_link_arm", "other_steps")
    figure, axes = two()
    time, shown = np.arange(len(run.model)) * 0.02, slice(0, 300)
    for i, axis in enumerate(axes):
        axis.plot(time[shown], run.measured[shown, i], color=GREY, lw=4, label="measured")
        if alone is not None:
            axis.plot(time[shown], alone[shown, i], color=ORANGE, lw=1.2, label="physics alone")
        axis.plot(time[shown], run.model[shown, i], color=BLUE, lw=1.2, label="with learner")
        axis.set(xlabel="time [s]", ylabel="angle [rad]", title=("shoulder", "elbow")[i])
    axes[0].legend()
    return figure


@picture("gallery/silverbox")
def silverbox(names: Names) -> Figure:
    fitted, run, alone = fitted_example("silverbox_motion", "arrow")
    figure, (left, right) = two(width_ratios=(1.7, 1))
    far = np.arange(len(run.model)) * 0.001638468
    left.plot(far[::7], run.measured[::7, 0], color=GREY, lw=0.8, label="measured")
    left.plot(far[::7], (run.measured - run.model)[::7, 0], color=BLUE, lw=0.8, label="error")
    left.set(xlabel="time [s]", ylabel="voltage [V]", title="free run over the arrow")
    left.legend(loc="upper left")
    value = fitted.fit.parameters["value"]
    x = np.linspace(run.measured.min(), run.measured.max(), 100)
    spring = value["k1"] * x + value["k2"] * x**2 + value["k3"] * x**3
    right.plot(x, spring / value["b"], color=BLUE, lw=2.2, label="spring of the equation")
    right.plot(x, value["k1"] * x / value["b"], color=ORANGE, lw=1.2, label="its linear part")
    right.set(xlabel="V2 [V]", ylabel="force, as V1 [V]", title="a spring that hardens")
    right.legend()
    return figure


@picture("gallery/cascaded_tanks")
def cascaded_tanks(names: Names) -> Figure:
    _, run, alone = fitted_example("cascaded_tanks_motion", "official")
    figure, axis = plt.subplots(figsize=(9.0, 3.0))
    draw_runs(axis, run, alone, 4.0, slice(None))
    axis.set(ylabel="level [V]")
    return figure


@picture("gallery/mr_damper")
def mr_damper(names: Names) -> Figure:
    fitted, run, alone = fitted_example("mr_damper_motion", "rest")
    figure, (left, right) = two(width_ratios=(1.7, 1))
    draw_runs(left, run, alone, 0.005, slice(0, 400))
    left.set_ylabel("force [N]")
    (part,) = [part for part in fitted.job.parts if part.name == "tests.rest"]
    velocity = part.record.experiments[0].inputs[-len(run.model) :, 0]
    right.plot(velocity[:400], run.measured[:400, 0], color=GREY, lw=3, label="measured")
    right.plot(velocity[:400], run.model[:400, 0], color=BLUE, lw=1, label="model")
    right.set(xlabel="velocity [cm/s]", ylabel="force [N]", title="the loop")
    right.legend()
    return figure


@picture("tutorials/own_csv", blocks=1)
def own_csv(names: Names) -> Figure:
    time = np.arange(500) / 50
    position = names["position"].copy()
    position[[120, 121]] = np.nan
    figure, (left, right) = two(width_ratios=(1.6, 1))
    left.plot(time, position, color=BLUE, lw=1)
    left.plot(time[300], 3.0, "o", mfc="none", ms=11, color=ORANGE, label="a wrong sample")
    left.set(xlabel="time [s]", ylabel="position [m]", title="run1.csv as it comes")
    left.legend()
    near = slice(105, 140)
    right.plot(time[near], position[near], "o-", color=BLUE, ms=3.5, lw=1)
    right.axvspan(
        120 / 50 - 0.01, 121 / 50 + 0.01, color=ORANGE, alpha=0.35, label="two empty cells"
    )
    right.set(xlabel="time [s]", title="about the gap")
    right.legend()
    return figure


@picture("tutorials/sensor_noise")
def sensor_noise(names: Names) -> Figure:
    figure, (left, right) = two(width_ratios=(1.4, 1))
    shown = slice(1000, 1100)
    time = np.arange(4000)[shown] * names["Ts"]
    left.plot(time, 1e3 * names["measured"][shown], ".", color=GREY, ms=5, label="measured")
    left.plot(time, 1e3 * names["position"][shown], color=BLACK, lw=1, label="true")
    run = names["free_run"].model.simulate(names["record"]).trajectories[0].model
    offset = 4000 - len(run)
    place = slice(1000 - offset, 1100 - offset)
    left.plot(time, 1e3 * run[place, 0], "--", color=BLUE, lw=1.4, label="free run")
    left.set(xlabel="time [s]", ylabel="position [mm]")
    left.legend(ncols=3)
    rows = []
    true = np.array([1.0, 100.0, 1000.0])
    for label, key, colour in (
        ("one step ahead", "one_step", ORANGE),
        ("free run", "free_run", BLUE),
    ):
        found = names[key].physical(names["physics"])
        values = 100 * (np.asarray(found.value) / true - 1)
        rows.append((label, values, 196 * np.asarray(found.std) / true, colour))
    in_per_cent(right, rows, ["m", "c", "ks"])
    right.set_title("parameters, 95 % intervals")
    return figure


@picture("tutorials/physical_parameters", commands=True)
def physical_parameters(names: Names) -> Figure:
    result = names["result"]
    figure, (left, right) = two(width_ratios=(1, 1.2))
    true = {"m": 1.0, "c": 100.0, "ks": 1000.0}
    found = {one["name"]: one for one in result["physical_parameters"]}
    values = [100 * (found[name]["value"] / true[name] - 1) for name in true]
    halves = [100 * np.ptp(found[name]["ci95"]) / 2 / true[name] for name in true]
    in_per_cent(left, [("estimate, 95 % interval", values, halves, BLUE)], list(true))
    thetas = list(result["sensitivities"]["ks"])
    for i, name in enumerate(true):
        moved = [result["sensitivities"][name][theta] for theta in thetas]
        right.bar(
            np.arange(len(thetas)) + 0.27 * (i - 1),
            moved,
            0.25,
            label=name,
            color=(BLUE, ORANGE, GREEN)[i],
        )
    right.axhline(0, color=BLACK, lw=0.9)
    right.set_xticks(range(len(thetas)), thetas)
    right.set_ylabel("moves by [%]")
    right.set_title("where a θ moves by one per cent")
    right.legend()
    return figure


@picture("tutorials/learner_inputs")
def learner_inputs(names: Names) -> Figure:
    figure, (left, right) = two(width_ratios=(1, 1.2))
    fits = [("physics alone", names["alone"]), ("sees all lags", names["everything"])]
    fits += [(f"sees the velocity, start {i + 1}", fit) for i, fit in enumerate(names["fits"])]
    for i, (_, fit) in enumerate(fits):
        found = fit.physical(names["physics"])
        place = found.names.index("ks")
        colour = ORANGE if i < 2 else BLUE
        left.errorbar(
            found.value[place], -i, xerr=1.96 * found.std[place], fmt="o", capsize=4, color=colour
        )
    left.axvline(1000, color=BLACK, lw=0.9)
    left.annotate("true", (1000, 0.35), (4, 0), textcoords="offset points", fontsize=8)
    left.set_yticks([0, -1, -2, -3], [label for label, _ in fits])
    left.set(xlabel="stiffness [N/m]", ylim=(-3.6, 0.8), title="stiffness, 95 % intervals")
    names["fits"][0].plot.learned(ax=right)
    right.set_title("what the learner of the velocity found")
    right.set(xlabel="position[k-1] − position[k-2] [m]", ylabel="learned part of position [m]")
    return figure


@picture("tutorials/measure")
def measure(names: Names) -> Figure:
    import orthaug as oa

    u = np.linspace(-0.8, 0.8, 201)
    fit = names["fit"]
    grid = oa.Record.from_arrays(u=u, y=np.zeros_like(u))
    whole = fit.model.predict(grid).trajectories[0].model[:, 0]
    figure, (left, right) = two(width_ratios=(1, 1.3))
    rows = np.concatenate([one.inputs[:, 0] for one in names["example"].train.experiments])
    left.hist(rows, 30, color=GREY)
    left.set(xlabel="input u", ylabel="training rows", title="where the data are: off centre")
    right.plot(
        u,
        0.01 - 0.5 * u**2,
        color=BLACK,
        ls=(0, (4, 3)),
        label="true, not in the physics",
        zorder=3,
    )
    for theta, label, colour in (
        (fit.theta, "left to the learner by the training rows", ORANGE),
        (names["split"].theta, "by a box about 0", BLUE),
    ):
        right.plot(u, whole - theta[0] * u - theta[1] * u**3, color=colour, lw=1.6, label=label)
    right.set(
        xlabel="input u", ylabel="output", title="one fitted function, split over two measures"
    )
    right.legend(loc="lower center")
    return figure


@picture("tutorials/several_outputs")
def several_outputs(names: Names) -> Figure:
    figure, (left, right) = two(width_ratios=(1.4, 1))
    run = names["fit"].model.simulate(names["record"]).trajectories[0]
    time, shown = np.arange(len(run.model)) * names["Ts"], slice(0, 240)
    for i, (name, colour) in enumerate((("x1", BLUE), ("x2", GREEN))):
        left.plot(
            time[shown], run.measured[shown, i], color=GREY, lw=3, label="measured" if i else None
        )
        left.plot(time[shown], run.model[shown, i], color=colour, lw=1, label=f"free run of {name}")
    left.set(xlabel="time [s]", ylabel="position [m]", ylim=(-0.35, 0.55))
    left.legend(ncols=3, loc="upper right")
    names["fit"].plot.learned(output="x1", ax=right)
    right.set_title("the spring that hardens")
    return figure


@picture("tutorials/motion")
def motion(names: Names) -> Figure:
    figure, (left, right) = two(width_ratios=(1.5, 1))
    names["fit"].plot.free_run(ax=left)
    left.set_title("free run")
    names["fit"].plot.learned(ax=right)
    right.set_title("what the learner found")
    return figure


@picture("tutorials/memory")
def memory(names: Names) -> Figure:
    figure, (left, right) = two(width_ratios=(1.7, 1))
    shown, Ts = slice(200, 500), names["Ts"]
    runs = {
        label: one.model.simulate(names["test"]).trajectories[0]
        for label, one in (
            ("physics alone", names["fit"].physics_alone),
            ("with a state", names["fit"]),
        )
    }
    time = np.arange(len(names["test"].experiments[0].outputs)) * Ts
    colours = (ORANGE, BLUE)
    for i, (label, run) in enumerate(runs.items()):
        if i == 0:
            left.plot(time[shown], run.measured[shown, 0], color=GREY, lw=4, label="measured")
        left.plot(time[shown], run.model[shown, 0], color=colours[i], lw=1.2, label=label)
    left.set(xlabel="time [s]", ylabel="position [m]", title="free run over the test record")
    left.legend(ncols=3)
    for i, (label, run) in enumerate(runs.items()):
        right.plot(time[shown], run.errors[shown, 0], color=colours[i], lw=1, label=label)
    right.set(xlabel="time [s]", title="measured less model [m]")
    return figure


@picture("tutorials/closed_loop")
def closed_loop(names: Names) -> Figure:
    figure, axis = plt.subplots(figsize=(9, 3))
    run = names["fit"].model.simulate(names["test"]).trajectories[0]
    time = np.arange(len(run.model)) * names["Ts"]
    reference = names["test"].experiments[0].inputs[:, 0][-len(time) :]
    axis.plot(time, reference, color=BLACK, lw=0.8, ls=":", label="reference")
    axis.plot(time, run.measured[:, 0], color=GREY, lw=4, label="measured")
    axis.plot(time, run.model[:, 0], color=BLUE, lw=1.2, label="simulated loop")
    axis.set(
        xlabel="time [s]", ylabel="angle [rad]", title="the loop simulated from its reference alone"
    )
    axis.legend(ncols=3)
    return figure


@picture("tutorials/terms")
def terms(names: Names) -> Figure:
    figure, axis = plt.subplots(figsize=(7, 3))
    names["fit"].plot.learned("y[k-1]", ax=axis)
    axis.set_title("the network over y[k-1]: a cubic")
    return figure


@picture("tutorials/controller", commands=True)
def controller(names: Names) -> Figure:
    figure, (left, right) = two()
    solution = names["solution"]
    steps = np.arange(12)
    left.step(steps, solution.value(names["inputs"]), where="post", color=ORANGE)
    left.axhline(2, color=BLACK, lw=0.8, ls=":")
    left.set(xlabel="sample", ylabel="valve", title="the planned input, limited to 2")
    right.plot(
        steps, [float(solution.value(level)) for level in names["levels"]], "o-", color=BLUE, ms=4
    )
    right.axhline(1, color=BLACK, lw=0.8, ls=":")
    right.set(xlabel="sample", ylabel="level", title="the level that follows, wanted at 1")
    return figure


def box(
    axis: Axes,
    x: float,
    y: float,
    text: str,
    *,
    w: float,
    h: float,
    colour: str = BLUE,
    size: float = 9,
) -> None:
    axis.add_patch(
        FancyBboxPatch(
            (x, y),
            w,
            h,
            boxstyle="round,pad=0.0,rounding_size=0.06",
            fc=colour + "1A",
            ec=colour,
            lw=1.2,
        )
    )
    axis.text(x + w / 2, y + h / 2, text, ha="center", va="center", fontsize=size, linespacing=1.35)


def arrow(
    axis: Axes, begin: tuple[float, float], end: tuple[float, float], bend: float = 0.0
) -> None:
    axis.add_patch(
        FancyArrowPatch(
            begin,
            end,
            arrowstyle="-|>",
            mutation_scale=11,
            lw=1.1,
            color="#555555",
            connectionstyle=f"arc3,rad={bend}",
        )
    )


def canvas(width: float, height: float) -> tuple[Figure, Axes]:
    figure = plt.figure(figsize=(width, height), layout="none")
    axis = figure.add_axes((0, 0, 1, 1))
    axis.set(xlim=(0, width), ylim=(0, height))
    axis.axis("off")
    return figure, axis


@picture("tutorials/cluster")
def cluster(names: Names) -> Figure:
    figure, axis = canvas(9, 2.6)
    for i, name in enumerate(("a.parquet", "b.parquet", "…")):
        y = 1.75 - 0.75 * i
        box(axis, 0.2, y, f"{name}", w=1.5, h=0.55, colour=ORANGE)
        arrow(axis, (1.75, y + 0.27), (2.55, y + 0.27))
        box(axis, 2.6, y, "worker: rows, their model,\nsums over them", w=2.1, h=0.55, size=8)
        arrow(axis, (4.75, y + 0.27), (5.75, 1.27), bend=0)
    box(
        axis,
        5.8,
        0.85,
        "sum of the sums,\nof one size however\nmany rows there are",
        w=1.6,
        h=0.85,
        size=8,
    )
    arrow(axis, (7.45, 1.27), (7.95, 1.27))
    box(axis, 8.0, 0.95, "one step\nof training", w=0.85, h=0.65, colour=GREEN, size=8)
    return figure


@picture("observer")
def observer(names: Names) -> Figure:
    from given import measured

    import orthaug as oa

    u, y = measured()
    y[150:200] = np.nan
    record = oa.Record.from_arrays(
        u, y, sampling_time=0.01, inputs=["force"], outputs=["position"], missing="keep"
    )
    whole = names["observer"].run(record).to_frame()
    true = measured()[1][-len(whole) :][100:260]
    frame = whole.iloc[100:260]
    time = frame["time"].to_numpy()
    down = np.isnan(frame["position"].to_numpy())
    figure, (above, below) = plt.subplots(
        2, 1, figsize=(9, 3.8), sharex=True, height_ratios=(1.3, 1)
    )
    above.plot(time, true, color=GREY, lw=3, label="true")
    above.plot(time, frame["position_model"], color=BLUE, lw=1.2, label="estimate")
    above.set(ylabel="position")
    half = (frame["position_model_high"] - frame["position_model_low"]).to_numpy() / 2
    below.fill_between(time, -half, half, color=BLUE, alpha=0.25, lw=0, label="95 % band")
    below.plot(time, frame["position_model"] - true, color=BLUE, lw=1, label="estimate less true")
    below.set(xlabel="time [s]", ylabel="error")
    for axis in (above, below):
        axis.axvspan(time[down][0], time[down][-1], color=ORANGE, alpha=0.13, label="sensor down")
        axis.legend(ncols=3, loc="lower left")
    return figure


@picture("linear")
def linear(names: Names) -> Figure:
    figure, axis = plt.subplots(figsize=(8, 3))
    names["fit"].plot.bode(ax=axis)
    axis.set_title("gain from force to position at rest, with its 95 % band")
    return figure


@picture("explain")
def explain(names: Names) -> Figure:
    import orthaug as oa

    record, baseline = names["record"], names["baseline"]
    before = oa.estimate(record, baseline, learner=oa.MLP(hidden=(4,), inputs=("position[k-1]",)))
    figure, (left, right) = two()
    before.plot.learned(ax=left)
    left.set_title("beside the linear physics: a cubic")
    completed = oa.explain(before).physics
    after = oa.estimate(record, completed, learner=oa.MLP(hidden=(4,), inputs=("position[k-1]",)))
    after.plot.learned(ax=right)
    right.set(title="beside the physics with that term: nothing", ylabel="")
    right.set_ylim(*left.get_ylim())
    return figure


@picture("selection", blocks=0)
def selection(names: Names) -> Figure:
    from documents import Page

    import orthaug as oa

    run = Page(ROOT / "docs" / "tutorials" / "terms.md")
    with contextlib.redirect_stdout(io.StringIO()):
        run.printed(run.blocks[0])
    chosen = oa.select(
        run.names["record"],
        run.names["baseline"],
        learner=oa.Terms(degree=3),
        lags=oa.Lags(2, 1, 1),
        most=4,
    )
    table = chosen.table
    rows = table[table["stage"] == "terms"]
    figure, axis = plt.subplots(figsize=(7, 3))
    axis.errorbar(
        range(len(rows)),
        rows["score"],
        yerr=rows["standard_error"],
        fmt="o-",
        color=BLUE,
        capsize=4,
    )
    place = list(rows["chosen"]).index(True)
    axis.plot(
        place, rows["score"].iloc[place], "o", ms=13, mfc="none", color=ORANGE, label="chosen"
    )
    axis.set_yscale("log")
    axis.set_xticks(range(len(rows)), rows["model"], fontsize=8)
    axis.set(ylabel="error of free runs", title="each model over the blocks that were left out")
    axis.legend()
    return figure


@picture("architecture", blocks=0)
def architecture(names: Names) -> Figure:
    figure, axis = canvas(10, 6.6)

    def part(
        x: float,
        y: float,
        title: str,
        files: str,
        *,
        w: float = 2.2,
        h: float = 0.95,
        colour: str = BLUE,
    ):
        box(axis, x, y, "", w=w, h=h, colour=colour)
        axis.text(
            x + w / 2, y + h - 0.2, title, ha="center", va="center", fontsize=9, weight="bold"
        )
        axis.text(
            x + w / 2,
            y + (h - 0.32) / 2,
            files,
            ha="center",
            va="center",
            fontsize=7.2,
            linespacing=1.4,
        )

    def mark(x: float, y: float, number: int) -> None:
        axis.add_patch(plt.Circle((x, y), 0.15, fc=ORANGE, ec="white", lw=1, zorder=5))
        axis.text(
            x,
            y - 0.005,
            str(number),
            ha="center",
            va="center",
            fontsize=8.5,
            weight="bold",
            zorder=6,
        )

    part(
        0.2, 5.45, "a spec, its data", "commands/spec.py\ncommands/opening.py, job.py", colour=GREY
    )
    part(0.2, 4.1, "record", "data/readers.py, record.py\ndata/preparation.py")
    part(0.2, 2.75, "physics", "physics/baseline.py, motion.py\nphysics/problem.py")
    part(
        0.2,
        1.4,
        "model: a state and a step",
        "models/lagged.py, moving.py\nmodels/learners.py, model.py",
    )
    part(2.95, 5.45, "the verb", "fitting/estimation.py\nfitting/training.py")
    part(2.95, 4.1, "one step ahead", "physics/projection.py\nfitting/normal_equations.py")
    part(2.95, 2.75, "free run", "fitting/segments.py\nfitting/objective.py")
    part(2.95, 1.4, "damped steps", "fitting/solvers/minimize.py\nfitting/solvers/damped_step.py")
    part(5.7, 4.1, "conclusion", "fitting/conclusion.py\nfitting/motion_task.py")
    part(
        5.7,
        2.75,
        "split and intervals",
        "inference/splitting.py\ninference/covariance.py",
    )
    part(5.7, 5.45, "the fit", "fitting/estimates.py\nlagged_estimate.py, motion_estimate.py")
    part(
        8.1,
        4.1,
        "is it right?",
        "analysis/diagnosis.py\nanalysis/budget.py, bias_hull.py",
        w=1.75,
        colour=GREEN,
    )
    part(8.1, 2.75, "elsewhere", "export/lowering.py\nexport/c_source.py", w=1.75, colour=GREEN)
    part(
        8.1,
        1.4,
        "which structure?",
        "selection/selecting.py\nselection/explanation.py",
        w=1.75,
        colour=GREEN,
    )
    part(
        8.1,
        5.45,
        "report",
        "commands/fit.py, advice.py\nreports/result.py, page.py",
        w=1.75,
        colour=GREY,
    )
    part(5.7, 1.4, "sums over rows", "models/rows.py (engine)\nstreaming.py, cluster.py")
    for y in (5.45, 4.1, 2.75):
        arrow(axis, (1.3, y - 0.02), (1.3, y - 0.38))
    arrow(axis, (2.42, 1.9), (2.93, 4.4), bend=-0.1)
    arrow(axis, (2.42, 1.8), (2.93, 3.1), bend=-0.1)
    arrow(axis, (2.42, 5.9), (2.93, 5.9))
    arrow(axis, (4.05, 5.43), (4.05, 5.07))
    arrow(axis, (4.05, 2.73), (4.05, 2.37))
    arrow(axis, (5.17, 4.25), (5.17, 2.2), bend=-0.22)
    arrow(axis, (5.17, 1.87), (5.68, 1.87))
    arrow(axis, (5.17, 4.57), (5.68, 4.57))
    arrow(axis, (5.17, 3.3), (5.68, 4.3))
    arrow(axis, (6.8, 4.08), (6.8, 3.72))
    arrow(axis, (6.8, 5.07), (6.8, 5.43))
    arrow(axis, (7.92, 5.5), (8.12, 5.03))
    arrow(axis, (8.97, 5.07), (8.97, 5.43))
    for y, number in ((4.1, 1), (1.4, 3)):
        mark(2.95, y + 0.95, number)
    mark(5.7, 3.7, 2)
    mark(9.85, 5.05, 4)
    mark(8.1, 3.7, 5)
    questions = "1 θ is solved    2 the learner's split is made    3 the damping is updated    4 an interval gets its bias    5 a C export writes a tanh"
    axis.text(5, 0.72, questions, ha="center", fontsize=8.6)
    axis.text(
        5,
        0.32,
        "Grey: what a user touches. Blue: from data to an estimate. Green: what reads a finished fit.",
        ha="center",
        fontsize=8,
        color="#555555",
    )
    return figure


@picture("export")
def export(names: Names) -> None:
    import mpc

    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(io.StringIO()):
        mpc.main(f"{folder}/mpc.png")
        image = Image.open(f"{folder}/mpc.png")
        size = (round(image.width * 0.75), round(image.height * 0.75))
        shrink(image.resize(size, Image.Resampling.LANCZOS), FIGURES / "mpc.png", 48)


@picture("structures")
def structures(names: Names) -> Figure:
    import static_example

    import orthaug as oa

    example = oa.synthetic.static(data_set=1)
    return static_example.draw(example, static_example.estimates(example))


@picture("result")
def result(names: Names) -> None:
    """The first screen of the report of `orthaug demo`."""
    from playwright.sync_api import sync_playwright
    from test_cli import run

    assert run("demo").code == 0
    with sync_playwright() as started:
        browser = started.chromium.launch(
            executable_path=shutil.which("chromium"), args=["--no-sandbox", "--disable-gpu"]
        )
        page = browser.new_page(viewport={"width": 1100, "height": 760})
        page.goto(Path("orthaug-out/demo/report.html").resolve().as_uri())
        page.wait_for_timeout(4000)
        shrink(Image.open(io.BytesIO(page.screenshot())), file_of("result"), 48)
        browser.close()


def main(pages: list[str]) -> None:
    FIGURES.mkdir(exist_ok=True)
    home = os.getcwd()
    for page in pages or list(PICTURES):
        count, commands, draw = PICTURES[page]
        with tempfile.TemporaryDirectory() as folder, plt.rc_context(STYLE):
            os.chdir(folder)
            try:
                figure = draw(names_of(page, count, commands))
                if figure is not None:
                    save(figure, file_of(page))
            finally:
                os.chdir(home)
        print(page, flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
