"""Driving over a bus: connection, safety gate, session, recorder and loop put together."""

from __future__ import annotations

import time
from collections.abc import Callable, Generator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from undulog.capture.common.arrays import NS
from undulog.capture.common.errors import LogWriteError, UsageError
from undulog.capture.common.process import StopRequest, raised_priority
from undulog.capture.log.messages.frames import FrameArray, identifier_text
from undulog.capture.recorder.status import SessionClock
from undulog.capture.robot.model import Direction, Quantity, Robot
from undulog.capture.sources.contract import SourceAddress, SourceCounts, parse_address
from undulog.capture.sources.events import EventLog, Tally

from ..gait.contract import CONTROL_RATE_HZ
from ..scenario.scenario import LONGEST_S, Scenario
from ..twin.recording import quick_collections
from .feedback import Confirmation
from .gate import Gate
from .limits import Spacing, gate_limits
from .links import BusLink, VirtualRobotLink
from .loop import BusTick, ConsoleWatch, ControlLoop, LockstepPace, LoopTally, WallPace
from .motion import MotionSource
from .outcome import DriveEnding, FaultKind, GateFault, Outcome, jitter
from .python_can_bus import open_link
from .report import UNASKED, BusPlan, BusReport, Feedback
from .session import BusSession, GaitPublisher, stamped

LISTEN_S = 0.5
"""A bus is listened to for so long before anything is sent [s]: whose it is, and how often joints
report. A robot in lockstep has said its name, and waits for each command."""


def bus_plan(
    driven: MotionSource,
    on: str,
    output: Path,
    robot: Robot | None = None,
    duration_s: float | None = None,
    *,
    recorder: Path | None = None,
    force: bool = False,
) -> BusPlan:
    """Check the arguments of a drive.

    Args:
        on: The bus, ``can:INTERFACE:CHANNEL[...]``.
        robot: The robot on the bus; the one that the motion was made for if None.
        duration_s: Duration [s]; that of the motion if None.
        recorder: Control socket of a recorder, or None.

    Raises:
        UsageError: If the address is not that of a bus, the robot has no bus or lacks limits, a
            joint takes no commands or reports no angle, the commands are for other joints, or the
            duration is out of range.
    """
    address = bus_address(on)
    robot = robot or driven.robot
    check_drivable(driven, robot)
    limits = gate_limits(robot)
    length = driven.duration_s if duration_s is None else duration_s
    if not 1 / CONTROL_RATE_HZ <= length <= LONGEST_S:
        raise UsageError(
            f"a duration of {length:g} s; it can be {1 / CONTROL_RATE_HZ:g} to {LONGEST_S:g} s"
        )
    return BusPlan(driven, robot, limits, address, length, output, recorder, force)


def check_drivable(driven: MotionSource, robot: Robot) -> None:
    """Check that a motion can be driven on a bus of the robot, armed or dry.

    Raises:
        UsageError: If the robot has no bus, a joint can't be commanded or tells no angle, or the
            commands are of other joints.
    """
    if robot.bus is None:
        raise UsageError(f"{robot.name} has no bus map: {driven.name} can't be driven on one")
    for asked in (Direction.TX, Quantity.COMMAND), (Direction.RX, Quantity.POSITION):
        there = {
            signal.target
            for signal in robot.bus.signals
            if (signal.direction, signal.quantity) == asked
        }
        lacking = [name for name in robot.joint_names if name not in there]
        if lacking:
            direction, quantity = asked
            raise UsageError(
                f"the bus map of {robot.name} has no {quantity} ({direction}) of "
                f"{', '.join(lacking)}: it can't be driven on a bus"
            )
    driven.check_fits(robot)


def bus_address(on: str) -> SourceAddress:
    """Return the address of the bus that ``--on`` names.

    Args:
        on: ``can:INTERFACE:CHANNEL[...]``.

    Raises:
        UsageError: If it is something else.
    """
    address = parse_address(on) if ":" in on else None
    if address is None or address.scheme != "can":
        raise UsageError(f"--on {on}: expected twin, twin:SCENARIO or can:INTERFACE:CHANNEL")
    return address


