"""What a running recording can be asked: requests checked and carried out.

======== ============================================ ==============================================
``do``   further keys                                 what happens
======== ============================================ ==============================================
status                                                the reply says how the recording goes
mark     ``text``, ``level`` (both optional)          ``/rosout``; a ring is written to a file
note     ``text``, ``level`` (optional)               ``/rosout``
split                                                 a new part begins
stop     ``wait`` (optional)                          the recording ends; with ``wait`` the reply
                                                      comes when the file is whole
gait     ``values``, ``t_ns`` (optional)              ``/gait``: what a controller meant, and when
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
from .control import LATER, Handler

OPERATOR = "operator"
"""Who says on ``/rosout`` what came in by the control socket."""

_PLANES = ("horizontal", "vertical")
GAIT_NAMES = tuple(
    f"{plane}.{quantity}"
    for plane in _PLANES
    for quantity in ("A", "omega", "lag", "offset", "phase")
)
"""Values of a plane that ``/gait`` can have; see the log contract. Further values, of joints or of
what a controller does, have names of the same form: ``joint03.A``, ``steer.offset``."""

_FURTHER = re.compile(r"[A-Za-z][A-Za-z0-9_-]*(?:\.[A-Za-z0-9_-]+)+", re.ASCII)

_GAIT_UNIT = "rad, omega in rad/s"
_LEVELS = ("info", "warn", "error")
_LONGEST_TEXT = 4096
_CLOCK_SLACK_NS = 3_600_000_000_000  # a reader takes stamps further off for another clock's

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
    """What the recorder itself does on request."""

    def status(self) -> Mapping[str, Any]:
        """How the recording goes, as plain JSON values.

        Returns:
            At least ``output`` (path), ``elapsed_s``, ``bytes``, ``verdict`` and ``reasons``.
        """
        ...

    def mark(self, text: str) -> Mapping[str, Any]:
        """Mark this moment; the event is in the log already.

        Args:
            text: What the operator says of it; may be empty.

        Returns:
            What the reply says, e.g. ``file`` that a ring writes.

        Raises:
            UndulogError: If it can't be done.
        """
        ...

    def split(self) -> Mapping[str, Any]:
        """Begin a new part.

        Returns:
            What the reply says, e.g. ``part``.

        Raises:
            UndulogError: If this recording has no parts.
        """
        ...

    def stop(self) -> None:
        """End the recording after this tick."""
        ...


class OperatorLog:
    """Writes what people and controllers say during a recording."""

    def __init__(
        self,
        writer: SessionWriter,
        log_event: Callable[[str, str, str], None],
        now_ns: Callable[[], int],
    ) -> None:
        """Nothing is written yet; channels open with their first message.

        Args:
            say: Writes to ``/rosout``: level, who, text.
            now_ns: The session's clock [Unix ns].
        """
        self._writer, self._say, self._now_ns = writer, log_event, now_ns
        self._gait: tuple[tuple[str, ...], JointStateChannel] | None = None
        self._mode: StringChannel | None = None

    def note(self, level: str, text: str) -> None:
        """Write an event to ``/rosout``.

        Args:
            level: ``info``, ``warn`` or ``error``.

        Raises:
            LogWriteError: If it can't be written.
        """
        self._say(level, OPERATOR, text)

    def mode(self, text: str) -> None:
        """Write to ``/gait/mode``.

        Args:
            text: E.g. ``walk``.

        Raises:
            DataError: If a source writes that topic.
            LogWriteError: If it can't be written.
        """
        if self._mode is None:
            self._mode = self._writer.string("/gait/mode")
        self._mode.write(self._now_ns(), text)

    def gait(self, values: Mapping[str, float], t_ns: int | None) -> None:
        """Write one sample to ``/gait``.

        Args:
            values: Name, see :data:`GAIT_NAMES`, to value; the same names throughout a session.
            t_ns: When the controller meant it [Unix ns]; now if None.

        Raises:
            ControlError: If the names are not those of the first sample, or the time is not of
                this session's clock.
            DataError: If a source writes that topic.
            LogWriteError: If it can't be written.
        """
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


def request_handler(actions: RecorderActions, log: OperatorLog) -> Handler:
    """What a :class:`~.capture.recorder.control.ControlServer` hands its requests to.

    Args:
        log: Where notes, modes and gaits go.
    """

    def handle(request: Mapping[str, Any]) -> Any:
        do = _checked(request)
        reply: Any = {}
        if do == "gait":
            log.gait(_gait_values(request), _time(request))
        elif do == "status":
            reply = actions.status()
        elif do == "mark":
            text, level = _text(request, default=""), _level(request)
            log.note(level, f"mark: {text}" if text else "mark")
            reply = actions.mark(text)
        elif do == "note":
            log.note(_level(request), _text(request))
        elif do == "mode":
            log.mode(_text(request))
        elif do == "split":
            reply = actions.split()
        else:
            wait = request.get("wait", False)
            if not isinstance(wait, bool):
                raise _invalid("wait", wait, "true or false")
            actions.stop()
            reply = LATER if wait else {}
        return reply

    return handle


def _checked(request: Mapping[str, Any]) -> str:
    """What is to be done, with no key that it doesn't know."""
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
        found = cast("object", values)
        raise _invalid("values", found, 'an object such as {"horizontal.A": 0.4}')
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


def _invalid(key: str, found: object, valid: str) -> ControlError:
    text = "nothing" if found is None else shown(found)
    text = text if len(text) <= 80 else f"{text[:77]}..."
    return ControlError(f"{key}: found {text}; valid: {valid}")
