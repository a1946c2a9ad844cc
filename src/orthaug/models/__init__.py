"""Physics with a learned correction: learners, models, their responses, and storage."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
