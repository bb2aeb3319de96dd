"""Results of sessions without a gait: frequency responses, and motion without commands."""

from __future__ import annotations

from dataclasses import dataclass

from ..common.estimate import Estimate
from ..parts.frequency_response.result import JointFrequencyResponse


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
