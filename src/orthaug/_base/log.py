"""What the library tells programs about its work: the logger `orthaug`, silent until somebody listens.

Stages of a fit are INFO, what was tried instead is DEBUG. What a user must know stands in warnings of results.
"""

from __future__ import annotations

import logging

LOG = logging.getLogger("orthaug")
LOG.addHandler(logging.NullHandler())


def show_log(level: str) -> None:
    """Write the log to standard error from `level` on, info or debug, with the time of each line."""
    if any(isinstance(handler, logging.StreamHandler) for handler in LOG.handlers):
        return
    handler = logging.StreamHandler()
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(message)s", "%H:%M:%S"))
    LOG.addHandler(handler)
    LOG.setLevel(level.upper())
    LOG.propagate = False
