"""The part that measures frequency responses where there is no gait."""

from __future__ import annotations

from ...common.remarks import Remarks
from ...signals.session_signals import Signals
from ...signals.stretch import series_in
from ..artefacts.part import ARTEFACTS
from ..gait.part import GAIT
from ..part import Part, Results
from .measure import frequency_responses
from .result import JointFrequencyResponse


def _frequency_response(
    signals: Signals, done: Results, remarks: Remarks
) -> tuple[JointFrequencyResponse, ...]:
    if done[GAIT].fit is not None or remarks.refused:
        return ()
    columns, window = signals.columns, signals.window
    excitation = series_in(columns.names, columns.excitation, window, signals.origin_ns)
    return frequency_responses(signals.commands, done[ARTEFACTS].sound, remarks, excitation)


FREQUENCY_RESPONSE = Part(
    "frequency_response", _frequency_response, ("artefacts", "gait"), of_commands=True
)

PARTS = (FREQUENCY_RESPONSE,)
