"""Tracks of markers along a body, as the angles of the joints that the markers are.

A table with columns ``NAME_x`` and ``NAME_y`` (also ``NAME.x``, ``x_NAME``, ``x1``), as pose
estimation writes them for animals, in the order of the body. The angle at marker k is that from the
segment before it to the segment behind it, in the plane of x and y; the first and the last marker
have none. DeepLabCut's three lines of header are read as such columns; a point that is less likely
than ``LEAST_LIKELY`` is none.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..common.arrays import NS, FloatArray
from ..common.errors import ImportFormatError, UsageError
from .column_blocks import Block
from .table_file import TableFile, is_time, words

LEAST_LIKELY = 0.6
"""DeepLabCut's own default."""

_LEAST_MARKERS = 3
_BEHIND = re.compile(r"(?P<marker>.*[^ _.-])[ _.-](?P<axis>[xy])", re.IGNORECASE)
_BEFORE = re.compile(r"(?P<axis>[xy])[ _.-]?(?P<marker>\d+|(?<=[ _.-]).+)", re.IGNORECASE)
_LIKELY = {"likelihood", "score", "confidence", "prob", "probability"}
_FRAME = {"frame", "frames", "index", "idx", "sample", "image"}
_TIME = "time [ns]"


@dataclass(frozen=True)
class _Marker:
    """Columns of one marker."""

    x: str
    y: str
    likelihood: str | None = None


def is_frame_number(name: str) -> bool:
    """Return whether a column is named as numbers of frames are."""
    parts = words(name)
    return bool(parts) and parts[0] in _FRAME


def as_joints(table: TableFile) -> TableFile | None:
    """Return a table of tracks as one of joint angles; None where it holds no tracks."""
    markers = _markers(table.columns)
    used = {name for marker in markers.values() for name in (marker.x, marker.y, marker.likelihood)}
    kept = [name for name in table.columns if is_time(name) or is_frame_number(name)]
    others = [name for name in table.columns if name not in used and name not in kept]
    if len(markers) < _LEAST_MARKERS or len(others) > len(used):
        return None
    angles = {f"angle [rad][{name}]": name for name in list(markers)[1:-1]}

    def read(names: Sequence[str], time: str) -> Iterator[Block]:
        requested = [name for name in names if name in kept]
        for block in table.read([*requested, *(name for name in used if name)], time):
            try:
                points = [_points(block, marker) for marker in markers.values()]
            except (ValueError, TypeError) as error:
                raise ImportFormatError(
                    table.path, f"has a point without numbers: {error}"
                ) from error
            turned = dict(zip(angles, _turns(np.stack(points)), strict=True))
            yield {name: turned[name] if name in turned else block[name] for name in names}

    left_out = (*table.left_out, *(name for name in table.columns if name not in kept))
    return replace(
        table, columns=(*kept, *angles), read=read, form="tracks of markers", left_out=left_out
    )


def with_fps(table: TableFile, fps: float) -> TableFile:
    """Return a table without times as one whose rows are frames at a constant rate.

    Args:
        fps: Frames a second, of numbers in a column of frames if there is one.

    Raises:
        UsageError: If the table has times.
    """
    if times := [name for name in table.columns if is_time(name)]:
        raise UsageError(f"{table.path} has times ({times[0]}); --fps is for tables without")
    frames = next((name for name in table.columns if is_frame_number(name)), None)

    def read(names: Sequence[str], time: str) -> Iterator[Block]:  # noqa: ARG001
        row = 0
        values = [name for name in names if name != _TIME]
        source = [*values, *([frames] if frames and frames not in values else [])]
        for block in table.read(source or list(table.columns[:1]), ""):
            count = len(next(iter(block.values())))
            number = np.arange(row, row + count) if frames is None else block[frames]
            row += count
            yield {_TIME: _times(table, number, fps)} | {name: block[name] for name in values}

    columns = tuple(name for name in table.columns if name != frames)
    return replace(table, columns=(_TIME, *columns), read=read)


def _times(table: TableFile, number: NDArray[Any], fps: float) -> NDArray[np.int64]:
    if number.dtype.kind not in "fiu" or not np.all(np.abs(number.astype(float)) < 2.0**53):
        raise ImportFormatError(table.path, "has frames without a number")
    return np.rint(number * (NS / fps)).astype(np.int64)


def _markers(columns: Sequence[str]) -> dict[str, _Marker]:
    """Return the markers in the order of their first columns."""
    markers: dict[str, dict[str, str]] = {}
    for name in columns:
        match = _BEHIND.fullmatch(name) or _BEFORE.fullmatch(name)
        if match is not None:
            marker = match["marker"]
            marker = f"marker{marker}" if marker.isdigit() else marker
            markers.setdefault(marker, {}).setdefault(match["axis"].lower(), name)
    likely = {
        stem: name
        for name in columns
        if (stem := re.sub(r"[ _.-][A-Za-z]+$", "", name)) != name and words(name)[-1] in _LIKELY
    }
    return {
        marker: _Marker(axes["x"], axes["y"], likely.get(marker))
        for marker, axes in markers.items()
        if axes.keys() == {"x", "y"}
    }


def _points(block: Mapping[str, NDArray[Any]], marker: _Marker) -> FloatArray:
    """Return a marker's positions, shape (2, n), NaN where it is hardly there."""
    point = np.stack([block[marker.x], block[marker.y]]).astype(float)
    if marker.likelihood is not None:
        point[:, ~(block[marker.likelihood].astype(float) >= LEAST_LIKELY)] = np.nan
    return point


def _turns(points: FloatArray) -> FloatArray:
    """Return the angles between the segments of k markers [rad], shape (k - 2, n).

    Args:
        points: Shape (k, 2, n).
    """
    along = np.diff(points, axis=0)
    before, behind = along[:-1], along[1:]
    across = before[:, 0] * behind[:, 1] - before[:, 1] * behind[:, 0]
    turned = np.arctan2(across, np.sum(before * behind, axis=1))
    # Two markers at one place have no direction between them.
    apart = np.all((np.sum(before**2, axis=1) > 0, np.sum(behind**2, axis=1) > 0), axis=0)
    return np.where(apart, turned, np.nan)
