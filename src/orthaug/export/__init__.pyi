from .exporting import export as export
from .numpy_step import numpy_step as numpy_step
