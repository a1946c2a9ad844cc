"""The built-in example: the paper's mass-spring-damper.

Two structures fit it equally well, and only the orthogonal one keeps θ.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from orthaug._base.folders import whole_folder
from orthaug._base.lines import estimate_cells, fold, percent, table
from orthaug._base.progress import SILENT, Progress
from orthaug.commands.fit import FitReport, fill_result, fit_job
from orthaug.commands.opening import open_job
from orthaug.fitting.estimation import estimate
from orthaug.fitting.lagged_estimate import LaggedEstimate
from orthaug.fitting.solvers.levenberg_marquardt import LevenbergMarquardt
from orthaug.fitting.structures import Additive
from orthaug.studies.synthetic import Example, mass_spring_damper

RESTARTS = 3
ITERATIONS = LevenbergMarquardt().iterations  # those on which a progress bar counts

SPEC = f"""\
# The paper's mass-spring-damper (Sect. 5.2): linear physics, unmodelled Stribeck friction.
[data]
sampling_time = 0.01
inputs  = ["force"]
outputs = ["position"]
train = {{ files = ["train.csv"] }}
[data.tests.uniform]
files = ["test.csv"]
[data.channels]
force = {{ unit = "N" }}
position = {{ unit = "m" }}

[[baseline.terms]]
parameter = "theta1"
regressor = "position[k-1]"
initial = 0.61
[[baseline.terms]]
parameter = "theta2"
regressor = "position[k-2]"
initial = -0.52
[[baseline.terms]]
parameter = "theta3"
regressor = "force[k-1]"
initial = 4.7e-5
unit = "m/N"

[learner]
hidden = [16]

[structure]
kind = "orthogonal"

[training]
restarts = {RESTARTS}
regularization = "none"
"""


def run(folder: Path, progress: Progress = SILENT, *, force: bool = False) -> str:
    """Generate the record, fit both structures; write data, spec and orthogonal fit.

    Return the comparison.
    """
    example = mass_spring_damper()
    with whole_folder(folder, force=force) as partial:
        write_records(example, partial)
        (partial / "spec.toml").write_text(SPEC, encoding="utf-8")
        job = open_job(partial / "spec.toml")
        orthogonal = fit_job(job, progress)
        additive = [_additive(example, seed, progress) for seed in range(RESTARTS)]
        fill_result(orthogonal, partial)
    return _comparison(example, orthogonal, additive)


def write_records(example: Example, folder: Path) -> None:
    """Write the files that the spec names."""
    for name, record in (("train", example.train), ("test", example.test)):
        experiment = record.experiments[0]
        np.savetxt(
            folder / f"{name}.csv",
            np.column_stack([experiment.inputs, experiment.outputs]),
            fmt="%.17g",
            delimiter=",",
            header="force,position",
            comments="",
        )


def _additive(example: Example, seed: int, progress: Progress) -> LaggedEstimate:
    return estimate(
        example.train,
        example.baseline,
        structure=Additive(),
        regularization="none",
        seed=seed,
        progress=progress.after(runs=RESTARTS + seed),
    )


def _comparison(example: Example, orthogonal: FitReport, additive: list[LaggedEstimate]) -> str:
    fit = orthogonal.fit
    thetas = np.array([a.theta for a in additive])
    rows = [["", "true", "initial", "orthogonal ± std", "additive, range"]]
    for i, parameter in enumerate(fit.problem.baseline.parameters):
        value, std, _, _ = estimate_cells(fit.theta[i], None if fit.std is None else fit.std[i])
        spread = f"{thetas[:, i].min():.4g} … {thetas[:, i].max():.4g}"
        true = f"{example.theta[i]:.6g}"
        rows.append([parameter.name, true, f"{parameter.initial:.4g}", f"{value} ± {std}", spread])
    errors = [float(np.linalg.norm((t - example.theta) / example.theta)) for t in thetas]
    error = float(np.linalg.norm((fit.theta - example.theta) / example.theta))
    spread = f"{min(errors):.4g} … {max(errors):.4g}"
    rows.append(["relative error of θ", "", "", f"{error:.4g}", spread])
    for label, verb in (
        ("one step, RMSE [m]", "predict"),
        ("free run, RMSE [m]", "simulate"),
    ):
        ours = getattr(fit.model, verb)(example.test).scores().rmse[0]
        theirs = [getattr(a.model, verb)(example.test).scores().rmse[0] for a in additive]
        rows.append([label, "", "", f"{ours:.3g}", f"{min(theirs):.3g} … {max(theirs):.3g}"])
    lines = [
        "The paper's mass-spring-damper: linear physics, friction left to a network of 16 neurons.",
        f"{RESTARTS} initialisations; the same data, the same network, the same training.",
        "",
        *table(rows, drop=["initial"]),
    ]
    lines += [
        "",
        "From every start the orthogonal θ is that of least squares, with an error of "
        f"{percent(error)}. The additive θ depends on the start: its error is "
        f"{percent(min(errors))} to {percent(max(errors))}.",
    ]
    lines += [
        f"warning: {warning.text}"
        for warning in orthogonal.result.warnings
        if warning.code == "biased"
    ]
    return "\n".join(fold(lines))
