"""Fitting a model to a record: criteria, structures, solvers, and `estimate`."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
