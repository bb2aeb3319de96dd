"""A motion without commands: its joints and waves."""

from __future__ import annotations

from dataclasses import dataclass

from ...common.estimate import Estimate


@dataclass(frozen=True)
class JointMotion:
    """Motion of one joint at the common frequency.

    Attributes:
        plane: None without a robot description.
        amplitude_rad: Of the fundamental.
        offset_rad: Mean over whole cycles.
        lag_rad: Lag behind the moving joint before it in its plane, in (-pi, pi], positive = late;
            empty for the first, and where noise leaves it open. Whole turns more would look alike.
    """

    name: str
    plane: str | None
    amplitude_rad: Estimate
    offset_rad: Estimate
    lag_rad: Estimate


@dataclass(frozen=True)
class LocalWaveNumber:
    """The wave number between two neighbouring joints.

    Attributes:
        joint: The first of both in the chain.
        next_joint: The second.
        wave_number: Lag of the second behind the first, over the joints between them [rad/joint];
            empty where noise leaves it open.
    """

    joint: str
    next_joint: str
    wave_number: Estimate


@dataclass(frozen=True)
class BodyWave:
    """The wave that runs along the joints of one plane.

    Attributes:
        plane: None without a robot description.
        joints: Those with a phase, in chain order.
        wave_number: Lag from joint to joint: the slope of a line through the phases [rad/joint];
            positive where the wave runs from the first joint to the last.
        waves: Waves between the first and the last of the joints, without sign.
        speed: Of the wave [joints/s].
        speed_m_s: Of the wave [m/s]; empty without a robot description.
        travelling_index: 1 of a purely travelling, 0 of a standing wave: the smaller over the
            larger semi-axis of the complex amplitudes (Feeny, J. Sound and Vibration 310, 2008).
        deviation_rad: Root mean square of the phases about the line, weighted by amplitude.
        local: Wave numbers along the body, where the phases are off a line by more than noise and
            by a degree at least; else, and of a standing wave, empty.
    """

    plane: str | None
    joints: tuple[str, ...]
    wave_number: Estimate
    waves: Estimate
    speed: Estimate
    speed_m_s: Estimate
    travelling_index: Estimate
    deviation_rad: float
    local: tuple[LocalWaveNumber, ...] = ()

    @property
    def direction(self) -> str:
        """``first-to-last``, ``last-to-first``, or ``undecided``, by the intervals.

        Of a standing wave, whose travelling index isn't distinct from 0, noise draws the direction.
        """
        ci95 = self.wave_number.ci95
        if self.standing or ci95 is None or ci95[0] <= 0 <= ci95[1]:
            return "undecided"
        return "first-to-last" if ci95[0] > 0 else "last-to-first"

    @property
    def standing(self) -> bool:
        """Whether nothing of the wave is shown to travel."""
        ci95 = self.travelling_index.ci95
        return ci95 is not None and ci95[0] <= 0


@dataclass(frozen=True)
class FreeMotion:
    """A periodic motion whose commands were not logged.

    Attributes:
        joints: Those that move, in chain order.
        waves: One for each plane with at least two joints that have a phase.
    """

    joints: tuple[JointMotion, ...] = ()
    waves: tuple[BodyWave, ...] = ()
