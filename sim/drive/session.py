"""The session of a drive over a bus: requested and sent commands, and received frames.

A running recorder receives the gait's values for ``/gait`` and ``/gait/mode``. It answers once a
tick of its own, so a thread sends the requests: the control loop only queues them. A recorder that
exits, refuses or is slow never delays the loop.
"""

from __future__ import annotations

import math
import threading
import uuid
from collections import deque
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from undulog.capture.common.errors import ControlError, LogWriteError
from undulog.capture.log.messages.frames import FrameArray
from undulog.capture.log.wal.segment import require_space
from undulog.capture.log.write.channels import StringChannel
from undulog.capture.log.write.durable_sink import DurableSink
from undulog.capture.log.write.writer import SessionWriter
from undulog.capture.recorder.bus_recorder import BusRecorder
from undulog.capture.recorder.control_client import ControlClient
from undulog.capture.recorder.source_clock import SourceClock
from undulog.capture.robot.model import ClockDomain
from undulog.capture.sources.contract import DEVICE_TIMES_END_NS

from ..gait.contract import GaitTick
from ..twin.session_log import GAIT_UNIT
from .loop import BusTick
from .outcome import DriveEnding, GateEvent, Outcome
from .report import BusPlan

_MOST_HELD = 1000
_AT_ONCE = 64
_WAIT_S = 0.02
_LAST_S = 5.0

_EVENTS_OF = "drive"
_DECODE_TICKS = 10  # many frames at once cost little more than a few
# So much has to be free [byte]: what the write-ahead log reserves, and a part of a minute.
_ROOM = 48 << 20
# So much of an ending is kept on a full disk [byte]: more than ten seconds of 25 joints.
_LAST_WORDS = 4 << 20


class GaitPublisher:
    """One connection to a recorder's control socket.

    Attributes:
        taken: Samples of the gait that the recorder took.
        dropped: Samples that it had no time for.
        error: Why nothing more is sent; None while it is.
    """

    def __init__(self, path: Path, names: Sequence[str]) -> None:
        """Connect.

        Args:
            path: The recorder's control socket.
            names: Names of the gait's values.

        Raises:
            ControlError: If nobody listens there.
        """
        self.taken = self.dropped = 0
        self.error: str | None = None
        self._client = ControlClient(path)
        self._names = tuple(names)
        self._mode = ""
        self._held: deque[Mapping[str, Any]] = deque()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="undulog-gait", daemon=True)
        self._thread.start()

    def note(self, text: str, level: str = "info") -> None:
        """Queue an event for ``/rosout``.

        Args:
            level: ``info``, ``warn`` or ``error``.
        """
        self._held.append({"do": "note", "text": text, "level": level})

    def publish(self, tick: GaitTick, t_ns: int) -> None:
        """Queue the gait's values, without waiting.

        Args:
            t_ns: From when on it holds [Unix ns].
        """
        if tick.mode != self._mode:
            self._mode = tick.mode
            self._held.append({"do": "mode", "text": tick.mode})
        if not self._names or self.error is not None:
            return
        if len(self._held) >= _MOST_HELD:
            self.dropped += 1
            return
        values: list[float] = tick.values.tolist()
        taken = [value if math.isfinite(value) else None for value in values]  # as JSON has it
        named = dict(zip(self._names, taken, strict=True))
        self._held.append({"do": "gait", "values": named, "t_ns": t_ns})

    def close(self) -> None:
        """Send the rest, for a few seconds, and disconnect; safe to call twice."""
        self._ended.set()
        self._thread.join(_LAST_S)
        self._client.close()

    def _run(self) -> None:
        while self.error is None:
            last = self._ended.wait(_WAIT_S)  # looked at before the deque: what is left comes first
            while self._held and self.error is None:
                count = min(len(self._held), _AT_ONCE)
                batch = [self._held.popleft() for _ in range(count)]
                try:
                    self._client.ask_all(batch)
                except ControlError as error:
                    self.error = str(error)
                else:
                    self.taken += sum(request["do"] == "gait" for request in batch)
            if last:
                return


