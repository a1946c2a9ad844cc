"""What θ means and how surely it is known: measures, splits under them, covariances, physical parameters."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
