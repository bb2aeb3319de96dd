"""The part that measures dead bands."""

from __future__ import annotations

from collections.abc import Mapping

from ...common.remarks import Remarks
from ...signals.session_signals import Signals
from ..artefacts.part import ARTEFACTS
from ..gait.part import GAIT
from ..judgement.measure import (
    stopped,
)
from ..judgement.part import JUDGEMENT
from ..part import Part, Results
from .measure import dead_bands
from .result import DeadBand


def _dead_bands(signals: Signals, done: Results, remarks: Remarks) -> Mapping[str, DeadBand]:
    """Measure dead bands; plateaus of stopped joints are none."""
    still = stopped(done[JUDGEMENT].faulty)
    moving = {n: series for n, series in done[ARTEFACTS].sound.items() if n not in still}
    fit = done[GAIT].fit
    return dead_bands(signals.columns, signals.commands, moving, fit, signals.origin_ns)


DEAD_BAND = Part("dead_band", _dead_bands, ("judgement", "artefacts", "gait"), of_commands=True)

PARTS = (DEAD_BAND,)
