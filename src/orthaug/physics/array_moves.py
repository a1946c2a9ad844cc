"""Operations of JAX that only move elements of arrays, by NumPy.

They act on whatever an array holds: numbers, or names of things. Each takes the parameters of the
operation, as a traced function has them, and its arguments.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np


def _gathered(parameters: Any, operand: np.ndarray, indices: np.ndarray) -> np.ndarray:
    """Return slices of `operand` at `indices`, as `lax.gather` takes them."""
    numbers, sizes = parameters["dimension_numbers"], parameters["slice_sizes"]
    left_out = (*numbers.collapsed_slice_dims, *numbers.operand_batching_dims)
    batch = indices.shape[:-1]
    kept = [size for axis, size in enumerate(sizes) if axis not in left_out]
    found = np.empty((*batch, *kept), operand.dtype)
    most = np.array(operand.shape) - sizes
    for at in np.ndindex(*batch):
        start = np.zeros(operand.ndim, int)
        start[list(numbers.start_index_map)] = indices[at]
        for axis, of in zip(
            numbers.operand_batching_dims, numbers.start_indices_batching_dims, strict=True
        ):
            start[axis] = at[of]
        if fills(parameters) and ((start < 0) | (start > most)).any():
            found[at] = filling(parameters)
            continue
        start = np.clip(start, 0, most)
        where = tuple(slice(a, a + size) for a, size in zip(start, sizes, strict=True))
        found[at] = operand[where].reshape(kept)
    return np.moveaxis(
        found, range(len(batch), found.ndim), numbers.offset_dims
    )  # the others stay in their order


def scattered(
    parameters: Any, shape: tuple[int, ...], indices: np.ndarray, updates: tuple[int, ...]
) -> list[tuple[tuple[int, ...], tuple[int, ...]]]:
    """Return each place of an array and the element of the updates that goes there."""
    numbers = parameters["dimension_numbers"]
    window = list(numbers.update_window_dims)
    others = [axis for axis in range(len(updates)) if axis not in window]
    left_out = (*numbers.inserted_window_dims, *numbers.operand_batching_dims)
    kept = [axis for axis in range(len(shape)) if axis not in left_out]
    found = []
    for at in np.ndindex(*updates):
        batch = tuple(at[axis] for axis in others)
        place = np.zeros(len(shape), int)
        place[list(numbers.scatter_dims_to_operand_dims)] = indices[batch]
        for axis, of in zip(
            numbers.operand_batching_dims, numbers.scatter_indices_batching_dims, strict=True
        ):
            place[axis] = batch[of]
        place[kept] += np.array([at[axis] for axis in window], int)
        if (place >= 0).all() and (place < shape).all():
            found.append((tuple(int(i) for i in place), at))
    return found


def _set(parameters: Any, operand: np.ndarray, indices: np.ndarray, updates: np.ndarray) -> Any:
    found = operand.copy()
    for place, at in scattered(parameters, operand.shape, indices, updates.shape):
        found[place] = updates[at]
    return found


def _broadcast(parameters: Any, array: np.ndarray) -> np.ndarray:
    shape = [1] * len(parameters["shape"])
    for axis, size in zip(parameters["broadcast_dimensions"], array.shape, strict=True):
        shape[axis] = size
    return np.broadcast_to(array.reshape(shape), parameters["shape"])


def _window(array: np.ndarray, starts: Sequence[Any], sizes: Sequence[int]) -> tuple[slice, ...]:
    begins = [
        int(np.clip(start, 0, length - size))
        for start, length, size in zip(starts, array.shape, sizes, strict=True)
    ]
    return tuple(slice(a, a + size) for a, size in zip(begins, sizes, strict=True))


def _replaced(_: Any, array: np.ndarray, update: np.ndarray, *starts: Any) -> np.ndarray:
    found = array.copy()
    found[_window(array, starts, update.shape)] = update
    return found


def _strided(parameters: Any, array: np.ndarray) -> np.ndarray:
    strides = parameters["strides"] or [1] * array.ndim
    limits = zip(parameters["start_indices"], parameters["limit_indices"], strides, strict=True)
    return array[tuple(slice(*each) for each in limits)]


def fills(parameters: Any) -> bool:
    """Return whether places outside of an array are filled, and not moved into it."""
    return "FILL" in str(parameters.get("mode", ""))


def filling(parameters: Any) -> np.ndarray:
    """Return what is filled in, NaN unless it is given."""
    given = parameters.get("fill_value")
    return np.array(np.nan if given is None else given)


@dataclass(frozen=True)
class Move:
    """An operation that only moves elements; `places` are arguments that say where to."""

    move: Callable[..., Any]
    places: tuple[int, ...] = ()


MOVES = {
    "broadcast_in_dim": Move(_broadcast),
    "concatenate": Move(lambda p, *parts: np.concatenate(parts, p["dimension"])),
    "copy": Move(lambda _, x: x),
    "dynamic_slice": Move(
        lambda p, x, *starts: x[_window(x, starts, p["slice_sizes"])], tuple(range(1, 9))
    ),
    "dynamic_update_slice": Move(_replaced, tuple(range(2, 10))),
    "expand_dims": Move(lambda p, x: np.expand_dims(x, p["dimensions"])),
    "gather": Move(_gathered, (1,)),
    "reshape": Move(lambda p, x: x.reshape(p["new_sizes"])),
    "rev": Move(lambda p, x: np.flip(x, p["dimensions"])),
    "scatter": Move(_set, (1,)),
    "slice": Move(_strided),
    "split": Move(lambda p, x: np.split(x, np.cumsum(p["sizes"])[:-1], p["axis"])),
    "squeeze": Move(lambda p, x: np.squeeze(x, tuple(p["dimensions"]))),
    "stack": Move(lambda p, *parts: np.stack(parts, p.get("axis", p.get("dimension", 0)))),
    "tile": Move(lambda p, x: np.tile(x, p["reps"])),
    "transpose": Move(lambda p, x: x.transpose(p["permutation"])),
}
