"""What `estimate` is handed becomes a problem and an engine: a record in memory, or rows that stay elsewhere."""

from __future__ import annotations

from typing import Any

from orthaug._base.checks import check_type
from orthaug._base.errors import InputError
from orthaug.data.record import Record
from orthaug.data.sources import Source, witness
from orthaug.models.rows import Engine, InMemory
from orthaug.physics.baseline import Baseline
from orthaug.physics.problem import Problem, pose
from orthaug.physics.streamed import pose_streamed


def posed_on(
    record: Record | Source, engine: Engine | None, baseline: Baseline, *args: Any, **options: Any
) -> tuple[Problem, Engine]:
    """The problem with the engine that sums over its rows; further arguments as of `pose`.

    Args:
        engine: None for what suits the record: memory, a stream of its files, the cluster that holds it.

    Raises:
        InputError: as `pose`.
    """
    if isinstance(record, Record):
        return pose(record, baseline, *args, **options), InMemory() if engine is None else engine
    engine = _engine_of(record) if engine is None else engine
    return pose_streamed(record, witness(record), engine.passes, baseline, *args, **options), engine


def _engine_of(source: Source) -> Engine:
    client = getattr(source, "client", None)
    if client is not None:
        from orthaug.models.cluster import Dask

        return Dask(client)
    from orthaug.models.streaming import Stream

    return Stream()


def check_record(record: Any, *, moves: bool = False) -> None:
    """Raise InputError for what holds no rows, or none in memory where a motion needs them."""
    if not isinstance(record, Source):
        check_type(record, Record, "record", "a Record")
    elif moves and not isinstance(record, Record):
        raise InputError(
            "a motion takes a Record, whose segments an engine may share out; read these rows into memory "
            "(read_record, Record.join), or fit the physics in its lagged form."
        )
