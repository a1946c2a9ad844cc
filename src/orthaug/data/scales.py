"""Channels with numbers of an unlikely size: a probable cause where a free run overflows."""

from __future__ import annotations

import numpy as np

from orthaug.data.record import Record

# In the unit of a channel: beyond these a scale is more often wrong than right
_SMALL, _LARGE = (1e-8, 1e8)
_FAR = 1e5  # a mean so many times the spread is more often an offset than a signal


def describe_scales(record: Record) -> str:
    """Return a sentence on channels of an unlikely size or offset; empty where all are usual."""
    found = []
    for kind in ("outputs", "inputs"):
        for i, channel in enumerate(getattr(record, kind)):
            values = np.concatenate(
                [getattr(experiment, kind)[:, i] for experiment in record.experiments]
            )
            if not np.isfinite(values).any():
                continue
            middle, spread = float(np.nanmean(values)), float(np.nanstd(values))
            unit = f" {channel.unit}" if channel.unit else ""
            if spread and not _SMALL < spread < _LARGE:
                found.append(f"{channel.name} varies by {spread:.3g}{unit}")
            elif spread and abs(middle) > _FAR * spread:
                found.append(
                    f"{channel.name} varies by {spread:.3g}{unit} about {middle:.3g}{unit}"
                )
    if not found:
        return ""
    named = ", ".join(found)
    return (
        f"in the data {named}: check `scale`, `offset` and `unit` in [data.channels] against "
        "the initial values."
    )
