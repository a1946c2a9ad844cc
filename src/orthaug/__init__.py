"""orthaug: physics with a learned correction, and parameters that keep all that physics can explain.

Names load on first use, so that `orthaug --help` and reading data do not import JAX; `__init__.pyi` lists them.
"""

import lazy_loader

__version__ = "0.1.0"

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
