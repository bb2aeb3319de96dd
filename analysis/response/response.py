"""Gain and lag of each joint: its response's complex amplitude over its command's.

With H = a / c at the gait frequency, the gain is |H| and the lag is -arg H; ln H is what is
averaged and compared, since its two parts have the same variance (Händel, IEEE Trans. Instrum.
Meas. 49, 2000, doi 10.1109/19.893254; for the ratio the variances of both channels add).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from undulog.capture.common.arrays import ComplexArray, FloatArray

from ..common.estimate import Estimate
from ..estimators.intervals import (
    ResponseErrors,
    around,
    response_errors,
    t_factor,
    welch_satterthwaite,
)
from ..estimators.spectrum import FundamentalNoise, ResidualBins


@dataclass(frozen=True)
class Response:
    """ln H of m joints with variances.

    Attributes:
        ratio: H = a / c, shape (m,).
        log_gain_variance: Variance of ln|H|, shape (m,).
        lag_variance: Variance of arg H [rad^2], shape (m,).
        dof: Degrees of freedom of both, shape (m,).
        errors: What contrasts between the joints are judged by, whether or not their noise is
            independent; None where it isn't known.
    """

    ratio: ComplexArray
    log_gain_variance: FloatArray
    lag_variance: FloatArray
    dof: FloatArray
    errors: ResponseErrors | None = None

    @property
    def gain(self) -> FloatArray:
        """|H|, shape (m,)."""
        return np.abs(self.ratio)

    @property
    def lag_rad(self) -> FloatArray:
        """-arg H in (-pi, pi], positive when the response is late [rad], shape (m,)."""
        lag = -np.angle(self.ratio)
        return np.where(lag <= -np.pi, np.pi, lag)

    @property
    def lag_near_mean_rad(self) -> FloatArray:
        """Lags within pi of their circular mean [rad], shape (m,)."""
        lag = self.lag_rad
        mean = np.angle(np.mean(np.exp(1j * lag)))
        return np.asarray(mean + np.angle(np.exp(1j * (lag - mean))), dtype=np.float64)

    def select(self, chosen: Sequence[int]) -> Response:
        """Return the response of the joints with these indices."""
        index = np.asarray(chosen, dtype=np.int64)
        return Response(
            self.ratio[index],
            self.log_gain_variance[index],
            self.lag_variance[index],
            self.dof[index],
            None if self.errors is None else self.errors.select(index),
        )


def respond(
    command: ComplexArray,
    command_noise: FundamentalNoise,
    response: ComplexArray,
    response_noise: FundamentalNoise,
    *,
    omega_variance: float = 0.0,
    delay_between_s: FloatArray | float = 0.0,
    bins: tuple[ResidualBins, ResidualBins] | None = None,
) -> Response:
    """Return the response of each joint to its command.

    The error of the shared frequency turns both phases alike, except for the distance between
    the mean sampling times of the two channels.

    Args:
        command: Fundamentals c of the commands, shape (m,).
        response: Fundamentals a of the responses, shape (m,).
        omega_variance: Variance of the shared frequency [(rad/s)^2].
        delay_between_s: Mean sampling time of the response minus that of the command [s], (m,).
        bins: Residuals of the commands and of the responses, for the contrasts between joints.

    Returns:
        ln H and its variances; where a command is zero, H is NaN.
    """
    driven = np.abs(command) > 0
    ratio = np.divide(response, command, out=np.full(command.shape, np.nan + 0j), where=driven)
    gain_parts: list[FloatArray] = []
    lag_parts: list[FloatArray] = []
    for amplitude, noise in ((command, command_noise), (response, response_noise)):
        size = np.abs(amplitude)
        unit = np.divide(amplitude, size, out=np.ones_like(amplitude), where=size > 0)
        squared = np.where(size > 0, size, np.nan) ** 2
        gain_parts.append(noise.along(unit) / squared)
        lag_parts.append(noise.along(1j * unit) / squared)
    lag_variance = lag_parts[0] + lag_parts[1]
    dofs = np.stack([command_noise.dof, response_noise.dof])
    errors = None
    if bins is not None:
        errors = response_errors(
            command,
            bins[0],
            response,
            bins[1],
            omega_variance=omega_variance,
            delay_between_s=delay_between_s,
        )
    return Response(
        ratio=ratio,
        log_gain_variance=gain_parts[0] + gain_parts[1],
        lag_variance=lag_variance + omega_variance * np.square(delay_between_s),
        dof=welch_satterthwaite(np.stack(lag_parts), dofs),
        errors=errors,
    )


def gain_estimate(response: Response, joint: int) -> Estimate:
    """Return the gain with its interval, symmetric in log gain.

    Returns:
        The estimate; empty where the joint has no response.
    """
    gain = float(response.gain[joint])
    half = t_factor(float(response.dof[joint])) * float(response.log_gain_variance[joint]) ** 0.5
    if not np.isfinite(gain) or not np.isfinite(half):
        return Estimate()
    return Estimate(gain, (gain * float(np.exp(-half)), gain * float(np.exp(half))))


def lag_estimate(response: Response, joint: int) -> Estimate:
    """Return the lag with its interval.

    Of an amplitude |a| with standard error s across its direction, |a| sin(error) / s is
    Student's t exactly, so the half width is arcsin(t s / |a|).

    Returns:
        The estimate; empty where noise leaves the phase open. The interval lies around the lag
        and may cross plus or minus pi.
    """
    lag = float(response.lag_rad[joint])
    sine = t_factor(float(response.dof[joint])) * float(response.lag_variance[joint]) ** 0.5
    if not np.isfinite(lag) or not sine < 1:
        return Estimate()
    return Estimate(lag, around(lag, float(np.arcsin(sine))))
