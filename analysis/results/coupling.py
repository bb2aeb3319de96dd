"""Couplings of the joints: frozen values, part of an experiment."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from undulog.capture.common.arrays import FloatArray

from ..common.estimate import Estimate, PresentedResult

LTI_LABEL = (
    "as if the chain were linear and time-invariant: H_ij = (a_i/c_j)(P_ij - j R_ij); the "
    "nonlinearity measures the departure from that"
)


@dataclass(frozen=True, repr=False)
class Coupling(PresentedResult):
    """Whether the coupling is identifiable, and the coupling.

    Attributes:
        identifiable: False for one gait alone (m numbers for m^2 unknowns).
        why: Why not, or how.
        record: What to record so that it can be.
        matrix: Row = responding joint, column = commanded joint; None if not identifiable.
        condition_number: Of the inversion, or None.
    """

    identifiable: bool
    why: str
    record: str | None = None
    matrix: tuple[tuple[float, ...], ...] | None = None
    condition_number: float | None = None


Rows = tuple[tuple[float, ...], ...]


def rows_of(values: FloatArray) -> Rows:
    """Convert a matrix of shape (m, n) to plain numbers."""
    return tuple(tuple(float(x) for x in row) for row in values)


@dataclass(frozen=True)
class Matrix:
    """Derivatives, row = responding joint, column = commanded joint.

    Attributes:
        value: Shape (m, m).
        standard_error: Same shape.
        ci95_half: Half widths of the 95 % intervals, one by one (Student's t), same shape.
        ci95_half_together: Of those that hold for all elements off the diagonal together
            (Bonferroni), same shape; None in results of earlier versions.
    """

    value: Rows
    standard_error: Rows
    ci95_half: Rows
    ci95_half_together: Rows | None = None


@dataclass(frozen=True)
class RowCheck:
    """A joint's sum over the columns, which a time shift fixes whatever the system.

    Attributes:
        expected: 1 for P, 0 for R.
        total: With its 95 % interval.
    """

    name: str
    expected: float
    total: Estimate
    standard_error: float


@dataclass(frozen=True)
class Lti:
    """H and its inverse X, a reading that holds for linear chains only.

    Attributes:
        real: Real part of H, row = responding joint [rad/rad].
        imag: Imaginary part of H.
        condition_number: Of H: what inverting it may multiply relative errors by.
        asymmetry: ||X - X'|| / ||X|| off the diagonal; 0 = reciprocal.
        within_1: Share of the off-diagonal energy of X within abs(i - j) <= 1.
        within_2: Within 2.
        within_3: Within 3.
    """

    label: str
    real: Rows
    imag: Rows
    condition_number: float | None
    asymmetry: Estimate
    within_1: Estimate
    within_2: Estimate
    within_3: Estimate


@dataclass(frozen=True)
class HeldOut:
    """A run that was predicted, not used.

    Attributes:
        size: Largest deviation of a command from the base [rad or log amplitude].
        error: ||a - predicted|| / ||a||.
        error_kept: The same of 'each joint keeps its response to its own command'.
        noise: What the run's noise and the scatter between runs alone make of either.
    """

    session: str
    size: float
    error: float
    error_kept: float
    noise: float


@dataclass(frozen=True)
class BaseResponse:
    """How the joints answer the gait that is kicked: the mean over the runs without a kick.

    Attributes:
        gain: Of m joints.
        lag_rad: Of m joints [rad].
        gain_error: Standard errors, scatter between runs included.
        lag_error: The same of the lags [rad].
    """

    frequency_hz: float
    gain: tuple[float, ...]
    lag_rad: tuple[float, ...]
    gain_error: tuple[float, ...]
    lag_error: tuple[float, ...]


@dataclass(frozen=True)
class RunScatter:
    """How much runs differ from each other.

    Attributes:
        phase_rad: Standard deviation of each joint's phase between runs, beyond the noise within
            them [rad], m; 0 where none is found.
        log_gain: The same of its log amplitude.
        phase_noise_rad: That of the noise within a run [rad], m.
        log_gain_noise: The same of the log amplitude.
        dof: Degrees of freedom of the estimates.
        correlation: Of a run's errors, m phases and m log amplitudes, shape (2 m, 2 m).
        widened: Largest factor on the errors that the sums of rows demand; 1 where they agree.
    """

    phase_rad: tuple[float, ...]
    log_gain: tuple[float, ...]
    phase_noise_rad: tuple[float, ...]
    log_gain_noise: tuple[float, ...]
    dof: int
    correlation: Rows
    widened: float


@dataclass(frozen=True)
class KickSize:
    """Whether the kicks suit the robot.

    Attributes:
        phase_rad: Mean size of the kicks of phase [rad].
        log_amplitude: Mean size of the kicks of log amplitude; None without such kicks.
        resolved: Coupling that an element of P off the diagonal must have to be shown, the median
            over the elements (95 %, all together).
        curvature: Size of the second-order part of what the kicks did over the first-order part,
            what noise adds taken off.
        verdict: ``fits``, ``too small`` or ``too large``.
        why: Why it does not fit, and what to record; None if it does.
    """

    phase_rad: float
    log_amplitude: float | None
    resolved: float
    curvature: float
    verdict: str
    why: str | None


@dataclass(frozen=True, kw_only=True, repr=False)
class LocalCoupling(Coupling):
    """The answers of all joints to small kicks of each joint's command around one gait.

    ``matrix`` is P, and ``condition_number`` that of the H that is inverted in ``lti``.

    Attributes:
        joints: Names, head to tail, m.
        base_runs: Runs of the base gait.
        P: d psi / d psi_c.
        R: d ln|a| / d psi_c [1/rad].
        G: d ln|a| / d ln|c|; None where amplitudes were not kicked.
        S: d psi / d ln|c| [rad]; None where amplitudes were not kicked.
        phase_rows: Of P, each sums to 1.
        gain_rows: Of R, each sums to 0.
        checks_pass: Whether all sums agree within their errors (family-wise 5 %) or 1e-2.
        nonlinearity: ||(G - P, S + R)|| / ||(P, R)||; 0 = linear and time-invariant.
        held_out: Predictions of runs that were not used.
        valid_to: Largest deviation up to which all of them are predicted at least twice as well
            as by 'each joint keeps its response'; None where there are none, or the first fails.
        base: Response to the gait; None in results of earlier versions, as those below.
        scatter: How much runs differ from each other; in all errors and intervals.
        kick_size: Whether the kicks are too small or too large.
    """

    joints: tuple[str, ...]
    base_runs: int
    kicked_runs: int
    P: Matrix
    R: Matrix
    G: Matrix | None
    S: Matrix | None
    phase_rows: tuple[RowCheck, ...]
    gain_rows: tuple[RowCheck, ...]
    checks_pass: bool
    nonlinearity: Estimate
    lti: Lti
    held_out: tuple[HeldOut, ...]
    valid_to: float | None
    base: BaseResponse | None = None
    scatter: RunScatter | None = None
    kick_size: KickSize | None = None


class Route(StrEnum):
    """How the impedance was estimated.

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
        command_condition: Condition number of the commands C; 1 = every run counts fully.
        H: Response per command as the servo holds it [rad/rad].
        condition_number: Of H, or None where it is singular.
        route: How Z was estimated.
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
        contact: Whether the robot touched anything; None where its sessions don't say.
        hold_s: Delay of the held commands that is taken out of H [s].
        route_why: Why Z was estimated in this way.
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
