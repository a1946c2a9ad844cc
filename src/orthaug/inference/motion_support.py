"""What measures over a motion draw on: its states and inputs at the training rows."""

from __future__ import annotations

import numpy as np

from orthaug._base.checks import Matrix
from orthaug.data.record import Channel, Experiment, Record
from orthaug.inference.measures import Support
from orthaug.physics.motion import Motion
from orthaug.physics.motion_problem import layout_of


def support_of(motion: Motion, x: Matrix, u: Matrix) -> Support:
    """Of points (M, nx) and (M, nu)."""
    layout, points = layout_of(motion), np.concatenate([x, u], axis=1)
    channels = tuple(Channel(f"c{i}") for i in range(len(layout)))
    record = Record((), channels, 1.0, (Experiment(points[:, :0], points),))
    return Support(record, layout, layout, points)
