"""The couplings of the oscillators whose phases a session logged."""

from __future__ import annotations

from undulog.capture import Session

from ..results.oscillators import ChainCoupling
from .chain import chain_coupling
from .phase_log import read_phases

_NS = 1e9


def session_couplings(
    session: Session, start_s: float | None = None, stop_s: float | None = None
) -> tuple[ChainCoupling, ...]:
    """Tell the couplings of each plane's oscillators.

    Args:
        session: An open session.
        start_s: From when on, from the session's start [s]; all of it if None.
        stop_s: Until when [s].

    Returns:
        One a plane; none where no oscillator's phase was logged.
    """
    start_ns, stop_ns = (
        None if one is None else session.start_ns + round(one * _NS) for one in (start_s, stop_s)
    )
    return tuple(
        chain_coupling(
            log.plane, log.names, log.phases, log.period_s, whole=log.whole, inputs=log.inputs
        )
        for log in read_phases(session, start_ns, stop_ns)
    )
