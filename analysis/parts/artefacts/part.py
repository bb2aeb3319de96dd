"""The part that finds what is wrong with samples, or at a limit."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from ...common.remarks import Remarks
from ...estimators.series import Series
from ...signals.session_signals import Signals
from ..judgement.part import JUDGEMENT
from ..part import Part, Results
from .measure import find_artefacts
from .refuted import unrefuted
from .result import Artefact


@dataclass(frozen=True)
class Artefacts:
    """What is wrong with samples or at a limit.

    Attributes:
        whole: Of the whole session.
        window: Those in the window.
        sound: Positions in the window of the joints whose positions are not falsified.
    """

    whole: tuple[Artefact, ...]
    window: tuple[Artefact, ...]
    sound: Mapping[str, Series]


def _artefacts(signals: Signals, done: Results, remarks: Remarks) -> Artefacts:
    suspected = find_artefacts(signals.session, signals.columns)
    artefacts = unrefuted(suspected, done[JUDGEMENT].following)
    limits_s = signals.window.since(signals.start_ns)
    held = tuple(artefact for artefact in artefacts if artefact.within(*limits_s))
    false = [artefact.joint for artefact in held if artefact.falsifies("position")]
    sound = {name: series for name, series in signals.responses.items() if name not in false}
    return Artefacts(artefacts, held, sound)


ARTEFACTS = Part("artefacts", _artefacts, ("judgement",))

PARTS = (ARTEFACTS,)
