"""What is said of artefacts: which of them matter to the analysed stretch, in sentences."""

from __future__ import annotations

from collections.abc import Iterable

from undulog.capture import Session
from undulog.capture.common.console import Warn

from ..response.fitting import GaitFit
from ..results.analysis import JointResult
from ..results.artefact import KINDS, Artefact
from ..signals.windows import Stretch

_NS = 1e9


def within(
    artefacts: Iterable[Artefact], session: Session, stretch: Stretch
) -> tuple[Artefact, ...]:
    """The artefacts that hold in the analysed stretch.

    Args:
        artefacts: Of the whole session.
        session: The session.
        stretch: What is analysed.

    Returns:
        Those of them.
    """
    start_s, stop_s = ((t - session.start_ns) / _NS for t in (stretch.start_ns, stretch.stop_ns))
    return tuple(one for one in artefacts if one.within(start_s, stop_s))


def warn_flags(
    artefacts: Iterable[Artefact],
    joints: tuple[JointResult, ...],
    gait: GaitFit | None,
    warn: Warn,
) -> None:
    """Name the joints of each artefact, and whether it is the sensor's, the record's or a limit.

    Args:
        artefacts: Of the analysed stretch.
        joints: The joints' results.
        gait: The fitted gait, or None.
        warn: Takes a sentence for each kind.
    """
    joined: dict[tuple[str, str, str], list[Artefact]] = {}
    for one in artefacts:
        joined.setdefault((one.flag, one.quantity, one.topic), []).append(one)
    for (flag, quantity, topic), same in joined.items():
        if flag == "gaps":  # of the whole session; those that matter are in the joints' flags
            continue
        about, text = KINDS[flag]
        where = f"{quantity} on {topic}" if topic else quantity
        meaning = {
            "sensor": "an artefact of the sensor, not mechanics"
            + ("; gain and lag are null" if same[0].falsifies("position") else ""),
            "sensor or joint": "the sensor or the joint itself, see the answer"
            + ("; gain and lag are null" if same[0].falsifies("position") else ""),
            "record": "an artefact of the record, not mechanics",
            "limit": "a limit of the robot, not a fault of the sensor",
        }[about]
        notes = ", ".join(dict.fromkeys(one.note for one in same if one.note))
        told = f"{flag}, {notes}" if notes else flag
        warn(f"{', '.join(one.joint for one in same)}: {where}: values {text} ({told}): {meaning}")
    holed = [joint.name for joint in joints if "gaps" in joint.flags]
    if holed:
        warn(f"{', '.join(holed)}: positions have gaps (an artefact of the record, not mechanics)")
    lost = [
        joint.name
        for joint in joints
        if gait is not None and joint.name in gait.all_answered and joint.lag_rad.value is None
    ]
    if lost:
        warn(
            f"{', '.join(lost)}: no response at the gait frequency that can be told from noise: "
            "gain and lag are null"
        )
