"""Frames of which the robot's bus map names hardly any: they are of another robot, or bus."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping

import numpy as np

from ...common.strict_table import Faults
from ...robot.bus_map import database_messages
from ...robot.model import Robot
from ..messages.frames import ERROR_FLAG, EXTENDED_FLAG, ID_MASK, REMOTE_FLAG, FrameArray

LEAST_DECODED = 0.1
"""The map names at least this part of the data frames, or every joint has samples: other devices
may well fill most of a bus."""

_MOST_LISTED = 8


def undecoded(
    robot: str, decoded: int, frames: int, others: Mapping[str, int], *, all_joints: bool
) -> str | None:
    """Return what is wrong where nothing, or hardly anything, could be decoded.

    Args:
        robot: Name of the robot whose bus map was used.
        decoded: Data frames that carry what the map names.
        frames: All data frames.
        others: Identifier to number of the other data frames.
        all_joints: Whether every joint has samples.

    Returns:
        A sentence with the identifiers and the fix; None where enough was decoded.
    """
    enough = LEAST_DECODED * frames if not all_joints else 0
    if not frames or (decoded and decoded >= enough):
        return None
    count = f"only {decoded}" if decoded else "none"
    return (
        f"{count} of {frames} CAN frames can be decoded: the bus map of {robot} does not name "
        f"{counts_text(others)}; they are of another robot or bus, so import or record again with "
        "the robot that sent them (--robot; the raw frames are kept)"
    )


def counts_text(counts: Mapping[str, int], most: int = _MOST_LISTED) -> str:
    """Return counted things as text, most frequent first.

    Args:
        counts: Name to number.
        most: How many are named.

    Returns:
        E.g. ``101 (20), 102 (10) and 3 more``.
    """
    parts = [f"{name} ({count})" for name, count in Counter(counts).most_common(most)]
    more = len(counts) - len(parts)
    return ", ".join(parts) + (f" and {more} more" if more else "")


def named_identifiers(robot: Robot) -> frozenset[int]:
    """Return the identifiers that a robot's bus map names, :data:`EXTENDED_FLAG` included.

    Args:
        robot: The robot; without a bus there are none.
    """
    if robot.bus is None:
        return frozenset()
    messages = database_messages(dict(robot.databases), Faults()) or {}
    found = (messages.get(signal.message) for signal in robot.bus.signals)
    return frozenset(
        each.frame_id | (EXTENDED_FLAG if each.is_extended_frame else 0) for each in found if each
    )


class IdentifierTally:
    """Data frames by identifier; memory is bounded, however many identifiers there are."""

    MOST = 4096
    """Identifiers that are counted each."""

    def __init__(self) -> None:
        """Start empty."""
        self.frames = 0
        self.counts: Counter[int] = Counter()

    def add(self, frames: FrameArray) -> None:
        """Count frames.

        Args:
            frames: Of any kind, shape (n,); error frames and remote frames carry no data.
        """
        id_flags = frames["id_flags"]
        data = id_flags[(id_flags & np.uint32(ERROR_FLAG | REMOTE_FLAG)) == 0]
        self.frames += len(data)
        found, counts = np.unique(data & np.uint32(EXTENDED_FLAG | ID_MASK), return_counts=True)
        for identifier, count in zip(found.tolist(), counts.tolist(), strict=True):
            if identifier in self.counts or len(self.counts) < self.MOST:
                self.counts[identifier] += count
