"""How a joint follows commands that are no gait."""

from __future__ import annotations

from dataclasses import dataclass

from ...common.estimate import Estimate


@dataclass(frozen=True)
class JointTracking:
    """Gain, lag and offset of one joint whose commands are no gait.

    Attributes:
        gain: At low frequency, response over command.
        lag_s: Of slow motion: delay and time constants together [s]. It is 0 where the joint seems
            to be earlier than its command.
        offset_rad: Mean of the position less that of the delayed command [rad]. At another command
            it is larger by (gain - 1) times what that is above ``command_mean_rad``.
        poles: Of the model beside the delay, 0 to 2.
        held: Whether a command that is held until the next explains the motion better than lines
            from one to the next.
        explained: Share of the position's variance, at most 1.
        commanded_rad: Range of the command [rad].
        command_mean_rad: Mean of the delayed command [rad].
        speed_rad_s: Root mean square of its rate [rad/s].
        freedom: Degrees of freedom of the errors of gain, lag and offset, the fewest; 0 where the
            errors aren't known.
    """

    joint: str
    gain: Estimate
    lag_s: Estimate
    offset_rad: Estimate
    poles: int
    held: bool
    explained: float
    commanded_rad: float
    command_mean_rad: float
    speed_rad_s: float
    freedom: float
