"""The plant of a model that was fitted in the loop of a controller."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from orthaug.data.channels import Channel
from orthaug.models.statistics import Statistics


def plant_of(model: Any) -> Any:
    """Return the model without the controller, its inputs given from outside.

    It has no statistics: those of the fit are the loop's.
    """
    loop, plant, numbers = model.form.motion, model.form.motion.plant, model.numbers
    names = [channel.name for channel in model.outputs]
    outputs = [names.index(output.name) for output in plant.outputs]
    states = [loop.names_of_states.index(name) for name in plant.names_of_states]
    inputs = [len(loop.states) + loop.inputs.index(name) for name in plant.inputs]
    own = [loop.names.index(name) for name in plant.names]
    known = {channel.name: channel for channel in (*model.inputs, *model.outputs)}
    pull = None if numbers.pull is None else np.asarray(numbers.pull)[[*states, *inputs]]
    starts = replace(model.starts, loose=np.asarray(model.starts.loose)[states])
    return replace(
        model,
        form=replace(model.form, motion=plant),
        numbers=numbers._replace(
            theta=np.asarray(numbers.theta)[own],
            theta_aux=np.asarray(numbers.theta_aux)[own],
            pull=pull,
        ),
        outputs=tuple(model.outputs[i] for i in outputs),
        inputs=tuple(known.get(name, Channel(name)) for name in plant.inputs),
        largest_output=np.asarray(model.largest_output)[outputs],
        deviation=np.asarray(model.deviation)[outputs],
        weight=np.asarray(model.weight)[np.ix_(outputs, outputs)],
        statistics=Statistics(),
        starts=starts,
        trained=None,
    )
