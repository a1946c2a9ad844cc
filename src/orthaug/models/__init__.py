"""Physics with a learned correction as a function: learners, models, what they answer, how they are kept."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
