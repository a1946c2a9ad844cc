from . import signals as signals
from .budget import bias_budget as bias_budget
from .design import design_input as design_input
from .free_run_stability import stability as stability
from .suspects import Suspect as Suspect
from .verdict_on_parts import verdict as verdict
from .verdict_on_residuals import diagnose as diagnose
