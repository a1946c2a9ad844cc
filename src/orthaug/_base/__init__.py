"""What every room stands on: errors, checks of arguments, JAX in double precision, threads, whole folders."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
