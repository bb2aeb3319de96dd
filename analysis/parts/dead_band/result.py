"""Dead band of a joint: stick or play at its reversals."""

from __future__ import annotations

from dataclasses import dataclass

EITHER = "stick or play, not separable"


STICK = "stick"


PLAY = "play"


@dataclass(frozen=True)
class DeadBandEnd:
    """The dead band at one end of the motion.

    Attributes:
        travel_rad: W: travel of the command from its reversal to the onset of motion, the joint's
            delay taken off [rad].
        travel_ci95: Its 95 % interval [rad].
        step_rad: B: what the joint catches up at the onset, beyond following the command from
            there [rad]; 0 for play and for friction that is no less in motion than at rest.
        step_ci95: Its 95 % interval [rad].
        rest_s: How long it rests, median over the cycles [s].
    """

    travel_rad: float
    travel_ci95: tuple[float, float]
    step_rad: float
    step_ci95: tuple[float, float]
    rest_s: float


@dataclass(frozen=True)
class DeadBand:
    """Stick or play of one joint; mechanics, not an artefact.

    Attributes:
        kind: :data:`EITHER`, :data:`STICK` or :data:`PLAY`.
        evidence: What decides the kind, or what is lacking.
        top: After the command's maxima.
        gain_change: Factor that the dead band alone makes on the gain, at this command.
        lag_change_rad: What it alone adds to the lag, at this command [rad].
    """

    kind: str
    evidence: str
    top: DeadBandEnd
    bottom: DeadBandEnd
    gain_change: float
    lag_change_rad: float
    cycles: int
