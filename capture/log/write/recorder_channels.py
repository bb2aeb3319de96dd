"""Channels of what a recorder says of itself: its sources' clocks and its health."""

from __future__ import annotations

import struct
from collections.abc import Sequence

from ...common.errors import DataError
from ..messages.cdr import encode
from ..messages.schemas import message_type
from ..messages.topics import DiagnosticStatus
from .channels import Send, Template

_TIME = struct.Struct("<iI")
_NS = 1_000_000_000


class TimeReferenceChannel:
    """A device's clock against the host's."""

    def __init__(self, template: Template) -> None:
        """Wrap a template."""
        self._template = template
        self._stamps = (template.leaves["header.stamp.sec"].offset,)
        self._reference = template.leaves["time_ref.sec"].offset

    def write(self, t_host_ns: int, t_device_ns: int, *, log_time_ns: int | None = None) -> None:
        """Write one pair of times.

        Args:
            t_host_ns: Host time [Unix ns].
            t_device_ns: The device's own time at that moment [ns since its own epoch]; 0 to
                2**31 s.
            log_time_ns: Time of recording [Unix ns]; the host time if None.

        Raises:
            DataError: If the message can't hold the device's time.
            LogWriteError: If the file can't be written.
        """
        try:
            _TIME.pack_into(self._template.message, self._reference, *divmod(t_device_ns, _NS))
        except struct.error as error:
            raise DataError(
                f"a device time of {t_device_ns} ns doesn't fit 32 bits of s"
            ) from error
        self._template.emit(t_host_ns, log_time_ns, self._stamps)


class DiagnosticsChannel:
    """The states of the recorder's components."""

    def __init__(self, send: Send) -> None:
        """Wrap what writes a message."""
        self._send = send

    def write(self, t_ns: int, statuses: Sequence[DiagnosticStatus]) -> None:
        """Write the states of one moment.

        Args:
            t_ns: When [Unix ns].
            statuses: One a component.

        Raises:
            LogWriteError: If the file can't be written.
        """
        seconds, nanoseconds = divmod(t_ns, _NS)
        values = {
            "header": {"stamp": {"sec": seconds, "nanosec": nanoseconds}},
            "status": [
                {
                    "level": status.level,
                    "name": status.name,
                    "message": status.message,
                    "hardware_id": status.hardware_id,
                    "values": [{"key": k, "value": v} for k, v in status.values.items()],
                }
                for status in statuses
            ],
        }
        self._send(t_ns, t_ns, encode(message_type("diagnostic_msgs/msg/DiagnosticArray"), values))
