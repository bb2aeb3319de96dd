"""Frequency response of a joint."""

from __future__ import annotations

from dataclasses import dataclass

from ...common.estimate import Estimate, Interval

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
