"""What a lag sweep or a multisine says of the coupling: frozen values, part of an experiment."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from .coupling import Coupling, Rows
from .estimate import Estimate


class Route(StrEnum):
    """How the impedance was told.

    ``torque``: Z = T Y^-1 from measured torques, without a model of the servo.
    ``servo``: Z = D_r H^-1 - D_q with the servo's parameters.
    ``row-scaled``: not Z but X = H^-1, whose rows off the diagonal are Z's, each times an unknown
    factor of that joint's servo.
    """

    TORQUE = "torque"
    SERVO = "servo"
    ROW_SCALED = "row-scaled"


@dataclass(frozen=True)
class ComplexMatrix:
    """Row = answering joint, column = moved or commanded joint.

    Attributes:
        real: Shape (m, m).
        imag: Same shape.
        standard_error: Of the real and of the imaginary part, same shape.
        ci95_half: Half widths of their 95 % intervals, one by one (Student's t), same shape.
    """

    real: Rows
    imag: Rows
    standard_error: Rows
    ci95_half: Rows


@dataclass(frozen=True)
class ToneCoupling:
    """The coupling at one frequency.

    Attributes:
        frequency_hz: Of the tone.
        command_condition: Condition number of the commands C; 1 = every run counts fully.
        H: Response per command as the servo holds it [rad/rad].
        condition_number: Of H, or None where it is singular.
        route: How Z was told.
        Z: Torque on a joint per angle of a joint [N m/rad]; None where it is known up to a
            scaling of rows only.
        inverted_condition: Condition number of what was inverted for Z (the responses Y by the
            torque route, else H).
        servo_difference: ||Z by servo - Z by torque|| / ||Z by torque||, where both can be had: how
            well the robot's description fits its servos.
        distortion: Amplitude of a line beside the tone where nothing is commanded, over the tone's,
            of torques, or responses where torques are not recorded; None where the records are too
            short. What a nonlinearity makes there it makes at the tone, too.
        asymmetry: ||X - X'|| / ||X|| off the diagonal of X = Z, or H^-1 where Z is None; 0 =
            reciprocal.
        within_1: Share of the off-diagonal energy of X within abs(i - j) <= 1.
        within_2: Within 2.
        within_3: Within 3.
    """

    frequency_hz: float
    command_condition: float
    H: ComplexMatrix
    condition_number: float | None
    route: Route
    Z: ComplexMatrix | None
    inverted_condition: float | None
    servo_difference: float | None
    distortion: float | None
    asymmetry: Estimate
    within_1: Estimate
    within_2: Estimate
    within_3: Estimate


@dataclass(frozen=True, kw_only=True, repr=False)
class LinearCoupling(Coupling):
    """The answers of all joints to all commands, as a linear chain gives them.

    ``matrix`` is abs(H) at the first tone, and ``condition_number`` that H's.

    Attributes:
        plan: ``lag-sweep`` or ``multisine``.
        joints: Names, head to tail, m.
        runs: How many.
        contact: Whether the robot touched anything; None where its sessions don't say.
        validity: Where the matrices hold.
        hold_s: Delay of the held commands that is taken out of H [s].
        route_why: Why Z was told the way it was.
        tones: One for each frequency, rising.
        sideband_energy: Energy of the responses where nothing was commanded, over that at the
            tones; 0 = linear.
        drift_per_cycle: Largest drift of the responses that noise doesn't explain; 0 = settled.
    """

    plan: str
    joints: tuple[str, ...]
    runs: int
    contact: bool | None
    validity: str
    hold_s: float
    route_why: str
    tones: tuple[ToneCoupling, ...]
    sideband_energy: Estimate
    drift_per_cycle: float
