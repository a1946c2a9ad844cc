from .figures import FitPlots as FitPlots
from .figures import plot as plot
from .result import CheckResult as CheckResult
from .result import CompareResult as CompareResult
from .result import DesignResult as DesignResult
from .result import FitResult as FitResult
from .result import SplitResult as SplitResult
