"""What a format can't hold of a frame: counted by comparing frames with what the format keeps."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..log.frames import DIR_RX, ERROR_FLAG, EXTENDED_FLAG, ID_MASK, REMOTE_FLAG, FrameArray

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
"""What is compared: name to one number a frame."""


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
            frames: As the session has them, shape (n,).
            kept: The same as the format has them, shape (n,).
        """
        error, remote = is_error(frames), is_remote(frames)
        kinds = {"error frame": error, "remote frame": remote, "data frame": ~error & ~remote}
        for kind, mask in kinds.items():
            for name, number in _FIELDS.items():
                self._count(kind, name, number(frames[mask]) != number(kept[mask]))
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
