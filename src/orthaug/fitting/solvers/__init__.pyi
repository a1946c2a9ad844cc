from .adam_lbfgs import AdamLBFGS as AdamLBFGS
from .levenberg_marquardt import LevenbergMarquardt as LevenbergMarquardt
