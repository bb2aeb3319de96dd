"""Recordings of several sessions as one stream of chunks: columns are moved, never rows.

Every entity gets its session's name in front, and a session whose zero isn't that of its own
recording is moved along the timelines.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import rerun as rr
from rerun.chunk import Chunk, LazyChunkStream, RrdReader

from ..samples.timeline import GAIT_CYCLE, SESSION_TIME

_ARROW: Any = pa  # comes without types
_CHUNK: Any = Chunk
_AHEAD = 32
"""Chunks that may wait to be written."""

_PROPERTIES = "/__properties/**"


def chunks_of(
    recording: Path, entity: str, *, later_ns: int = 0, more_cycles: int = 0
) -> LazyChunkStream:
    """A recording's chunks under a path of their own.

    Args:
        recording: The .rrd file.
        entity: Path to put in front of every entity's, e.g. ``/twin``.
        later_ns: Added to ``session_time`` [ns].
        more_cycles: Added to ``gait_cycle``.

    Returns:
        The stream, which reads when it is used. The recording's own properties are left out.
    """
    moves = {SESSION_TIME: later_ns, GAIT_CYCLE: more_cycles * 1_000_000_000}
    moves = {timeline: by for timeline, by in moves.items() if by}

    def placed(chunk: Chunk) -> Chunk:
        chunk = chunk.with_entity_path(f"{entity}{chunk.entity_path}")
        return chunk if chunk.is_static or not moves else _moved(chunk, moves)

    return RrdReader(recording).stream().drop(content=_PROPERTIES).map(placed)


def send(rec: rr.RecordingStream, streams: Sequence[LazyChunkStream]) -> None:
    """Write chunks as they are read.

    Left to itself the reader runs ahead of the writer, and hours of chunks, unpacked, wait in
    between; so now and then it waits until all are written.

    Args:
        rec: The recording.
        streams: The chunks.
    """
    count = 0

    def waiting(chunk: Chunk) -> Chunk:
        nonlocal count
        count += 1
        if count % _AHEAD == 0:
            rec.flush()
        return chunk

    rec.send_chunks(LazyChunkStream.merge(*streams).map(waiting))


def _moved(chunk: Any, moves: dict[str, int]) -> Chunk:
    """A chunk further on along its timelines; rows that aren't on one stay off it."""
    batch = chunk.to_record_batch()
    for timeline, by in moves.items():
        place = batch.schema.get_field_index(timeline)
        if place >= 0:
            field = batch.schema.field(place)
            later = batch.column(place).to_numpy() + np.timedelta64(by, "ns")
            batch = batch.set_column(place, field, _ARROW.array(later, field.type))
    (moved,) = _CHUNK.from_record_batch(batch)
    return moved
