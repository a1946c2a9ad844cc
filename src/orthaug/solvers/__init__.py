"""Solvers: frozen declarations that minimise a criterion over the learner's weights."""

from orthaug.solvers.adam_lbfgs import AdamLBFGS
from orthaug.solvers.levenberg_marquardt import LevenbergMarquardt

__all__ = ["AdamLBFGS", "LevenbergMarquardt"]
