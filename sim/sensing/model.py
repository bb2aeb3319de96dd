"""How the robot's sensors measure: rates, errors and resolutions, all of a kind alike."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True)
class Noise:
    """White noise of what the servos report, as standard deviations.

    Attributes:
        position: [rad].
        velocity: [rad/s].
        effort: [N m].
    """

    position: float = 0.0
    velocity: float = 0.0
    effort: float = 0.0


@dataclass(frozen=True)
class ServoPolling:
    """When and how finely the servos are read and commanded over their bus.

    Attributes:
        slot_s: From one servo's turn to the next in a polling cycle [s]: joint i (from 0) is
            sampled i slots after the cycle's start. 0: all at once, as no real bus can.
        resolution: Step of the encoders [rad]; 0: none.
        dead_band: An encoder tells another angle only when the angle has moved by more than this
            from what it told last [rad].
        command_resolution: Step in which the servos take commands [rad]; 0: none.
    """

    slot_s: float = 0.0
    resolution: float = 0.0
    dead_band: float = 0.0
    command_resolution: float = 0.0


@dataclass(frozen=True)
class SensorModels:
    """All sensor models of a scenario.

    Attributes:
        servo: Of the servos' own readings.
    """

    servo: ServoPolling = field(default_factory=ServoPolling)
