"""The part that puts together what is measured of each joint."""

from __future__ import annotations

from collections.abc import Iterable

from undulog.capture.common.console import Warn

from ...common.remarks import Remarks
from ...response.fitting import GaitFit
from ...signals.session_signals import Signals
from ..artefacts.part import ARTEFACTS
from ..artefacts.result import Artefact, flags_by_joint
from ..artefacts.show import warnings_of
from ..dead_band.part import DEAD_BAND
from ..energy.part import ENERGIES
from ..gait.part import GAIT
from ..part import Part, Results
from ..tracking.part import TRACKING
from .measure import joint_results
from .result import JointResult


def _joints(signals: Signals, done: Results, remarks: Remarks) -> tuple[JointResult, ...]:
    held, gait = done[ARTEFACTS].window, done[GAIT]
    joints = joint_results(
        signals.robot,
        signals.columns,
        responses=signals.responses,
        gait=gait.fit,
        energies=done[ENERGIES].joints,
        flags=flags_by_joint(held),
        dead=done.get(DEAD_BAND, {}),
        offsets=done[TRACKING].offsets,
        span=gait.span,
    )
    _warn_flags(held, joints, gait.fit, remarks)
    return joints


def _warn_flags(
    artefacts: Iterable[Artefact], joints: tuple[JointResult, ...], gait: GaitFit | None, warn: Warn
) -> None:
    """Warn of artefacts, and of responses lost in noise."""
    for sentence in warnings_of(artefacts):
        warn(sentence)
    if holed := [joint.name for joint in joints if "gaps" in joint.flags]:
        warn(f"{', '.join(holed)}: positions have gaps (an artefact of the record, not mechanics)")
    answered = () if gait is None else gait.all_answered
    silent = [joint.name for joint in joints if joint.lag_rad.value is None]
    if lost := [name for name in silent if name in answered]:
        warn(
            f"{', '.join(lost)}: no response at the gait frequency that differs from noise: "
            "gain and lag are null"
        )


JOINTS = Part("joints", _joints, ("artefacts", "gait", "tracking", "energies"), ("dead_band",))

PARTS = (JOINTS,)
