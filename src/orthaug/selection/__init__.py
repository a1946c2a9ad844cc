"""Find the structure: terms, lags, delays, inputs; and what a learner has found."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
