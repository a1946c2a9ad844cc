"""Models as code that needs no orthaug: an intermediate form, and a file for each language."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
