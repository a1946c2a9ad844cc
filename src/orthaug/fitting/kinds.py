"""The structures, criteria and solvers that a spec knows by name. A new one is a file, and an entry here."""

from __future__ import annotations

from orthaug._base.registry import Registry
from orthaug.fitting.criteria import Prediction, Simulation
from orthaug.fitting.solvers.adam_lbfgs import AdamLBFGS
from orthaug.fitting.solvers.levenberg_marquardt import LevenbergMarquardt
from orthaug.fitting.structures import Additive, BaselinePenalty, Orthogonal, OrthogonalPenalty

STRUCTURES = Registry(
    "structure",
    {
        "additive": Additive,
        "orthogonal": Orthogonal,
        "orthogonal-penalty": OrthogonalPenalty,
        "baseline-penalty": BaselinePenalty,
    },
    reserved=("kind", "measure"),
)
_BESIDE = ("solver", "focus", "restarts", "ensemble", "seed", "regularization")  # the other keys of [training]
CRITERIA = Registry("criterion", {"prediction": Prediction, "simulation": Simulation}, reserved=_BESIDE)
SOLVERS = Registry(
    "solver", {"levenberg-marquardt": LevenbergMarquardt, "adam-lbfgs": AdamLBFGS}, reserved=_BESIDE, beside=CRITERIA
)
