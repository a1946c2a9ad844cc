"""The meaning of θ and its uncertainty: measures, splits, covariances, physical parameters."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
