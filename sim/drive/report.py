"""How a drive over a bus went, for the log, for JSON and for people."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from ..gate.outcome import DriveEnding, GateEvent, Jitter, Outcome
from .loop import LoopTally

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
        told: Samples of the gait that the recorder took.
        not_told: Why the recorder was not told all, or None.
    """

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
    told: int = 0
    not_told: str | None = None


def remarks_of(report: BusReport) -> list[GateEvent]:
    """What is worth a line of the log at the end.

    Returns:
        The remarks; warnings are reasons for a verdict that is not good.
    """
    remarks: list[GateEvent] = []
    if report.jitter is not None:
        remarks.append(GateEvent("info", str(report.jitter)))
    overruns = report.tally.overruns
    if overruns:
        many = f"{overruns} control ticks were" if overruns > 1 else "1 control tick was"
        text = f"{many} left out, as the one before took too long"
        remarks.append(GateEvent("warn", text))
    for count, what in ((report.malformed, "could not be read"), (report.dropped, "were dropped")):
        if count:
            remarks.append(GateEvent("warn", f"messages of the bus that {what}: {count}"))
    if report.waits:
        text = (
            f"commands that followed a late one and waited: {report.waits}, up to "
            f"{report.longest_wait_s * 1e3:.2f} ms, so that no command was too fast"
        )
        remarks.append(GateEvent("info", text))
    changed = {why: count for why, count in report.cuts.items() if count}
    if changed:
        listed = ", ".join(f"{count} {why.replace('_', ' ')}" for why, count in changed.items())
        remarks.append(GateEvent("warn", f"the gate changed commands of single joints: {listed}"))
    return remarks


def report_facts(report: BusReport) -> dict[str, Any]:
    """A report for JSON."""
    tally = report.tally
    return {
        "armed": True,
        "pace": "lockstep" if report.lockstep else "real time",
        **report.outcome.to_dict(),
        "complete": report.outcome.how is DriveEnding.COMPLETE,
        "duration_s": report.gait_s,
        "approach_s": report.approach_s,
        "whole_s": tally.loop_s,
        "ticks": report.ticks,
        "overruns": tally.overruns,
        "sent": tally.sent,
        "received": tally.received,
        "decoded": tally.decoded,
        "waits": report.waits,
        "longest_wait_s": report.longest_wait_s,
        "malformed": report.malformed,
        "dropped": report.dropped,
        "held_s": report.held_s,
        "feedback": None if report.feedback is None else report.feedback.to_dict(),
        "changed": report.cuts,
        "lateness": None if report.jitter is None else report.jitter.to_dict(),
        "real_time_factor": tally.loop_s / max(report.wall_s, 1e-3),
        "first_frames": report.first_frames,
        "gait_told": report.told,
        "gait_not_told": report.not_told,
    }


def report_lines(report: BusReport) -> list[str]:
    """A report for people, what came of it left out."""
    tally = report.tally
    pace = "in lockstep with the robot" if report.lockstep else "in real time"
    before = "" if report.approach_s is None else f", begun after {report.approach_s:.3g} s"
    lines = [f"{report.ticks} ticks {pace}{before}; {report.outcome.ended}"]
    heard = f"{tally.received} received, {tally.decoded} of them with readings"
    lines.append(f"{tally.sent} frames sent, {heard}")
    lines += [f"warning: {text}" if kind == "warn" else text for kind, text in remarks_of(report)]
    return lines
