"""Solvers: frozen declarations that minimise a criterion over the learner's weights."""

from orthaug.fitting.solvers.adam_lbfgs import AdamLBFGS
from orthaug.fitting.solvers.levenberg_marquardt import LevenbergMarquardt

__all__ = ["AdamLBFGS", "LevenbergMarquardt"]
