"""The section [engine] of a spec: where the rows of training are, and who sums over them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import Field

from orthaug._base.errors import InputError
from orthaug._base.memory import available
from orthaug.commands.sections import Positive, Section

if TYPE_CHECKING:
    from collections.abc import Sequence

    from orthaug.models.rows import Engine

_PARQUET = ".parquet"
_SHARE = 0.25  # of the memory that is free: what the files may take before they are streamed
_COPIES = 4  # of a file's bytes, in a fit in memory at least


class EngineSection(Section):
    """Who sums over the rows."""

    kind: Literal["auto", "memory", "stream", "devices", "dask"] = "auto"
    scheduler: str | None = None
    workers: Positive | None = None
    devices: Positive | None = None
    partition_rows: Positive = 1_000_000
    checkpoint: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 10.0

    def chosen(self, files: Sequence[Path]) -> str:
        """The kind; "auto" streams Parquet files that are too large for memory."""
        if self.kind != "auto":
            return self.kind
        parquet = all(file.suffix.lower() == _PARQUET for file in files)
        try:
            size = sum(file.stat().st_size for file in files)
        except OSError:  # reading them will tell
            return "memory"
        return "stream" if parquet and _COPIES * size > _SHARE * available() else "memory"


def engine_of(section: EngineSection, kind: str) -> Engine:
    """The engine of a kind.

    Raises:
        InputError: one that is not installed, or cannot be reached.
    """
    if kind == "dask":
        from orthaug.models.cluster import Dask, connected

        return Dask(connected(section.scheduler, section.workers))
    if kind == "devices":
        from orthaug.models import hosts
        from orthaug.models.devices import Devices

        hosts.join()
        if hosts.several() and section.devices is not None:
            raise InputError(f"`engine.devices`: found {section.devices}; over several hosts all devices are used.")
        return Devices(section.devices)
    from orthaug.models.rows import InMemory
    from orthaug.models.streaming import Stream

    return Stream() if kind == "stream" else InMemory()
