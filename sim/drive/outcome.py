"""How a drive through the gate went."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Any, NamedTuple

import numpy as np

from undulog.capture.common.arrays import FloatArray

from ..gait.contract import GaitTick, Readings

_EDGES_MS = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0)


class FaultKind(StrEnum):
    """Kind of a fault."""

    LOST = "lost"
    SILENT = "silent"
    TRACKING = "tracking"
    CURRENT = "current"
    TEMPERATURE = "temperature"
    VOLTAGE = "voltage"
    LATE = "late"
    BUS_OFF = "bus-off"
    STRANGER = "stranger"
    BUS = "bus"
    GAIT = "gait"
    LOG = "log"


MUTE = frozenset({FaultKind.BUS_OFF, FaultKind.BUS, FaultKind.STRANGER})
"""Faults after which nothing more is sent: a lost bus, or another controller on it."""


@dataclass(frozen=True)
class GateFault:
    """Why a drive ends early.

    Attributes:
        text: One sentence: joint, value, limit.
        joint: The joint, empty if it is not one joint's.
        value: What was found; None where it is no number.
        limit: What is allowed; None likewise.
        since_s: Since when, on the loop's clock [s]; None where it has no length.
    """

    kind: FaultKind
    text: str
    joint: str = ""
    value: float | None = None
    limit: float | None = None
    since_s: float | None = None

    def to_dict(self) -> dict[str, Any]:
        """For JSON: its kind, joint, value and limit."""
        return {
            "kind": str(self.kind),
            "joint": self.joint or None,
            "value": self.value,
            "limit": self.limit,
        }


@dataclass(frozen=True)
class Jitter:
    """Lateness of control ticks against deadlines that are anchored at the first one.

    Attributes:
        median_s: [s].
        p99_s: Of a hundred ticks one is later [s].
        worst_s: [s].
        counts: Ticks up to 0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50 and 100 ms late, each without those
            before it, and those beyond.
    """

    ticks: int
    median_s: float
    p99_s: float
    worst_s: float
    counts: tuple[int, ...]

    def to_dict(self) -> dict[str, Any]:
        """For JSON: the same, with the bounds of the counts."""
        bounds = [f"<= {edge:g} ms" for edge in _EDGES_MS] + [f"> {_EDGES_MS[-1]:g} ms"]
        return {**vars(self), "counts": dict(zip(bounds, self.counts, strict=True))}

    def __str__(self) -> str:
        """One line."""
        return (
            f"ticks were late by {self.median_s * 1e3:.2f} ms (median), "
            f"{self.p99_s * 1e3:.2f} ms (99 %), {self.worst_s * 1e3:.2f} ms at worst"
        )


def jitter(late_s: list[float]) -> Jitter | None:
    """Sum lateness up.

    Args:
        late_s: Of each tick [s].

    Returns:
        The summary; None without a tick.
    """
    if not late_s:
        return None
    late = np.array(late_s)
    place = np.searchsorted(np.array(_EDGES_MS) * 1e-3, late, side="left")
    return Jitter(
        ticks=len(late),
        median_s=float(np.median(late)),
        p99_s=float(np.quantile(late, 0.99)),
        worst_s=float(late.max()),
        counts=tuple(np.bincount(place, minlength=len(_EDGES_MS) + 1).tolist()),
    )


class DriveEnding(StrEnum):
    """How it ended."""

    COMPLETE = "complete"
    STOPPED = "stopped"
    FAULT = "fault"


@dataclass(frozen=True)
class Outcome:
    """The end of a drive.

    Attributes:
        why: One sentence; empty where it is complete.
        ended: What was commanded at the end, one sentence.
        fault: The fault, if one ended it.
    """

    how: DriveEnding
    why: str
    ended: str
    fault: GateFault | None = None

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        fault = self.fault
        return {
            "outcome": str(self.how),
            "why": self.why or None,
            "ended": self.ended,
            "fault": None if fault is None else {**fault.to_dict(), "since_s": fault.since_s},
        }


@dataclass(frozen=True)
class JointStatus:
    """The newest values of each joint; NaN where none came or it is too old. Shapes are (m,).

    Attributes:
        angle: Measured angles [rad].
        current: Currents [A].
        temperature: [degC].
        voltage: Supply voltages [V].
        silence_s: Time since the last angle [s]; inf before the first.
    """

    angle: FloatArray
    current: FloatArray
    temperature: FloatArray
    voltage: FloatArray
    silence_s: FloatArray


class GatePhase(StrEnum):
    """State of the gate."""

    POSE = "reading the pose"
    APPROACH = "approach"
    RUN = "run"
    HOLD = "hold"
    ENDING = "ending"
    DONE = "done"


@dataclass(frozen=True)
class GateInput:
    """Inputs of the gate at a tick.

    Attributes:
        trouble: Fault of the bus itself: bus-off, or commands of another controller.
        another_robot: Why this can't be the robot, None if it may be.
        late_s: How late the tick is [s].
        received: Whether the angle of a joint was received since the tick before.
        expected: Whether one should have been; not while requests pause.
        bounds: Least and greatest command that commands on their way leave [rad]; None: all.
    """

    readings: Readings
    status: JointStatus
    trouble: GateFault | None = None
    another_robot: str | None = None
    late_s: float = 0.0
    received: bool = True
    expected: bool = True
    bounds: tuple[FloatArray, FloatArray] | None = None


class GateEvent(NamedTuple):
    """Something to be logged: level and text."""

    level: str
    text: str


class GateStep(NamedTuple):
    """Output of the gate at a tick.

    Attributes:
        phase: State of the gate.
        command: What to send, joint angles [rad], shape (m,); None: nothing.
        requested: What that was made from, before the gate changed anything; None likewise.
        gait: The gait's tick, while it runs.
        remarks: Events to be logged.
    """

    phase: GatePhase
    command: FloatArray | None
    requested: FloatArray | None
    gait: GaitTick | None
    remarks: tuple[GateEvent, ...]
