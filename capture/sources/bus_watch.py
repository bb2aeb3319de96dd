"""What error frames say: a node in trouble, a controller off the bus and back.

An error frame is one with :data:`.ERROR_FLAG`; its identifier holds the classes
of error and its data the details, as in ``linux/can/error.h``.
"""

from __future__ import annotations

import numpy as np

from ..log.messages.frames import ERROR_FLAG, ID_MASK, FrameArray
from .contract import DEVICE_TIMES_END_NS
from .events import ODD_TIME, Tally

BUS_OFF = 0x40
"""Error class: the controller left the bus."""
RESTARTED = 0x100
"""Error class: the controller is back."""

_CLASSES = {
    0x001: "transmit time-out",
    0x002: "lost arbitration",
    0x004: "controller problem",
    0x008: "protocol violation",
    0x010: "transceiver problem",
    0x020: "no acknowledgement",
    0x080: "bus error",
    0x200: "error counters changed",
}
_CONTROLLER = 0x004
_CONTROLLER_STATES = {
    0x01: "receive buffer overflow",
    0x02: "transmit buffer overflow",
    0x04: "reception warning level",
    0x08: "transmission warning level",
    0x10: "reception error passive",
    0x20: "transmission error passive",
    0x40: "error active again",
}


class BusWatch:
    """Counts error frames, and tells what they mean, and impossible device times."""

    def __init__(self) -> None:
        """Start with a bus that is well."""
        self._off = False

    def look(self, frames: FrameArray, tally: Tally) -> None:
        """Look through frames.

        Args:
            frames: What came, in order.
            tally: Where to count and tell.
        """
        t_ns = frames["t_device_ns"]
        if t_ns.max(initial=0) >= DEVICE_TIMES_END_NS:
            odd = int((t_ns >= np.uint64(DEVICE_TIMES_END_NS)).sum())
            tally.malformed(ODD_TIME, odd)
        ids = frames["id_flags"]
        if not np.bitwise_or.reduce(ids) & ERROR_FLAG:
            if self._off and len(ids):
                self._back(tally)
            return
        is_error = (ids & ERROR_FLAG) != 0
        places = np.flatnonzero(is_error).tolist()
        tally.counts.error_frames += len(places)
        before = -1
        for place in places:
            if place > before + 1:
                self._hear(tally)
            frame = frames[place]
            self._tell(int(frame["id_flags"]) & ID_MASK, frame["data"].tolist(), tally)
            before = place
        if len(frames) > before + 1:
            self._hear(tally)

    def _hear(self, tally: Tally) -> None:
        """An ordinary frame came: whoever was off the bus is on it."""
        if self._off:
            self._back(tally)

    def _tell(self, classes: int, data: list[int], tally: Tally) -> None:
        if classes & RESTARTED:
            self._off = True  # even if the frame that said so was missed
            self._back(tally)
        if classes & BUS_OFF and not self._off:
            self._off = True
            tally.events.say("error", "bus-off: the controller left the bus")
        said = [text for bit, text in _CLASSES.items() if classes & bit]
        if classes & _CONTROLLER:
            said += [text for bit, text in _CONTROLLER_STATES.items() if data[1] & bit]
        if said or not classes & (RESTARTED | BUS_OFF):
            tally.events.say("warn", f"error frame: {', '.join(said) or 'no class given'}")

    def _back(self, tally: Tally) -> None:
        self._off = False
        tally.events.say("info", "the controller is back on the bus")
