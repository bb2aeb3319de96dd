"""Do the commands depend on what the sensors measured?

Where a controller feeds measured motion back into the commands, it feeds back the sensors' noise,
too. With commands u = C (r - y) and positions y = G u + v the response estimated from u to y tends,
where v has the larger power, to -1 / C, the inverse of the controller, instead of G (Forssell &
Ljung, Automatica 35, 1999, doi 10.1016/S0005-1098(99)00022-9).
"""

from __future__ import annotations

from collections.abc import Iterable

from undulog.capture import SessionView
from undulog.capture.common.console import Warn
from undulog.capture.common.errors import DataError, LogError

from ..oscillators.chain import session_couplings
from ..results.estimate import leaves_out_zero
from ..signals.stretch import GAIT_TOPIC, Options

_ADAPTIVE = {
    "steer": "steering",
    "shrink": "amplitudes by obstacles beside it",
    "haste": "frequency by an obstacle behind it",
    "course": "course",
}
"""First parts of the names on ``/gait`` that only a controller logs."""


def closed_loop(session: SessionView, options: Options, warn: Warn) -> str | None:
    """Find what makes the commands depend on measured motion, and warn of its bias.

    Returns:
        A noun phrase, or None where the log shows nothing of the kind.
    """
    cause = _cause(session, options)
    if cause is not None:
        warn(
            f"the commands depend on measured motion, through {cause}: noise that the loop feeds "
            "back biases a frequency response from command to position towards the inverse of the "
            "controller; record with commands from a plan instead"
        )
    return cause


def _cause(session: SessionView, options: Options) -> str | None:
    if GAIT_TOPIC in session.channels:
        try:
            names = session.joints(GAIT_TOPIC).names
        except (DataError, LogError):
            names = ()  # the warning is given where gain and lag over time are read
        if adaptive := adaptive_parts(names):
            return f"an adaptive controller ({', '.join(adaptive)})"
    chains = session_couplings(session, options.start_s, options.stop_s)
    rates = [rate for chain in chains for rate in chain.oscillators]
    fed = [rate.name for rate in rates if leaves_out_zero(rate.feedback.ci95)]
    return f"oscillators with feedback from their servos ({', '.join(fed)})" if fed else None


def adaptive_parts(names: Iterable[str]) -> list[str]:
    """Return what a controller adapts, by the names that it logs on ``/gait``."""
    logged = {name.partition(".")[0] for name in names}
    return [text for part, text in _ADAPTIVE.items() if part in logged]
