"""The part that measures how joints follow commands that are no gait."""

from __future__ import annotations

import dataclasses

from ...common.remarks import Remarks
from ...signals.columns import by_plane
from ...signals.session_signals import Signals
from ..artefacts.part import ARTEFACTS
from ..gait.part import GAIT
from ..judgement.part import JUDGEMENT
from ..part import Part, Results
from .gait import gait_offsets
from .measure import Tracked, track_joints


def _tracking(signals: Signals, done: Results, remarks: Remarks) -> Tracked:
    """Measure how joints follow commands that are no gait, and compare those of one plane.

    Of a gait's joints only the offsets are measured here.

    Beside a gait they aren't compared: it is a few joints whose commands are none. Frames of made
    times hold what was sampled earlier or later: their joints aren't compared either, nor are those
    that the judgement names.
    """
    if remarks.refused:
        return Tracked()
    gait, sound, follows = done[GAIT].fit, done[ARTEFACTS].sound, done[JUDGEMENT].following
    answered = () if gait is None else gait.all_answered
    others = {name: series for name, series in signals.commands.items() if name not in answered}
    alone = follows.in_frames or gait is not None
    planes = by_plane(signals.robot, () if alone else others).values()
    judged = follows.judgement
    statements = (*judged.faults, *judged.changes, *judged.extra, *judged.apart)
    tracked = track_joints(others, sound, planes, {statement.joint for statement in statements})
    offsets = {} if gait is None else gait_offsets(gait, sound)
    return dataclasses.replace(tracked, offsets=offsets)


TRACKING = Part("tracking", _tracking, ("judgement", "artefacts", "gait"), of_commands=True)

PARTS = (TRACKING,)
