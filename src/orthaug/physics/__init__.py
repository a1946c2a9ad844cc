"""The physics, linear in θ: φ, its projection, its excitation by data, and physical parameters.

No JAX.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
