"""orthaug: physics with a learned correction, and parameters that keep all that physics can explain.

Names load on first use, so that `orthaug --help` and reading data do not import JAX.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

_HOME = {
    "InputError": "errors",
    "RankError": "errors",
    "TrainingError": "errors",
    "Channel": "record",
    "Experiment": "record",
    "Record": "record",
    "read_record": "readers",
    "Lags": "regressors",
    "Baseline": "baseline",
    "Parameter": "baseline",
    "Term": "baseline",
    "MLP": "learners",
    "Function": "learners",
    "EquinoxModule": "learners",
    "External": "learners",
    "Additive": "structures",
    "Orthogonal": "structures",
    "OrthogonalPenalty": "structures",
    "BaselinePenalty": "structures",
    "Prediction": "criteria",
    "Simulation": "criteria",
    "LevenbergMarquardt": "solvers",
    "AdamLBFGS": "solvers",
    "estimate": "estimation",
    "orthogonalize": "estimation",
    "Estimate": "result",
    "Status": "result",
    "Model": "model",
    "Response": "model",
    "Trajectory": "model",
    "scores": "metrics",
    "identifiability": "excitation",
    "Training": "measures",
    "Symmetrized": "measures",
    "Weighted": "measures",
    "Samples": "measures",
    "Uniform": "measures",
    "PhysicalParameter": "physics",
    "PhysicsMap": "physics",
    "Suspect": "suspects",
    "prediction_std": "uncertainty",
    "diagnose": "diagnosis",
    "load": "storage",
    "save": "storage",
    "synthetic": "",
}
__all__ = sorted(_HOME)  # pyright: ignore[reportUnsupportedDunderAll]

if TYPE_CHECKING:
    from orthaug import synthetic as synthetic
    from orthaug.baseline import Baseline as Baseline
    from orthaug.baseline import Parameter as Parameter
    from orthaug.baseline import Term as Term
    from orthaug.criteria import Prediction as Prediction
    from orthaug.criteria import Simulation as Simulation
    from orthaug.diagnosis import diagnose as diagnose
    from orthaug.errors import InputError as InputError
    from orthaug.errors import RankError as RankError
    from orthaug.errors import TrainingError as TrainingError
    from orthaug.estimation import estimate as estimate
    from orthaug.estimation import orthogonalize as orthogonalize
    from orthaug.excitation import identifiability as identifiability
    from orthaug.learners import MLP as MLP
    from orthaug.learners import EquinoxModule as EquinoxModule
    from orthaug.learners import External as External
    from orthaug.learners import Function as Function
    from orthaug.measures import Samples as Samples
    from orthaug.measures import Symmetrized as Symmetrized
    from orthaug.measures import Training as Training
    from orthaug.measures import Uniform as Uniform
    from orthaug.measures import Weighted as Weighted
    from orthaug.metrics import scores as scores
    from orthaug.model import Model as Model
    from orthaug.model import Response as Response
    from orthaug.model import Trajectory as Trajectory
    from orthaug.physics import PhysicalParameter as PhysicalParameter
    from orthaug.physics import PhysicsMap as PhysicsMap
    from orthaug.readers import read_record as read_record
    from orthaug.record import Channel as Channel
    from orthaug.record import Experiment as Experiment
    from orthaug.record import Record as Record
    from orthaug.regressors import Lags as Lags
    from orthaug.result import Estimate as Estimate
    from orthaug.result import Status as Status
    from orthaug.solvers import AdamLBFGS as AdamLBFGS
    from orthaug.solvers import LevenbergMarquardt as LevenbergMarquardt
    from orthaug.storage import load as load
    from orthaug.storage import save as save
    from orthaug.structures import Additive as Additive
    from orthaug.structures import BaselinePenalty as BaselinePenalty
    from orthaug.structures import Orthogonal as Orthogonal
    from orthaug.structures import OrthogonalPenalty as OrthogonalPenalty
    from orthaug.suspects import Suspect as Suspect
    from orthaug.uncertainty import prediction_std as prediction_std


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'orthaug' has no attribute '{name}'")
    home = _HOME[name]
    module = import_module(f"orthaug.{home or name}")
    value = getattr(module, name) if home else module
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
