"""The part that fits the gait of each window in which it is constant."""

from __future__ import annotations

from ...common.remarks import Remarks
from ...signals.session_signals import Signals
from ..artefacts.part import ARTEFACTS
from ..gait.part import GAIT
from ..part import Part, Results
from .measure import FittedGait, gaits_in_windows


def _gaits(signals: Signals, done: Results, remarks: Remarks) -> list[FittedGait]:
    """Fit the gait of each window in which it is constant."""
    columns, longest = signals.columns, done[GAIT].fit
    whole = done[ARTEFACTS].whole
    return gaits_in_windows(columns, signals.choice, longest, whole, signals.start_ns)


GAITS = Part("gaits", _gaits, ("artefacts", "gait"))

PARTS = (GAITS,)
