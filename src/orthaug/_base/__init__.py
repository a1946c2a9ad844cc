"""Base of all rooms: errors, checks of arguments, JAX in double precision, threads, folders."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
