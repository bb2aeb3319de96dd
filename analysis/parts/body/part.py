"""The part that measures motion and shape of the whole body."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

from ...common.remarks import Remarks
from ...signals.session_signals import Signals
from ..artefacts.part import ARTEFACTS
from ..gait.part import GAIT
from ..part import Part, Results
from .motion import body_motion
from .result import BodyResult
from .shape import MeasuredShape, body_shape


@dataclass(frozen=True)
class MeasuredBody:
    """What is measured of the whole body."""

    motion: BodyResult | None = None
    measured: MeasuredShape = dataclasses.field(default_factory=MeasuredShape)


def _body(signals: Signals, done: Results, remarks: Remarks) -> MeasuredBody:
    session, responses = signals.session, signals.responses
    sound, gait = done[ARTEFACTS].sound, done[GAIT]
    fit, span = gait.fit, gait.span
    return MeasuredBody(
        motion=body_motion(session, sound, fit, span, remarks),
        measured=body_shape(session, responses, sound, fit, span=span, warn=remarks),
    )


BODY = Part("body", _body, ("artefacts", "gait"))

PARTS = (BODY,)