def drive_bus(
    plan: BusPlan,
    *,
    stop: StopRequest,
    on_tick: Callable[[BusTick], None] | None = None,
    console: ConsoleWatch | None = None,
) -> BusReport:
    """Drive over a bus.

    Args:
        stop: The drive ends as the robot's file says when it is requested; at once if again.
        on_tick: Called with each tick.
        console: The terminal whose loss ends the drive likewise, if there is one.

    Returns:
        How it went, also where a fault ended it.

    Raises:
        UsageError: If it is another robot's bus.
        SourceError: If nobody is there, or the robot is no robot to start with.
        ControlError: If the recorder isn't there.
        OutputExistsError: If the session is there and ``force`` is not given.
        LogWriteError: If it can't be written.
    """
    clock, robot = SessionClock(), plan.robot
    gait = plan.driven.make(robot, None)
    with ExitStack() as opened:
        tally = Tally(clock.now_ns)
        link = open_link(plan.address, tally)
        opened.callback(link.close)
        virtual = _virtual(link, plan)
        lockstep = virtual is not None and virtual.lockstep
        epoch_ns = Scenario.epoch_s * NS if lockstep else clock.epoch_ns
        session = BusSession(plan, link.clock, epoch_ns, gait.names)
        opened.callback(session.close)
        session.writer.note("undulog.gate", plan.limits.facts())
        teller = None
        if plan.recorder is not None:
            teller = GaitPublisher(plan.recorder, gait.names)
            opened.callback(teller.close)
        publish = _Telling(
            *(plan, session, teller, tally.events, clock),
            simulated_ns=epoch_ns if lockstep else None,
            on_tick=on_tick,
        )
        gate = Gate(
            gait,
            plan.limits,
            duration_s=plan.duration_s,
            place=plan.address.text,
            listen_s=0.0 if lockstep else LISTEN_S,
        )
        pace = LockstepPace(virtual) if virtual and lockstep else WallPace(link)
        # In simulated time all ticks are a period apart, whenever they come.
        spacing = confirmation = None
        if not lockstep:
            spacing = Spacing(plan.limits.rate, clock.now_ns)
            confirmation = Confirmation(plan.limits.rate, 1.0 / CONTROL_RATE_HZ, clock.now_ns)
        loop = ControlLoop(gate, robot, link, pace, spacing=spacing, confirmation=confirmation)

        def each_tick(tick: BusTick) -> None:
            publish.tick(tick)
            publish.feedback(_feedback(gate, loop))
            if (shortage := session.shortage) is not None:  # it still takes what the ending is
                gate.report(GateFault(FaultKind.LOG, shortage))

        opened.enter_context(quick_collections())
        begun = time.monotonic()
        try:
            publish.begin()
            with _urgent(session, lockstep=lockstep):
                loop.run(stop, each_tick, console)
            report = _report(plan, gate, loop, spacing, tally.counts)
            publish.end(report)
            session.close()
        except LogWriteError as error:
            raise _unwritten(error, session, gate, loop.tally) from error
        except Exception as error:
            publish.failed(str(error) or type(error).__name__)
            raise
        report.wall_s = time.monotonic() - begun
        report.first_frames = publish.first_frames
    if teller is not None:  # closed: all that could be told is
        report.taken = teller.taken
        report.not_taken = teller.error or (
            f"{teller.dropped} samples: the recorder was too slow" if teller.dropped else None
        )
    return report


@contextmanager
def _urgent(session: BusSession, *, lockstep: bool) -> Generator[None]:
    """Raise the priority; not in lockstep, where the robot waits for each command."""
    if lockstep:
        yield
        return
    with raised_priority() as priority:
        if priority.refused:
            session.log_event(
                "info",
                "priority was refused: while other programs hold the processors, replies may be "
                "seen so late that the drive holds; CAP_SYS_NICE allows it",
            )
        yield


def _virtual(link: BusLink, plan: BusPlan) -> VirtualRobotLink | None:
    """Return the link if it is that of a virtual robot, else None."""
    if not isinstance(link, VirtualRobotLink):
        return None
    if link.robot_name != plan.robot.name:
        raise UsageError(
            f"{plan.address.text} is {link.robot_name}, and {plan.driven.name} is for "
            f"{plan.robot.name}; nothing was sent"
        )
    return link


def _unwritten(
    error: LogWriteError, session: BusSession, gate: Gate, tally: LoopTally
) -> LogWriteError:
    """Return the error of a session that can't be written, with the outcome of the drive."""
    try:
        session.close()
    except LogWriteError as later:  # says what is kept, and where
        error = later
    reasons = [str(error).removeprefix(f"{error.path}: ")]
    if gate.outcome is not None:
        reasons.append(gate.outcome.ended)
    if tally.untold:
        reasons.append(f"the last {tally.untold} control ticks are not in the session")
    return LogWriteError(error.path, "; ".join(reasons))


