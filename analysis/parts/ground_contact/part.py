"""The part that finds which links are on the ground."""

from __future__ import annotations

from ...common.remarks import Remarks
from ...signals.session_signals import Signals
from ..artefacts.part import ARTEFACTS
from ..gait.part import GAIT
from ..part import Part, Results
from .measure import ground_contact
from .result import GroundContact


def _ground_contact(signals: Signals, done: Results, remarks: Remarks) -> GroundContact | None:
    sound, span = done[ARTEFACTS].sound, done[GAIT].span
    return ground_contact(signals.session, signals.columns, sound, span=span, warn=remarks)


GROUND_CONTACT = Part("ground_contact", _ground_contact, ("artefacts", "gait"))

PARTS = (GROUND_CONTACT,)
