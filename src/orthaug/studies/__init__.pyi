from . import synthetic as synthetic
from .study import Study as Study
from .study import run as run
