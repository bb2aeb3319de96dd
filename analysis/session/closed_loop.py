"""Do the commands depend on what the sensors measured?

Where a controller feeds measured motion back into the commands, it feeds back the sensors' noise,
too. With commands u = C (r - y) and positions y = G u + v the response estimated from u to y tends,
where v has the larger power, to -1 / C, the inverse of the controller, instead of G (Forssell &
Ljung, Automatica 35, 1999, doi 10.1016/S0005-1098(99)00022-9).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from undulog.capture import SessionView
from undulog.capture.common.console import Warn
from undulog.capture.common.errors import DataError, LogError

from ..oscillators.chain import session_couplings
from ..results.answer import Note
from ..results.estimate import leaves_out_zero
from ..results.frequency_response import DIRECT, INDIRECT, JointFrequencyResponse
from ..signals.stretch import GAIT_TOPIC, Options

_ADAPTIVE = {
    "steer": "steering",
    "shrink": "amplitudes by obstacles beside it",
    "haste": "frequency by an obstacle behind it",
    "course": "course",
}
"""First parts of the names on ``/gait`` that only a controller logs."""


def closed_loop(
    session: SessionView,
    options: Options,
    responses: Sequence[JointFrequencyResponse],
    warn: Warn,
) -> str | None:
    """Find what makes the commands depend on measured motion, and warn of its bias.

    Args:
        responses: The frequency responses; those by the indirect method have no such bias.

    Returns:
        A noun phrase, or None where the log shows nothing of the kind.
    """
    if not responses:
        if options.excitation_topic is not None:
            warn(f"{options.excitation_topic}: not used, as there are no frequency responses")
        return None
    cause = _cause(session, options)
    direct = [one.joint for one in responses if one.method == DIRECT]
    if indirect := [one.joint for one in responses if one.method == INDIRECT]:
        warn(
            Note(
                f"{', '.join(indirect)}: frequency response by the indirect method, response over "
                f"command, each to {options.excitation_topic}: noise that a loop feeds back does "
                "not bias it"
            )
        )
    if direct and options.excitation_topic is not None:
        warn(
            f"{', '.join(direct)}: no samples that move on {options.excitation_topic}; the "
            "frequency response is by the direct method"
        )
    if cause is not None and direct:
        warn(
            f"the commands depend on measured motion, through {cause}: noise that the loop feeds "
            "back biases a frequency response from command to position towards the inverse of the "
            "controller; record with commands from a plan instead, or name the topic of what the "
            "commands follow from outside (--excitation-topic)"
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
