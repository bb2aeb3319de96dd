"""The part that measures a motion without commands."""

from __future__ import annotations

from ...common.remarks import Note, Remarks
from ...signals.session_signals import Signals
from ..body.part import BODY
from ..part import Part, Results
from .measure import free_motion
from .result import FreeMotion

UNDECIDED_ENDS = (
    "without a robot description the order of the joints is that of the record, and which end is "
    "the head is unknown: directions are relative to that order, and whether the wave runs towards "
    "the head or the tail isn't known; a lag from joint to joint is known up to whole turns, the "
    "smallest is given"
)


def _free_motion(signals: Signals, done: Results, remarks: Remarks) -> FreeMotion | None:
    """Measure a motion without commands; None where there are some."""
    if signals.columns.command:
        return None
    moved = done[BODY].measured.motion
    if moved is None:
        return FreeMotion()
    motion, open_phases = free_motion(signals.robot, moved)
    if open_phases:
        remarks(
            f"{', '.join(open_phases)}: no motion at the common frequency that differs from noise: "
            "its phase is null"
        )
    if motion.waves and signals.robot is None:
        remarks(Note(UNDECIDED_ENDS))
    return motion


FREE_MOTION = Part("free_motion", _free_motion, ("body",))

PARTS = (FREE_MOTION,)
