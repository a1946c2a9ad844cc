"""Several hosts as one machine: JAX joins their devices, and the first one writes.

The same command runs on each host.

Every process reads all rows and takes every step; only the sums over rows are shared
(`models.devices`).
"""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Mapping

import numpy as np

from orthaug._base.errors import InputError, show
from orthaug._base.jax import jax

COORDINATOR = "ORTHAUG_COORDINATOR"
"""Variable with host:port of the first process."""
_NUMBERS = {"num_processes": "ORTHAUG_PROCESSES", "process_id": "ORTHAUG_PROCESS"}
_PATIENCE = 60  # s, to wait for the others


def join(environment: Mapping[str, str] = os.environ) -> None:
    """Join the processes of a run over several hosts.

    Does nothing unless the environment names their coordinator.

    Their number, and which one this is, may be left to what JAX finds out of SLURM and Open MPI.

    Raises:
        InputError: variables that are no numbers, and processes that do not find each other.
    """
    address = environment.get(COORDINATOR)
    if not address or jax.distributed.is_initialized():
        return
    numbers = {}
    for key, name in _NUMBERS.items():
        text = environment.get(name)
        if text is not None and not text.isdecimal():
            raise InputError(f"{name}: found {show(text)}; expected a whole number.")
        numbers[key] = None if text is None else int(text)
    if numbers["process_id"]:
        _await(address)
    jax.config.update("jax_cpu_collectives_implementation", "gloo")
    try:
        jax.distributed.initialize(address, **numbers, initialization_timeout=_PATIENCE)
    except (RuntimeError, ValueError) as error:
        first = str(error).splitlines()[0]
        raise InputError(
            f"the processes of {COORDINATOR}={address} do not find each other ({first})."
        ) from None


def _await(address: str) -> None:
    """Wait until the first process listens.

    JAX itself would end the program without a word of ours.
    """
    host, _, port = address.rpartition(":")
    end = time.monotonic() + _PATIENCE
    while True:
        try:
            socket.create_connection((host, int(port)), timeout=_PATIENCE).close()
            return
        except (OSError, ValueError, OverflowError) as error:
            if time.monotonic() > end or not isinstance(error, OSError):
                text = (
                    f"{COORDINATOR}={address}: no first process answers there "
                    f"({type(error).__name__})."
                )
                raise InputError(text) from None
        time.sleep(0.2)


def several() -> bool:
    """Return whether this process is one of several."""
    return bool(jax.distributed.is_initialized()) and jax.process_count() > 1


def check_alike(fingerprint: str) -> None:
    """Raise InputError where another process has other data, another spec or another version."""
    from jax.experimental.multihost_utils import process_allgather

    own = np.frombuffer(bytes.fromhex(fingerprint), dtype=np.uint8)
    for number, other in enumerate(np.asarray(process_allgather(own))):
        if not np.array_equal(other, own):
            raise InputError(
                f"process {number} has another spec, other data or another version of orthaug."
            )


def waits() -> str | None:
    """Return the message of a process that writes nothing; None for the one that writes."""
    if not several() or jax.process_index() == 0:
        return None
    return (
        f"process {jax.process_index()} of {jax.process_count()}: done; process 0 writes the "
        "result."
    )
