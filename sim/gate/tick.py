"""What the gate is given at a control tick, and what it answers."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple

from undulog.capture.common.arrays import FloatArray

from ..gait.contract import GaitTick, Readings
from .outcome import GateFault


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


class Phase(StrEnum):
    """What the gate is about."""

    POSE = "reading the pose"
    APPROACH = "approach"
    RUN = "run"
    HOLD = "hold"
    ENDING = "ending"
    DONE = "done"


@dataclass(frozen=True)
class Heard:
    """What is known at a tick.

    Attributes:
        readings: For the gait.
        status: For the gate.
        trouble: What the bus itself told: bus-off, or somebody else's commands.
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


class Remark(NamedTuple):
    """Something to be logged: level and text."""

    level: str
    text: str


class GateStep(NamedTuple):
    """What to do at a tick.

    Attributes:
        phase: What the gate is about.
        command: What to send, joint angles [rad], shape (m,); None: nothing.
        wanted: What that was made from, before the gate changed anything; None likewise.
        gait: What the gait said, while it runs.
        remarks: What is worth a line in the log.
    """

    phase: Phase
    command: FloatArray | None
    wanted: FloatArray | None
    gait: GaitTick | None
    remarks: tuple[Remark, ...]
