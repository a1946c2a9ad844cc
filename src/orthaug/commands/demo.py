"""The built-in example: the paper's mass-spring-damper.

Two structures fit it equally well, and only the orthogonal one keeps θ.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from orthaug._base.folders import whole_folder
from orthaug._base.lines import fold
from orthaug._base.progress import SILENT, Progress
from orthaug.commands.fit import FitReport, fill_result, fit_job
from orthaug.commands.opening import open_job
from orthaug.fitting.estimates import Estimate
from orthaug.fitting.estimation import estimate
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
        for name, record in (("train", example.train), ("test", example.test)):
            experiment = record.experiments[0]
            table = np.column_stack([experiment.inputs, experiment.outputs])
            np.savetxt(
                partial / f"{name}.csv",
                table,
                fmt="%.17g",
                delimiter=",",
                header="force,position",
                comments="",
            )
        (partial / "spec.toml").write_text(SPEC, encoding="utf-8")
        job = open_job(partial / "spec.toml")
        orthogonal = fit_job(job, progress)
        additive = [_additive(example, seed, progress) for seed in range(RESTARTS)]
        fill_result(orthogonal, partial)
    return _comparison(example, orthogonal, additive)


def _additive(example: Example, seed: int, progress: Progress) -> Estimate:
    return estimate(
        example.train,
        example.baseline,
        structure=Additive(),
        regularization="none",
        seed=seed,
        progress=progress.after(runs=RESTARTS + seed),
    )


def _comparison(example: Example, orthogonal: FitReport, additive: list[Estimate]) -> str:
    fit = orthogonal.fit
    std = fit.std if fit.std is not None else np.zeros_like(fit.theta)
    thetas = np.array([a.theta for a in additive])
    lines = [
        "The paper's mass-spring-damper: linear physics, friction left to a network of 16 neurons.",
        f"{RESTARTS} initialisations; the same data, the same network, the same training.",
        "",
        f"{'':<24}{'true':>12}{'initial':>10}{'orthogonal ± std':>23}   "
        f"{'additive, lowest … highest':>26}",
    ]
    for i, parameter in enumerate(fit.problem.baseline.parameters):
        spread = f"{thetas[:, i].min():.5g} … {thetas[:, i].max():.5g}"
        value = f"{fit.theta[i]:.6g} ± {std[i]:.2g}"
        lines.append(
            f"{parameter.name:<24}{example.theta[i]:>12.6g}{parameter.initial:>10.4g}{value:>23}   "
            f"{spread:>26}"
        )
    errors = [np.linalg.norm((t - example.theta) / example.theta) for t in thetas]
    error = np.linalg.norm((fit.theta - example.theta) / example.theta)
    lines.append(
        f"{'relative error of θ':<46}{error:>23.4g}   "
        f"{f'{min(errors):.4g} … {max(errors):.4g}':>26}"
    )
    for label, verb in (
        ("test RMSE, one step [m]", "predict"),
        ("test RMSE, free run [m]", "simulate"),
    ):
        ours = getattr(fit.model, verb)(example.test).scores().rmse[0]
        theirs = [getattr(a.model, verb)(example.test).scores().rmse[0] for a in additive]
        lines.append(f"{label:<46}{ours:>23.3g}   {f'{min(theirs):.3g} … {max(theirs):.3g}':>26}")
    lines += [
        "",
        "Both predict equally well; only the orthogonal structure keeps θ (‖QᵀF̃‖/‖F‖ = "
        f"{fit.defect:.0e}).",
    ]
    lines += [
        f"warning: {warning.text}"
        for warning in orthogonal.result.warnings
        if warning.code == "biased"
    ]
    return "\n".join(fold(lines))
