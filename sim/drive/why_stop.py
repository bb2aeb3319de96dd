"""Why a drive is to stop, in words."""

from __future__ import annotations

import signal

from undulog.capture.common.interruption import StopRequest

_WORDS = {
    signal.SIGINT: "asked to stop (Ctrl-C)",
    signal.SIGTERM: "asked to stop (SIGTERM)",
    signal.SIGHUP: "the console is gone",
}


def why_stop(stop: StopRequest, *, console_gone: bool) -> str:
    """Why it is to stop.

    Args:
        stop: What signals asked for.
        console_gone: Whether the terminal hung up.

    Returns:
        A few words; empty if it is not to stop.
    """
    if stop.signal is not None:
        return _WORDS.get(stop.signal, f"asked to stop ({stop.signal.name})")
    return _WORDS[signal.SIGHUP] if console_gone else ""
