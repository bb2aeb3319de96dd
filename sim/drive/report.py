"""What is driven over a bus, and how that went: for the log, for JSON and for people."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from undulog.capture.robot.model import Robot
from undulog.capture.sources.contract import SourceAddress

from .limits import GateLimits
from .loop import LoopTally
from .motion import MotionSource
from .outcome import DriveEnding, GateEvent, Jitter, Outcome

UNASKED = "joints were received more often than requested: commands are not confirmed by replies"


@dataclass(frozen=True)
class Feedback:
    """What supervises a drive in real time.

    Attributes:
        by_replies: Whether commands are confirmed by replies to requests.
        reply_interval_s: Reply interval of the bus, measured before arming [s].
        hold_after_ticks: After so many control ticks without a joint the servos hold.
        period_s: Control period [s].
    """

    by_replies: bool
    reply_interval_s: float
    hold_after_ticks: int
    period_s: float

    @property
    def most_steps(self) -> int:
        """So many steps of a joint may be on their way: `max_rate` times a period each."""
        return 1 if self.by_replies else self.hold_after_ticks + 1

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "confirmed_by": "replies" if self.by_replies else None,
            "reply_interval_s": self.reply_interval_s,
            "hold_after_ticks": self.hold_after_ticks,
            "hold_after_s": self.hold_after_ticks * self.period_s,
            "most_steps": self.most_steps,
        }

    def facts(self) -> dict[str, str]:
        """For a session's metadata."""
        return {name: str(value or "nothing") for name, value in self.to_dict().items()}


@dataclass(frozen=True)
class BusPlan:
    """Parameters of a drive over a bus.

    Attributes:
        limits: Limits of the robot.
        duration_s: Time of the gait's last tick.
        recorder: Control socket of the recorder that receives the gait, or None.
    """

    driven: MotionSource
    robot: Robot
    limits: GateLimits
    address: SourceAddress
    duration_s: float
    output: Path
    recorder: Path | None = None
    force: bool = False


@dataclass
class BusReport:
    """How it went.

    Attributes:
        lockstep: Whether the robot set the pace.
        approach_s: Time from the first tick until the gait began [s]; None where it never did.
        gait_s: Time of the gait's last tick [s].
        ticks: Ticks that the gait commanded.
        cuts: How often commands of single joints were changed, by why.
        jitter: Lateness of the ticks; None where the robot set the pace.
        waits: Commands that were sent a little later, so that no joint was faster than it may.
        longest_wait_s: The longest of these waits [s].
        malformed: Messages of the bus that could not be read.
        dropped: Frames that came and were not fetched in time.
        held_s: How long nothing was sent as the bus was silent [s].
        feedback: What supervised it; None where the robot set the pace, or it was never armed.
        first_frames: The commands of the first tick, as candump writes frames.
        taken: Samples of the gait that the recorder took.
        not_taken: Why the recorder did not receive all of it, or None.
    """

    plan: BusPlan
    outcome: Outcome
    tally: LoopTally
    lockstep: bool
    approach_s: float | None
    gait_s: float
    ticks: int
    cuts: dict[str, int]
    jitter: Jitter | None
    waits: int = 0
    longest_wait_s: float = 0.0
    malformed: int = 0
    dropped: int = 0
    held_s: float = 0.0
    feedback: Feedback | None = None
    wall_s: float = 0.0
    first_frames: list[str] = field(default_factory=list[str])
    taken: int = 0
    not_taken: str | None = None

    @property
    def complete(self) -> bool:
        """Whether it ran to its planned end."""
        return self.outcome.how is DriveEnding.COMPLETE

    def remarks(self) -> list[GateEvent]:
        """What is worth a line of the log at the end.

        Returns:
            The remarks; warnings are reasons for a verdict that is not good.
        """
        remarks: list[GateEvent] = []
        if self.jitter is not None:
            remarks.append(GateEvent("info", str(self.jitter)))
        overruns = self.tally.overruns
        if overruns:
            many = f"{overruns} control ticks were" if overruns > 1 else "1 control tick was"
            text = f"{many} left out, as the one before took too long"
            remarks.append(GateEvent("warn", text))
        for count, what in ((self.malformed, "could not be read"), (self.dropped, "were dropped")):
            if count:
                remarks.append(GateEvent("warn", f"messages of the bus that {what}: {count}"))
        if self.waits:
            text = (
                f"commands that followed a late one and waited: {self.waits}, up to "
                f"{self.longest_wait_s * 1e3:.2f} ms, so that no command was too fast"
            )
            remarks.append(GateEvent("info", text))
        changed = {why: count for why, count in self.cuts.items() if count}
        if changed:
            listed = ", ".join(f"{count} {why.replace('_', ' ')}" for why, count in changed.items())
            remarks.append(
                GateEvent("warn", f"the gate changed commands of single joints: {listed}")
            )
        return remarks

    def facts(self) -> dict[str, Any]:
        """Return the report as plain JSON values."""
        plan, tally = self.plan, self.tally
        return {
            "driven": plan.driven.name,
            "kind": plan.driven.kind,
            "on": plan.address.text,
            "robot": plan.robot.name,
            "path": str(plan.output),
            "planned_duration_s": plan.duration_s,
            "recorder": str(plan.recorder) if plan.recorder is not None else None,
            "armed": True,
            "pace": "lockstep" if self.lockstep else "real time",
            **self.outcome.to_dict(),
            "complete": self.complete,
            "duration_s": self.gait_s,
            "approach_s": self.approach_s,
            "whole_s": tally.loop_s,
            "ticks": self.ticks,
            "overruns": tally.overruns,
            "sent": tally.sent,
            "received": tally.received,
            "decoded": tally.decoded,
            "waits": self.waits,
            "longest_wait_s": self.longest_wait_s,
            "malformed": self.malformed,
            "dropped": self.dropped,
            "held_s": self.held_s,
            "feedback": None if self.feedback is None else self.feedback.to_dict(),
            "changed": self.cuts,
            "lateness": None if self.jitter is None else self.jitter.to_dict(),
            "real_time_factor": tally.loop_s / max(self.wall_s, 1e-3),
            "first_frames": self.first_frames,
            "gait_told": self.taken,
            "gait_not_told": self.not_taken,
        }

    def lines(self) -> list[str]:
        """Return the report as lines of text, the outcome first."""
        plan, tally = self.plan, self.tally
        driven, length = plan.driven, f"{self.gait_s:g} s"
        if self.complete:
            lines = [f"{plan.address.text}: drove {driven.name} for {length}"]
        else:
            at = f"at {length} of {plan.duration_s:g} s"
            lines = [f"{plan.address.text}: stopped {at}: {self.outcome.why}"]
        pace = "in lockstep with the robot" if self.lockstep else "in real time"
        before = "" if self.approach_s is None else f", begun after {self.approach_s:.3g} s"
        ticks = f"{self.ticks} ticks {pace}{before}; {self.outcome.ended}"
        received = f"{tally.received} received, {tally.decoded} of them with readings"
        lines += [
            f"{driven.kind} for {plan.robot.name}, {ticks}",
            f"{tally.sent} frames sent, {received}",
            *(f"warning: {text}" if kind == "warn" else text for kind, text in self.remarks()),
            f"session: {plan.output}",
        ]
        if plan.recorder is not None:
            received = f"received {self.taken} samples of the gait"
            lines.append(f"the recorder at {plan.recorder} {received}")
        if self.not_taken is not None:
            lines.append(f"warning: it did not receive all: {self.not_taken}")
        return lines
