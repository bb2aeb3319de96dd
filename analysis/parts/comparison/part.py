"""The part that compares the joints."""

from __future__ import annotations

from ...common.remarks import Remarks
from ...signals.session_signals import Signals
from ..gait.part import GAIT
from ..gaits.part import GAITS
from ..joints.part import JOINTS
from ..judgement.part import JUDGEMENT
from ..part import Part, Results
from ..tracking.part import TRACKING
from .examine import Findings
from .measure import compare_joints


def _comparison(signals: Signals, done: Results, remarks: Remarks) -> Findings:
    """Compare joints: those of a gait over all its windows, others by how they track."""
    gait, judged = done[GAIT].fit, done[JUDGEMENT]
    if gait is None:
        return Findings(stand_out=done[TRACKING].stand_out)
    return compare_joints(
        signals.robot,
        [window.fit for window in done[GAITS]] or [gait],
        done[JOINTS],
        faulty=judged.faulty,
        commanded=signals.columns.commanded(),
        offsets=judged.following.offsets,
    )


COMPARISON = Part("comparison", _comparison, ("judgement", "gait", "tracking", "gaits", "joints"))

PARTS = (COMPARISON,)
