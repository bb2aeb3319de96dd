"""Results of sessions without a gait: frequency responses, and motion without commands."""

from __future__ import annotations

from dataclasses import dataclass

from .estimate import Estimate, Interval

DIRECT, INDIRECT = "direct", "indirect"


@dataclass(frozen=True)
class JointFrequencyResponse:
    """Response of one joint to its command at k frequencies.

    Attributes:
        excitation: ``sum of sines``, ``periodic multisine``, ``chirp``, ``steps`` or ``broadband``.
        shares_command: Other joints with the same command but for its sign and scale. Their
            responses are to one input: what each would do alone is unknown.
        frequency_hz: Ascending.
        gain: Response over command.
        lag_rad: Lag of the response, in (-pi, pi], positive = late.
        lag_ci95: None where the gain isn't distinct from zero.
        coherence: Share of the response's power at that frequency that the command explains.
        delay_s: Delay of the model, or the group delay; includes the offset of the clocks.
        delay_model: Degrees of numerator and denominator of the rational model beside the delay;
            None where no model passed the residual test, and the delay is the group delay.
        bandwidth_hz: Lowest frequency with a gain 3 dB below that of the lowest line; None where
            it isn't in the excited band.
        resonance_hz: Frequency of the largest gain, where it exceeds that of the lowest line by
            more than both intervals; else None.
        distortion: Standard deviation of the nonlinear distortion over the gain, root mean square
            over the lines; None where it can't be separated from noise.
        method: ``direct``: response over command; ``indirect``: response over external reference,
            over command over external reference, which noise in a closed loop does not bias.
        halves_agree: Lines whose two halves differ by no more than their combined 95 % interval,
            and lines compared; None where halves can't be compared.
    """

    joint: str
    excitation: str
    shares_command: tuple[str, ...]
    frequency_hz: tuple[float, ...]
    gain: tuple[float, ...]
    gain_ci95: tuple[Interval, ...]
    lag_rad: tuple[float, ...]
    lag_ci95: tuple[Interval | None, ...]
    coherence: tuple[float, ...]
    delay_s: Estimate
    delay_model: tuple[int, int] | None
    bandwidth_hz: float | None
    resonance_hz: float | None
    distortion: float | None = None
    halves_agree: tuple[int, int] | None = None
    method: str = DIRECT


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


@dataclass(frozen=True)
class BestLinearJoint:
    """Best linear approximation of one joint's response to its own command, with its distortion.

    Attributes:
        response: The response; its intervals hold noise and distortion, those of one realisation
            noise only.
        noise_sd: Standard deviation of the response made by noise, by line; None from one period.
        distortion_sd: Standard deviation that the nonlinear distortion gives to the response in
            one realisation, by line, 0 where noise leaves nothing; None from one realisation or
            period, where it is not separable from noise.
        distortion: Root mean square of that over that of the gain, over the lines.
        odd: Response at the odd lines that are left out, over that at the excited lines (root mean
            squares): distortion of odd order. Without noise; empty where there are no such lines.
        even: The same at even lines: distortion of even order.
    """

    response: JointFrequencyResponse
    noise_sd: tuple[float, ...] | None
    distortion_sd: tuple[float, ...] | None
    distortion: Estimate
    odd: Estimate
    even: Estimate


@dataclass(frozen=True)
class CrossResponse:
    """Best linear approximation of a joint's response to another joint's command.

    Attributes:
        joint: The joint that responds.
        command: The joint that is commanded.
        gain: At the lines of the experiment.
        lag_rad: In (-pi, pi], positive = late.
        sd: Root of E|e|^2 of the complex response.
    """

    joint: str
    command: str
    gain: tuple[float, ...]
    lag_rad: tuple[float, ...]
    sd: tuple[float, ...]


@dataclass(frozen=True)
class BestLinearResponses:
    """Best linear approximations from several sessions of one multisine experiment.

    Attributes:
        inputs: ``same``: one command for all joints; ``orthogonal``: each joint has its own.
        realisations: Of the random phases, M.
        periods: Steady periods of each, P.
        period_s: After which the commands repeat [s].
        lines: Excited multiples of 1 / ``period_s``.
        joints: In chain order.
        cross: Of orthogonal inputs every pair of different joints.
    """

    inputs: str
    realisations: int
    periods: int
    period_s: float
    lines: tuple[int, ...]
    joints: tuple[BestLinearJoint, ...]
    cross: tuple[CrossResponse, ...] = ()


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