class BusSession:
    """Writes one drive; what was written survives the death of the process, and a full disk.

    ``/joint_commands`` holds what was sent, before the bus rounds it, at the tick's own time;
    ``/gate/wanted`` what was to be sent, before the gate changed anything; ``/gate/phase`` what the
    gate was about. All frames are in it, both ways.
    """

    def __init__(
        self, plan: BusPlan, clock: ClockDomain, epoch_ns: int, gait_names: tuple[str, ...]
    ) -> None:
        """Open the session.

        Args:
            plan: The motion, the robot, the bus and the file.
            clock: Clock of the frames' device times.
            epoch_ns: Unix time of its start [ns].
            gait_names: Names of the gait's values.

        Raises:
            OutputExistsError: If the file exists and ``force`` is not given, or what a drive
                that was killed left of it.
            LogWriteError: If it can't be created, or there is no room for it.
            DataError: If the robot has no bus.
        """
        path, driven, robot, bus = plan.output, plan.driven, plan.robot, plan.address.name
        self._path = path
        require_space(path, _ROOM)
        self._sink = DurableSink(path, force=plan.force, last_words=_LAST_WORDS)
        self.writer = SessionWriter(
            path,
            session_id=uuid.uuid4().hex,
            epoch_ns=epoch_ns,
            robot=robot,
            clock={bus: clock},
            metadata={**driven.facts, "armed": "yes", f"source.{bus}": plan.address.text},
            sink=self._sink,
        )
        self.writer.explain(driven.attachments, driven.records)
        names = robot.joint_names
        self._commands = self.writer.joint_state("/joint_commands", names, unit="rad")
        self._requested = self.writer.joint_state("/gate/wanted", names, unit="rad")
        self._gait = (
            self.writer.joint_state("/gait", gait_names, unit=GAIT_UNIT) if gait_names else None
        )
        self._mode = self.writer.string("/gait/mode")
        self._phase = self.writer.string("/gate/phase")
        self._events = self.writer.log("/rosout")
        self._frames = BusRecorder(bus, self.writer, SourceClock(), robot, directions=True)
        self._settle_s = driven.settle_s
        self._last = {"mode": "", "phase": ""}
        self._logged: set[str] = set()
        self._epoch_ns = self._t_ns = epoch_ns
        self._device_minus_host_ns = 0
        self._open = True

    @property
    def shortage(self) -> str | None:
        """Why it can't go on for long: its disk, and what is missing; None while it can."""
        shortage = self._sink.shortage
        if shortage is None:
            return self._sink.misplaced or None
        return f"the disk at {_mount_of(shortage.path)} is full or fails: {shortage}"

    def write(self, tick: BusTick, t_ns: int) -> None:
        """Write one tick.

        Args:
            t_ns: When it was [Unix ns].

        Raises:
            LogWriteError: If it can't be written.
        """
        self._t_ns = t_ns
        step = tick.step
        for frames in tick.received:
            self._frames.add(frames)
            newest = frames[-1]
            if newest["t_device_ns"] >= DEVICE_TIMES_END_NS:
                continue
            self._device_minus_host_ns = int(newest["t_device_ns"]) - int(newest["t_host_ns"])
        self._keep_sent(tick.sent)
        if tick.tick % _DECODE_TICKS == 0:
            self._frames.decode(self._now_ns, t_ns + 1)
            self._log_faults()
        self._change("phase", self._phase, step.phase)
        for level, text in step.remarks:
            self._events.write(t_ns, level, _EVENTS_OF, text)
        if step.command is not None:
            self._commands.write(t_ns, step.command)
        if step.requested is not None:
            self._requested.write(t_ns, step.requested)
        if step.gait is not None:
            self._write_gait(step.gait, t_ns)

    def _log_faults(self) -> None:
        for text in self._frames.take_faults():
            self.log_event("error", text)

    def _keep_sent(self, frames: FrameArray) -> None:
        """Keep what was sent, with the time on the device's clock as far as that is known."""
        self._frames.write_raw(self._now_ns)
        if len(frames):
            kept = np.array(frames)
            device_ns = frames["t_host_ns"].astype(np.int64) + self._device_minus_host_ns
            kept["t_device_ns"] = np.maximum(device_ns, 0)
            self._frames.keep(kept, self._now_ns)

    def _write_gait(self, gait: GaitTick, t_ns: int) -> None:
        if self._settle_s is not None:  # the gait begins: so much later it has settled
            settled_s = self._settle_s + (t_ns - self._epoch_ns) * 1e-9
            self.writer.note("undulog", {"settle_s": repr(settled_s)})
            self._settle_s = None
        if self._gait is not None:
            self._gait.write(t_ns, gait.values)
        self._change("mode", self._mode, gait.mode)
        for name in gait.clamped:
            self.log_event("warn", f"{name} clamped to the joint limits")

    def _change(self, what: str, channel: StringChannel, text: str) -> None:
        """Write a text where it changed."""
        if text != self._last[what]:
            self._last[what] = text
            channel.write(self._t_ns, text)

    def log_event(self, level: str, text: str) -> None:
        """Write an event, once.

        Args:
            level: ``info``, ``warn`` or ``error``.
        """
        if text not in self._logged:
            self._logged.add(text)
            self._events.write(self._t_ns, level, _EVENTS_OF, text)

    def finish(self, outcome: Outcome, remarks: Sequence[GateEvent]) -> None:
        """Write the outcome.

        Args:
            remarks: Events; the warnings among them are reasons for the verdict.
        """
        level = "error" if outcome.how is DriveEnding.FAULT else "info"
        why = f": {outcome.why}" if outcome.why else ""
        self.log_event(level, f"{outcome.how}{why}; {outcome.ended}")
        for remark in remarks:
            self.log_event(*remark)
        reasons = [text for kind, text in remarks if kind == "warn"]
        if outcome.how is DriveEnding.FAULT:
            self.writer.set_verdict("bad", [outcome.why, *reasons])
        else:
            self.writer.set_verdict("degraded" if reasons else "good", reasons)

    def fail(self, text: str) -> None:
        """Write the failure."""
        self.log_event("error", text)
        self.writer.set_verdict("bad", [text])

    def close(self) -> None:
        """Write what is left and finalise; safe to call twice.

        Raises:
            LogWriteError: If it can't be written.
        """
        if not self._open:
            return
        self._open = False
        try:
            self._frames.finish(self._now_ns)
            self._log_faults()
        finally:
            self.writer.close()
        if rescued := self._sink.rescued:
            places = ", ".join(map(str, rescued))
            raise LogWriteError(self._path, f"{self._sink.misplaced}; the session is in {places}")

    def _now_ns(self) -> int:
        return self._t_ns


def _mount_of(path: Path) -> Path:
    """Where the disk of a file is mounted."""
    place = path.resolve()
    return next(parent for parent in (place, *place.parents) if parent.is_mount())


def stamped(tick: BusTick, t_ns: int) -> BusTick:
    """The same tick with its frames, both ways, at the tick's time.

    Args:
        t_ns: Its time [Unix ns].

    Returns:
        Copies of the frames, ``t_host_ns`` set.
    """
    received, sent = [np.array(frames) for frames in tick.received], np.array(tick.sent)
    for frames in (*received, sent):
        frames["t_host_ns"] = t_ns
    return tick._replace(received=received, sent=sent)
