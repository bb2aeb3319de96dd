"""A motion without commands as tables."""

from __future__ import annotations

import math
from collections.abc import Sequence

from ...common.formats import degrees
from ..shown import Column, Table, typical
from .result import BodyWave, JointMotion, LocalWaveNumber


def motion_table(motions: Sequence[JointMotion]) -> Table[JointMotion]:
    """Return amplitude, offset and lag of joints that move without commands."""
    with_planes = any(motion.plane for motion in motions)
    angle, lag = typical(2, 4), "lag behind the one before"
    columns: list[Column[JointMotion]] = [
        Column("joint", "joint", lambda motion: motion.name, kind="word"),
        *(
            [Column("plane", "plane", lambda motion: motion.plane, kind="word")]
            if with_planes
            else []
        ),
        Column(
            "amplitude° (95 %)",
            "amplitude [°]",
            lambda motion: degrees(motion.amplitude_rad),
            angle,
        ),
        Column(
            "offset° (95 %)",
            "offset [°]",
            lambda motion: degrees(motion.offset_rad),
            angle,
            spare=1,
        ),
        Column(f"{lag}° (95 %)", f"{lag} [°]", lambda motion: degrees(motion.lag_rad), angle),
    ]
    return Table(columns, motions)


def local_waves_table(waves: Sequence[BodyWave]) -> Table[LocalWaveNumber]:
    """Return wave numbers between neighbouring joints, of waves whose phases are on no line."""
    columns: list[Column[LocalWaveNumber]] = [
        Column("from", "from", lambda part: part.joint, kind="word"),
        Column("to", "to", lambda part: part.next_joint, kind="word"),
        Column(
            "°/joint (95 %)",
            "local wave number [°/joint]",
            lambda part: degrees(part.wave_number),
            typical(2, 4),
        ),
    ]
    about = {
        "local wave number [°/joint]": "lag of a joint behind the one before it, over the joints "
        "between them; of phases that are on no line"
    }
    return Table(columns, [part for wave in waves for part in wave.local], about=about)


def wave_table(waves: Sequence[BodyWave]) -> Table[BodyWave]:
    """Return the waves along the body, one a plane."""

    def way(wave: BodyWave) -> str:
        first, last = wave.joints[0], wave.joints[-1]
        if wave.direction == "undecided":
            return f"undecided, {first} and {last}"
        return f"{first} to {last}" if wave.direction == "first-to-last" else f"{last} to {first}"

    def off(wave: BodyWave) -> float:
        return math.degrees(wave.deviation_rad)

    with_planes = any(wave.plane for wave in waves)
    angle, share = typical(2, 4), typical(3, 4)
    columns: list[Column[BodyWave]] = [
        *([Column("plane", "plane", lambda wave: wave.plane, kind="word")] if with_planes else []),
        Column("wave", "wave", way, kind="word"),
        Column(
            "°/joint (95 %)", "wave number [°/joint]", lambda wave: degrees(wave.wave_number), angle
        ),
        Column("waves (95 %)", "waves", lambda wave: wave.waves, share),
        Column("joints/s (95 %)", "speed [joints/s]", lambda wave: wave.speed, typical(2, 3)),
        Column("m/s", "speed [m/s]", lambda wave: wave.speed_m_s, share, spare=1),
        Column(
            "travelling (95 %)", "travelling index [1]", lambda wave: wave.travelling_index, share
        ),
        Column("off the line°", "off the line [°]", off, (1, 2), spare=2),
    ]
    about = {
        "wave number [°/joint]": "lag from joint to joint, of a line through the phases",
        "travelling index [1]": "1 of a travelling, 0 of a standing wave",
        "off the line [°]": "root mean square of the phases about the line",
    }
    return Table(columns, waves, about=about)
