"""Driving over a bus: connection, session, recorder and loop put together.

Without arming it is a dry run: any bus can be listened to as a recorder does, readings reach the
gait, commands are computed and none is sent.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path

from capture.bus.decoding import identifier_text
from capture.daemon.clock import SessionClock
from capture.errors import UndulogError, UsageError
from capture.interruption import StopRequest
from capture.log.frames import FrameArray
from capture.log.writer import SessionWriter
from capture.robot import ClockDomain
from capture.sources.address import parse_address
from capture.sources.contract import SourceAddress, SourceContext
from capture.sources.events import Tally
from capture.sources.registry import open_source

from ..garbage import quick_collections
from ..scenario import CONTROL_RATE_HZ, LONGEST_S, Scenario
from .bus_session import BusSession, NowhereSink, stamped
from .driven import Driven
from .fading import FadingGait
from .gait_teller import GaitTeller
from .link import Link, ListeningLink, VirtualRobotLink
from .loop import BusTick, LoopTally, control
from .pace import LockstepPace, WallPace

_NS = 1_000_000_000


@dataclass(frozen=True)
class BusPlan:
    """What to do over a bus.

    Attributes:
        driven: What to drive.
        address: The bus.
        duration_s: Time of the last tick.
        armed: Whether commands are sent.
        output: The session to write, or None.
        recorder: Control socket of a recorder that is told the gait, or None.
        force: Replace an existing session.
    """

    driven: Driven
    address: SourceAddress
    duration_s: float
    armed: bool
    output: Path | None = None
    recorder: Path | None = None
    force: bool = False


@dataclass
class BusReport:
    """How it went.

    Attributes:
        tally: Of the loop.
        lockstep: Whether the robot set the pace.
        wall_s: How long it took.
        first_frames: The commands of the first tick, as candump writes frames.
        told: Samples of the gait that the recorder took.
        not_told: Why the recorder was not told all, or None.
    """

    tally: LoopTally
    lockstep: bool
    wall_s: float = 0.0
    first_frames: list[str] = field(default_factory=list[str])
    told: int = 0
    not_told: str | None = None


def bus_plan(
    driven: Driven,
    on: str,
    *,
    duration_s: float | None,
    armed: bool,
    output: Path | None,
    recorder: Path | None,
    force: bool,
) -> BusPlan:
    """Check what was asked for.

    Args:
        driven: What to drive.
        on: The bus, ``can:INTERFACE:CHANNEL[...]``.
        duration_s: How long [s]; its own length if None.
        armed: Whether commands are sent.
        output: The session to write, or None.
        recorder: Control socket of a recorder, or None.
        force: Replace an existing session.

    Returns:
        The plan.

    Raises:
        UsageError: If the address is none, the robot has no bus, or the duration can't be.
    """
    address = parse_address(on) if ":" in on else None
    if address is None or address.scheme != "can":
        raise UsageError(f"--on {on}: expected twin, twin:SCENARIO or can:INTERFACE:CHANNEL")
    if driven.robot.bus is None:
        raise UsageError(
            f"{driven.robot.name} has no bus map: {driven.name} can't be driven on one"
        )
    length = driven.duration_s if duration_s is None else duration_s
    if not 1 / CONTROL_RATE_HZ <= length <= LONGEST_S:
        raise UsageError(
            f"a duration of {length:g} s; it can be {1 / CONTROL_RATE_HZ:g} to {LONGEST_S:g} s"
        )
    return BusPlan(driven, address, length, armed, output, recorder, force)


def drive_bus(
    plan: BusPlan, *, stop: StopRequest, on_tick: Callable[[BusTick], None] | None = None
) -> BusReport:
    """Drive over a bus.

    Args:
        plan: What to do.
        stop: The gait comes to rest when it is requested, and the loop ends.
        on_tick: Told of each tick.

    Returns:
        How it went.

    Raises:
        UsageError: If commands are to be sent and it is no virtual robot, or another one's.
        SourceError: If nobody is there, or the robot is lost.
        ControlError: If the recorder isn't there.
        OutputExistsError: If the session is there and ``force`` is not given.
        LogWriteError: If it can't be written.
    """
    clock = SessionClock()
    robot = plan.driven.robot
    gait = FadingGait(plan.driven.make(robot, None), robot)
    with ExitStack() as opened:
        virtual = _virtual_robot(plan, clock) if plan.armed else None
        link: Link = virtual or _listening(plan, clock)
        opened.callback(link.close)
        lockstep = virtual is not None and virtual.lockstep
        epoch_ns = Scenario.epoch_s * _NS if lockstep else clock.epoch_ns
        session = BusSession(
            plan.output,
            robot=robot,
            bus=plan.address.name,
            clock=ClockDomain.SIMULATED if virtual is not None else ClockDomain.HOST,
            epoch_ns=epoch_ns,
            gait_names=gait.names,
            armed=plan.armed,
            facts={**plan.driven.session_facts, f"source.{plan.address.name}": plan.address.text},
            attachments=plan.driven.attachments,
            records=plan.driven.records,
            force=plan.force,
        )
        opened.callback(session.close)
        teller = None
        if plan.recorder is not None:
            teller = GaitTeller(plan.recorder, gait.names)
            opened.callback(teller.close)
        tell = _Telling(
            plan,
            session,
            teller,
            clock=clock,
            simulated_ns=epoch_ns if lockstep else None,
            on_tick=on_tick,
        )
        report = BusReport(LoopTally(), lockstep)
        opened.enter_context(quick_collections())
        begun = time.monotonic()
        try:
            tell.begin()
            report.tally = control(
                gait,
                robot,
                link,
                LockstepPace(virtual) if virtual and lockstep else WallPace(link, CONTROL_RATE_HZ),
                duration_s=plan.duration_s,
                stop=stop,
                on_tick=tell.tick,
            )
            tell.end(report.tally)
        except UndulogError as error:
            tell.failed(str(error))
            raise
        report.wall_s = time.monotonic() - begun
        report.first_frames = tell.first_frames
    if teller is not None:  # closed: all that could be told is
        report.told = teller.told
        report.not_told = teller.error or (
            f"{teller.dropped} samples: the recorder was too slow" if teller.dropped else None
        )
    return report


class _Telling:
    """Everyone who is told what happens: session, recorder, screen."""

    def __init__(
        self,
        plan: BusPlan,
        session: BusSession,
        teller: GaitTeller | None,
        *,
        clock: SessionClock,
        simulated_ns: int | None,
        on_tick: Callable[[BusTick], None] | None,
    ) -> None:
        """Nothing is told yet; ``simulated_ns`` is the time of tick 0 of a robot in lockstep."""
        self.first_frames: list[str] = []
        self._plan, self._session, self._teller = plan, session, teller
        self._clock, self._simulated_ns, self._on_tick = clock, simulated_ns, on_tick

    def begin(self) -> None:
        driven = self._plan.driven
        how = "drives" if self._plan.armed else "would drive (dry run)"
        text = f"{how} {driven.name} ({driven.kind}) on {self._plan.address.text}"
        self._session.say("info", text)
        if self._teller is not None:
            self._teller.note(text)

    def tick(self, tick: BusTick) -> None:
        if not tick.tick:
            self.first_frames = [_candump(frame) for frame in tick.frames]
        if self._simulated_ns is None:
            self._session.write(tick, self._clock.now_ns())
        else:
            t_ns = self._simulated_ns + tick.tick * (_NS // CONTROL_RATE_HZ)
            self._session.write(stamped(tick, t_ns), t_ns)
        if self._teller is not None:
            self._teller.tell(tick.gait, time.time_ns())
        if self._on_tick is not None:
            self._on_tick(tick)

    def end(self, tally: LoopTally) -> None:
        self._session.finish(tally)
        if self._teller is not None:
            self._teller.note(f"drove {self._plan.driven.name} for {tally.duration_s:g} s")

    def failed(self, text: str) -> None:
        self._session.fail(text)
        if self._teller is not None:
            self._teller.note(text, "error")


def _virtual_robot(plan: BusPlan, clock: SessionClock) -> VirtualRobotLink:
    link = VirtualRobotLink(plan.address, Tally(clock.now_ns))
    if link.robot_name != plan.driven.robot.name:
        link.close()
        raise UsageError(
            f"{plan.address.text} is {link.robot_name}, and {plan.driven.name} is for "
            f"{plan.driven.robot.name}"
        )
    return link


def _listening(plan: BusPlan, clock: SessionClock) -> ListeningLink:
    # A bus has no channels of its own to write: its frames are handed out.
    unused = SessionWriter("nowhere.mcap", session_id="", epoch_ns=0, sink=NowhereSink())
    source = open_source(plan.address)
    return ListeningLink(source, plan.address, SourceContext(clock.now_ns, unused))


def _candump(frame: FrameArray) -> str:
    data = bytes(frame["data"][: frame["dlc"]])
    return f"{identifier_text(int(frame['id_flags']))}#{data.hex().upper()}"
