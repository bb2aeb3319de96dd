"""Requests to a running recording: checked and carried out.

======== ============================================ ==============================================
``do``   further keys                                 effect
======== ============================================ ==============================================
status                                                the reply has the state of the recording
mark     ``text``, ``level`` (both optional)          ``/rosout``; a ring is written to a file
note     ``text``, ``level`` (optional)               ``/rosout``
split                                                 a new part begins
stop     ``wait`` (optional)                          the recording ends; with ``wait`` the reply
                                                      comes when the file is whole
gait     ``values``, ``t_ns`` (optional)              ``/gait``: commanded parameters and their time
mode     ``text``                                     ``/gait/mode``
======== ============================================ ==============================================
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from typing import Any, Protocol, cast

from ..common.errors import ControlError
from ..common.strict_table import finite_number, listed, shown
from ..log.write.channels import JointStateChannel, StringChannel
from ..log.write.writer import SessionWriter
from .control import Reply

OPERATOR = "operator"
"""Name on ``/rosout`` of the events that come through the control socket."""

_PLANES = ("horizontal", "vertical")
GAIT_NAMES = tuple(
    f"{plane}.{quantity}"
    for plane in _PLANES
    for quantity in ("A", "omega", "lag", "offset", "phase")
)
"""Values of a plane that ``/gait`` can have; see the log contract. Further values, of joints or of
a controller, have names of the same form: ``joint03.A``, ``steer.offset``."""

_FURTHER = re.compile(r"[A-Za-z][A-Za-z0-9_-]*(?:\.[A-Za-z0-9_-]+)+", re.ASCII)

_GAIT_UNIT = "rad, omega in rad/s"
_LEVELS = ("info", "warn", "error")
_LONGEST_TEXT = 4096
_CLOCK_SLACK_NS = 3_600_000_000_000  # readers attribute stamps further off to another clock

_KEYS: Mapping[str, frozenset[str]] = {
    "status": frozenset(),
    "mark": frozenset({"text", "level"}),
    "note": frozenset({"text", "level"}),
    "split": frozenset(),
    "stop": frozenset({"wait"}),
    "gait": frozenset({"values", "t_ns"}),
    "mode": frozenset({"text"}),
}


class RecorderActions(Protocol):
    """Actions of the recorder on request; each raises an UndulogError to refuse."""

    def status(self) -> Reply:
        """Return the state of the recording as plain JSON values."""
        ...

    def mark(self, text: str) -> Reply:
        """Mark this moment; a ring is written to the ``file`` of the reply.

        Args:
            text: Remark of the operator, which may be empty; it is in the log already.
        """
        ...

    def split(self) -> Reply:
        """Begin a new part; the reply has its number, ``part``."""
        ...

    def stop(self) -> None:
        """End the recording after this tick."""


class RequestHandler:
    """Carries out the requests of the control socket."""

    def __init__(
        self,
        actions: RecorderActions,
        writer: SessionWriter,
        log_event: Callable[[str, str, str], None],
        now_ns: Callable[[], int],
    ) -> None:
        """Open no channel before its first message.

        Args:
            log_event: Writes to ``/rosout``: level, name, text.
            now_ns: The session's clock [Unix ns].
        """
        self._actions, self._log_event = actions, log_event
        self._writer, self._now_ns = writer, now_ns
        self._gait: tuple[tuple[str, ...], JointStateChannel] | None = None
        self._mode: StringChannel | None = None

    def __call__(self, request: Mapping[str, Any]) -> Reply | None:
        """Carry out a request.

        Returns:
            The reply; None if it comes with the end of the recording.

        Raises:
            UndulogError: If the request has a fault, or can't be carried out.
        """
        do = _checked(request)
        if do == "status":
            return self._actions.status()
        if do == "mark":
            text, level = _text(request, default=""), _level(request)
            self._log_event(level, OPERATOR, f"mark: {text}" if text else "mark")
            return self._actions.mark(text)
        if do == "split":
            return self._actions.split()
        if do == "stop":
            return self._stop(request)
        if do == "note":
            self._log_event(_level(request), OPERATOR, _text(request))
        elif do == "mode":
            self._write_mode(_text(request))
        else:
            self._write_gait(_gait_values(request), _time(request))
        return {}

    def _stop(self, request: Mapping[str, Any]) -> Reply | None:
        wait = request.get("wait", False)
        if not isinstance(wait, bool):
            raise _invalid("wait", wait, "true or false")
        self._actions.stop()
        return None if wait else {}

    def _write_mode(self, text: str) -> None:
        if self._mode is None:
            self._mode = self._writer.string("/gait/mode")
        self._mode.write(self._now_ns(), text)

    def _write_gait(self, values: Mapping[str, float], t_ns: int | None) -> None:
        """Write one sample to ``/gait``; the names must be those of the session's first sample."""
        now_ns = self._now_ns()
        if t_ns is not None and abs(t_ns - now_ns) > _CLOCK_SLACK_NS:
            off_s = (t_ns - now_ns) / 1e9
            raise ControlError(
                f"t_ns: found {t_ns}, {off_s:+.0f} s off this recorder's clock; "
                "valid: Unix time in ns"
            )
        if self._gait is None:
            of_planes = [name for name in GAIT_NAMES if name in values]
            names = tuple(dict.fromkeys([*of_planes, *values]))
            self._gait = names, self._writer.joint_state("/gait", names, unit=_GAIT_UNIT)
        names, channel = self._gait
        if set(values) != set(names):
            raise ControlError(
                f"values: found {', '.join(values)}; valid: {', '.join(names)}, "
                "the names that this session's gait began with"
            )
        row = [values[name] for name in names]
        channel.write(now_ns if t_ns is None else t_ns, row, log_time_ns=now_ns)


