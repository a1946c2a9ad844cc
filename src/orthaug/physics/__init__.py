"""The physics, linear in θ: φ, its projection, what the data say about θ, and what θ is made of.

No JAX.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
