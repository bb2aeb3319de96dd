"""The part that measures responses cycle by cycle."""

from __future__ import annotations

from ...common.remarks import Remarks
from ...signals.session_signals import Signals
from ..artefacts.part import ARTEFACTS
from ..part import Part, Results
from .measure import response_over_time
from .result import ResponseOverTime


def _over_time(signals: Signals, done: Results, remarks: Remarks) -> ResponseOverTime | None:
    return response_over_time(signals.session, signals.columns, done[ARTEFACTS].whole, remarks)


OVER_TIME = Part("over_time", _over_time, ("artefacts",))

PARTS = (OVER_TIME,)
