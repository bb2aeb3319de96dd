"""The session of a drive over a bus: commands and gait as they were meant, frames as they came."""

from __future__ import annotations

import uuid
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from mcap.records import Metadata

from capture.daemon.bus_recorder import BusRecorder
from capture.daemon.source_clock import SourceClock
from capture.log.sink import Description
from capture.log.writer import SessionWriter
from capture.robot import ClockDomain, Robot

from ..session_log import GAIT_UNIT
from .loop import BusTick, LoopTally

_EVENTS_OF = "drive"
_DECODE_TICKS = 10  # many frames at once cost little more than a few


class NowhereSink:
    """A session that isn't kept."""

    def define(self, record: Description) -> None:
        """Keep nothing."""

    def write(
        self,
        channel_id: int,
        log_time_ns: int,
        publish_time_ns: int,
        sequence: int,
        payload: bytes,
    ) -> None:
        """Keep nothing."""

    def close(self, last: tuple[Metadata, ...]) -> None:
        """Nothing to finalise."""


class BusSession:
    """Writes one drive; without a path nothing is kept.

    ``/joint_commands`` holds what was commanded, before the bus rounds it, at the tick's own time.
    A dry run commands nothing: what it would have is on ``/dry_run/joint_commands``.
    """

    def __init__(
        self,
        path: Path | None,
        *,
        robot: Robot,
        bus: str,
        clock: ClockDomain,
        epoch_ns: int,
        gait_names: tuple[str, ...],
        armed: bool,
        facts: Mapping[str, str],
        attachments: Mapping[str, bytes],
        records: Mapping[str, Mapping[str, str]],
        force: bool = False,
    ) -> None:
        """Open the session.

        Args:
            path: The file to create, or None.
            robot: Whose bus it is.
            bus: The bus's name.
            clock: Whose clock the frames' device times are on.
            epoch_ns: Unix time of its start [ns].
            gait_names: Names of the gait's values.
            armed: Whether commands are sent.
            facts: For the metadata.
            attachments: File name to TOML text that explains what is driven.
            records: Other metadata records that explain it, by name.
            force: Replace an existing file.

        Raises:
            OutputExistsError: If the file is there and ``force`` is not given.
            LogWriteError: If it can't be created.
            DataError: If the robot has no bus.
        """
        self.writer = SessionWriter(
            path or Path("nowhere.mcap"),
            session_id=uuid.uuid4().hex,
            epoch_ns=epoch_ns,
            robot=robot,
            clock={bus: clock},
            metadata={**facts, "armed": "yes" if armed else "no"},
            force=force,
            sink=None if path is not None else NowhereSink(),
        )
        self.writer.explain(attachments, records)
        topic = "/joint_commands" if armed else "/dry_run/joint_commands"
        self._commands = self.writer.joint_state(topic, robot.joint_names, unit="rad")
        self._gait = (
            self.writer.joint_state("/gait", gait_names, unit=GAIT_UNIT) if gait_names else None
        )
        self._mode = self.writer.string("/gait/mode")
        self._events = self.writer.log("/rosout")
        self._frames = BusRecorder(bus, self.writer, SourceClock(), robot, directions=True)
        self._last_mode = ""
        self._said: set[str] = set()
        self._t_ns = epoch_ns

    def write(self, tick: BusTick, t_ns: int) -> None:
        """Write one tick.

        Args:
            tick: What happened in it.
            t_ns: When it was [Unix ns].

        Raises:
            LogWriteError: If it can't be written.
        """
        self._t_ns = t_ns
        for frames in tick.received:
            self._frames.add(frames)
        self._frames.write_raw(self._now_ns)
        if tick.tick % _DECODE_TICKS == 0:
            self._frames.decode(self._now_ns, t_ns + 1)
        self._commands.write(t_ns, tick.gait.command)
        if self._gait is not None:
            self._gait.write(t_ns, tick.gait.values)
        if tick.gait.mode != self._last_mode:
            self._last_mode = tick.gait.mode
            self._mode.write(t_ns, tick.gait.mode)
        for name in tick.gait.clamped:
            self.say("warn", f"{name} clamped to the joint limits")

    def say(self, level: str, text: str) -> None:
        """Write an event, once.

        Args:
            level: ``info``, ``warn`` or ``error``.
            text: What happened.
        """
        if text not in self._said:
            self._said.add(text)
            self._events.write(self._t_ns, level, _EVENTS_OF, text)

    def finish(self, tally: LoopTally) -> None:
        """Say how it went.

        Args:
            tally: Of the loop.
        """
        how = "end" if tally.complete else "at rest, as it was asked to stop,"
        self.say("info", f"{how} at {tally.duration_s:g} s")
        left_out = f"{tally.overruns} control ticks were left out, as the one before took too long"
        if tally.overruns:
            self.say("warn", left_out)
        self.writer.set_verdict(
            "degraded" if tally.overruns else "good", [left_out] if tally.overruns else []
        )

    def fail(self, text: str) -> None:
        """Say why it failed.

        Args:
            text: What happened.
        """
        self.say("error", text)
        self.writer.set_verdict("bad", [text])

    def close(self) -> None:
        """Write what is left and finalise.

        Raises:
            LogWriteError: If it can't be written.
        """
        try:
            self._frames.finish(self._now_ns)
        finally:
            self.writer.close()

    def _now_ns(self) -> int:
        return self._t_ns


def stamped(tick: BusTick, t_ns: int) -> BusTick:
    """The same tick with the arrival of its frames at the tick's time.

    Args:
        tick: The tick.
        t_ns: Its time [Unix ns].

    Returns:
        Copies of the frames, ``t_host_ns`` set.
    """
    received = [np.array(frames) for frames in tick.received]
    for frames in received:
        frames["t_host_ns"] = t_ns
    return tick._replace(received=received)