def _feedback(gate: Gate, loop: ControlLoop) -> Feedback | None:
    """Return the supervision of the drive; None before it is armed."""
    if (interval := gate.silence.interval) is None:
        return None
    period_s = 1.0 / CONTROL_RATE_HZ
    return Feedback(loop.by_replies, interval * period_s, gate.silence.limit, period_s)


def _report(
    plan: BusPlan, gate: Gate, loop: ControlLoop, spacing: Spacing | None, bus: SourceCounts
) -> BusReport:
    outcome = gate.outcome or Outcome(DriveEnding.STOPPED, "", "")
    began = gate.run_from
    return BusReport(
        plan=plan,
        outcome=outcome,
        tally=loop.tally,
        lockstep=spacing is None,
        approach_s=None if began is None else began / CONTROL_RATE_HZ,
        gait_s=gate.run_s,
        ticks=gate.run_ticks,
        cuts=gate.cuts,
        jitter=jitter(loop.tally.late_s),
        waits=0 if spacing is None else spacing.waits,
        longest_wait_s=0.0 if spacing is None else spacing.longest_s,
        held_s=gate.held_ticks / CONTROL_RATE_HZ,
        feedback=_feedback(gate, loop),
        malformed=bus.malformed,
        dropped=bus.dropped or 0,
    )


@dataclass
class _Telling:
    """Publishes the drive to the session, the recorder and the screen.

    Attributes:
        simulated_ns: Time of tick 0 of a robot in lockstep.
        armed: The supervision of the drive, once it is armed.
    """

    plan: BusPlan
    session: BusSession
    teller: GaitPublisher | None
    events: EventLog
    clock: SessionClock
    simulated_ns: int | None
    on_tick: Callable[[BusTick], None] | None
    armed: Feedback | None = None
    first_frames: list[str] = field(default_factory=list[str])

    def begin(self) -> None:
        driven = self.plan.driven
        text = f"drives {driven.name} ({driven.kind}) on {self.plan.address.text}"
        self.session.log_event("info", text)
        if self.teller is not None:
            self.teller.note(text)

    def tick(self, tick: BusTick) -> None:
        if tick.step.command is not None and not self.first_frames:
            self.first_frames = [_candump(frame) for frame in tick.sent]
        if self.simulated_ns is None:
            self.session.write(tick, self.clock.now_ns())
        else:
            t_ns = self.simulated_ns + tick.tick * (NS // CONTROL_RATE_HZ)
            self.session.write(stamped(tick, t_ns), t_ns)
        for event in self.events.take():
            self.session.log_event(event.level, event.text)
        if self.teller is not None:
            if tick.step.gait is not None:
                self.teller.publish(tick.step.gait, time.time_ns())
            for level, text in tick.step.remarks:
                self.teller.note(text, level)
        if self.on_tick is not None:
            self.on_tick(tick)

    def feedback(self, feedback: Feedback | None) -> None:
        """Write the supervision of the drive when it is armed and when it changes."""
        if feedback is None or feedback == self.armed:
            return
        if self.armed is not None:
            self.session.log_event("warn", f"gate: {UNASKED}")
        self.armed = feedback
        self.session.writer.note("undulog.gate.feedback", feedback.facts())

    def end(self, report: BusReport) -> None:
        for event in self.events.flush():
            self.session.log_event(event.level, event.text)
        self.session.finish(report.outcome, report.remarks())
        if report.jitter is not None:
            facts = {name: str(value) for name, value in report.jitter.to_dict().items()}
            self.session.writer.note("undulog.gate.jitter", facts)
        if self.teller is not None:
            name, outcome = self.plan.driven.name, report.outcome
            why = f", {outcome.why}" if outcome.why else ""
            level = "error" if outcome.how is DriveEnding.FAULT else "info"
            self.teller.note(f"drove {name} for {report.gait_s:g} s{why}", level)

    def failed(self, text: str) -> None:
        self.session.fail(text)
        if self.teller is not None:
            self.teller.note(text, "error")


def _candump(frame: FrameArray) -> str:
    data = bytes(frame["data"][: frame["dlc"]])
    return f"{identifier_text(int(frame['id_flags']))}#{data.hex().upper()}"
