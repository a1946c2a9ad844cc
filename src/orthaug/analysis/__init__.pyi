from . import signals as signals
from .design import design_input as design_input
from .diagnosis import diagnose as diagnose
from .suspects import Suspect as Suspect
