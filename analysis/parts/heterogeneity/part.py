"""The part that measures indices of heterogeneity."""

from __future__ import annotations

from ...common.remarks import Remarks
from ...signals.session_signals import Signals
from ..energy.part import ENERGIES
from ..gait.part import GAIT
from ..joints.part import JOINTS
from ..part import Part, Results
from .measure import heterogeneity_indices
from .result import Index


def _heterogeneity(signals: Signals, done: Results, remarks: Remarks) -> dict[str, Index]:
    fit, joints = done[GAIT].fit, done[JOINTS]
    return heterogeneity_indices(signals.robot, fit, joints, done[ENERGIES].joints, remarks)


HETEROGENEITY = Part("heterogeneity", _heterogeneity, ("gait", "energies", "joints"))

PARTS = (HETEROGENEITY,)