def _checked(request: Mapping[str, Any]) -> str:
    """Return the action of a request that has valid keys only."""
    do = request.get("do")
    if not isinstance(do, str) or do not in _KEYS:
        raise _invalid("do", do, listed(_KEYS, do))
    for key in request:
        if key != "do" and key not in _KEYS[do]:
            raise _invalid(key, request[key], f"{do} has {listed(sorted(_KEYS[do]), key)}")
    return do


def _text(request: Mapping[str, Any], *, default: str | None = None) -> str:
    text = request.get("text", default)
    if not isinstance(text, str) or len(text) > _LONGEST_TEXT or not _writable(text):
        raise _invalid("text", text, f"text of at most {_LONGEST_TEXT} characters")
    if not text.strip() and default is None:
        raise _invalid("text", text, "text that is not empty")
    return text


def _writable(text: str) -> bool:
    """Whether a message can hold it: no zero, no half of a surrogate pair."""
    return "\0" not in text and not any("\ud800" <= letter <= "\udfff" for letter in text)


def _level(request: Mapping[str, Any]) -> str:
    level = request.get("level", "info")
    if not isinstance(level, str) or level not in _LEVELS:
        raise _invalid("level", level, listed(_LEVELS, level))
    return level


def _time(request: Mapping[str, Any]) -> int | None:
    t_ns = request.get("t_ns")
    if t_ns is not None and (not isinstance(t_ns, int) or isinstance(t_ns, bool)):
        raise _invalid("t_ns", t_ns, "Unix time in ns, a whole number")
    return t_ns


def _gait_values(request: Mapping[str, Any]) -> dict[str, float]:
    values: object = request.get("values")
    if not isinstance(values, dict) or not values:
        raise _invalid("values", cast("object", values), 'an object such as {"horizontal.A": 0.4}')
    checked: dict[str, float] = {}
    for name, value in cast("dict[str, object]", values).items():
        if not _is_gait_name(name):
            others = "others as NAME.VALUE, e.g. joint03.A"
            raise _invalid("values", name, f"{listed(GAIT_NAMES, name)}; {others}")
        number = math.nan if value is None else finite_number(value)
        if number is None:
            raise _invalid(f"values.{name}", value, "a finite number, or null for none")
        checked[name] = number
    return checked


def _is_gait_name(name: str) -> bool:
    if name.partition(".")[0] in _PLANES:
        return name in GAIT_NAMES
    return _FURTHER.fullmatch(name) is not None


def _invalid(key: str, actual: object, valid: str) -> ControlError:
    text = "nothing" if actual is None else shown(actual)
    text = text if len(text) <= 80 else f"{text[:77]}..."
    return ControlError(f"{key}: found {text}; valid: {valid}")
