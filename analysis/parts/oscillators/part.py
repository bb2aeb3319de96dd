"""The parts on the controller's oscillators: the loop through the body, and couplings."""

from __future__ import annotations

from ...common.remarks import Remarks
from ...signals.session_signals import Signals
from ..frequency_response.part import FREQUENCY_RESPONSE
from ..part import Part, Results
from .measure import closed_loop, session_couplings
from .result import ChainCoupling


def _closed_loop(signals: Signals, done: Results, remarks: Remarks) -> str | None:
    responses = done[FREQUENCY_RESPONSE]
    return closed_loop(signals.session, signals.options, responses, remarks)


CLOSED_LOOP = Part("closed_loop", _closed_loop, ("frequency_response",))


def _oscillators(signals: Signals, done: Results, remarks: Remarks) -> tuple[ChainCoupling, ...]:
    options = signals.options
    return session_couplings(signals.session, options.start_s, options.stop_s)


OSCILLATORS = Part("oscillators", _oscillators)

PARTS = (
    CLOSED_LOOP,
    OSCILLATORS,
)
