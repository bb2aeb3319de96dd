"""Tracking as a table."""

from __future__ import annotations

from collections.abc import Sequence

from ...common.formats import degrees, scaled
from ..shown import Column, Table, typical
from .result import JointTracking


def tracking_table(joints: Sequence[JointTracking]) -> Table[JointTracking]:
    """Return gain, lag and offset by joint."""

    def model(joint: JointTracking) -> str:
        poles = ("delay", "delay and a pole", "delay and two poles")[joint.poles]
        return f"{poles}, held" if joint.held else poles

    columns: list[Column[JointTracking]] = [
        Column("joint", "joint", lambda joint: joint.joint, kind="word"),
        Column("gain (95 %)", "gain [1]", lambda joint: joint.gain, typical(2, 4)),
        Column("lag ms (95 %)", "lag [ms]", lambda joint: scaled(joint.lag_s, 1e3), typical(2, 3)),
        Column(
            "offset deg (95 %)",
            "offset [deg]",
            lambda joint: degrees(joint.offset_rad),
            typical(2, 3),
        ),
        Column("model", "model", model, kind="word", spare=3),
        Column(
            "explained %", "explained [%]", lambda joint: 100 * joint.explained, (1, 2), spare=2
        ),
    ]
    about = {
        "gain [1]": "of slow motion, response over command",
        "lag [ms]": "of slow motion: delay and time constants, with the offset of the clocks",
        "offset [deg]": "mean of the position less that of the delayed command",
        "model": "what explains the motion; held: each command holds until the next",
    }
    return Table(columns, joints, about=about)
