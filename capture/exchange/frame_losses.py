"""What a format can't hold of a frame: counted by comparing frames with what the format keeps."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..log.messages.frames import (
    DIR_RX,
    ERROR_FLAG,
    EXTENDED_FLAG,
    FD_BRS,
    FD_ESI,
    ID_MASK,
    REMOTE_FLAG,
    FrameArray,
    holds_fd,
)

Mask = NDArray[np.bool_]
_FLAGS = ERROR_FLAG | REMOTE_FLAG | EXTENDED_FLAG

_FIELDS: dict[str, Callable[[FrameArray], NDArray[Any]]] = {
    "identifier": lambda frames: frames["id_flags"] & ID_MASK,
    "flags": lambda frames: frames["id_flags"] & _FLAGS,
    "length code": lambda frames: frames["dlc"],
    "data": lambda frames: frames["data"].view("<u8")[:, 0],
    "direction": lambda frames: frames["dir"],
    "time below 1 us": lambda frames: frames["t_host_ns"],
}
"""What is compared of a classic frame: name to one number a frame."""

_FD_FIELDS: dict[str, Callable[[FrameArray], NDArray[Any]]] = {
    **{name: _FIELDS[name] for name in ("identifier", "flags", "direction", "time below 1 us")},
    "length": lambda frames: frames["len"],
    "data": lambda frames: frames["data"],
    "bit rate switch": lambda frames: frames["fd_flags"] & FD_BRS,
    "error state": lambda frames: frames["fd_flags"] & FD_ESI,
}
"""The same of a CAN FD frame."""


def is_error(frames: FrameArray) -> Mask:
    """Which frames are error frames.

    Args:
        frames: Records, shape (n,).

    Returns:
        Shape (n,).
    """
    return (frames["id_flags"] & ERROR_FLAG) != 0


def is_remote(frames: FrameArray) -> Mask:
    """Which frames are remote frames, and no error frames.

    Args:
        frames: Records, shape (n,).

    Returns:
        Shape (n,).
    """
    return ((frames["id_flags"] & REMOTE_FLAG) != 0) & ~is_error(frames)


def without_content(frames: FrameArray, which: Mask) -> None:
    """Leave of some error frames only their times, in place.

    Args:
        frames: Records, shape (n,).
        which: Those frames, shape (n,).
    """
    frames["id_flags"][which] = ERROR_FLAG
    frames["dlc"][which] = 0
    frames["data"][which] = 0
    frames["dir"][which] = DIR_RX


class LossTally:
    """Counts what gets lost on the way from frames to a format."""

    def __init__(self) -> None:
        """Start with nothing lost."""
        self._lost: Counter[tuple[str, str]] = Counter()

    def add(self, frames: FrameArray, kept: FrameArray) -> None:
        """Compare frames with what the format keeps of them.

        Args:
            frames: As the session has them, classic or CAN FD, shape (n,).
            kept: The same as the format has them, shape (n,).
        """
        if holds_fd(frames):
            kinds = {"CAN FD frame": np.ones(len(frames), dtype=np.bool_)}
            fields = _FD_FIELDS
        else:
            error, remote = is_error(frames), is_remote(frames)
            kinds = {"error frame": error, "remote frame": remote, "data frame": ~error & ~remote}
            fields = _FIELDS
        for kind, mask in kinds.items():
            for name, number in fields.items():
                lost = number(frames[mask]) != number(kept[mask])
                self._count(kind, name, lost if lost.ndim == 1 else lost.any(axis=1))
        device, host = frames["t_device_ns"], frames["t_host_ns"]
        self._count("frame", "device time", (device != 0) & (device != host))

    def sentences(self) -> Iterator[str]:
        """What was lost, most important first.

        Yields:
            One sentence a kind of frame and field, e.g. ``3 error frames lose their data``.
        """
        for (kind, name), count in sorted(self._lost.items()):
            yield (
                f"{count} {kind} loses its {name}"
                if count == 1
                else f"{count} {kind}s lose their {name}"
            )

    def _count(self, kind: str, name: str, lost: Mask) -> None:
        if count := int(lost.sum()):
            self._lost[kind, name] += count
