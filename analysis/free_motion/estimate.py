"""From the joint angles of a session without commands to amplitudes, lags and waves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from undulog.capture.common.arrays import FloatArray
from undulog.capture.robot.model import Robot

from ..estimators.harmonic import HarmonicFit, fit_at
from ..estimators.intervals import around, t_factor
from ..estimators.series import Series
from ..estimators.spectrum import residual_spectrum
from ..response.fitting import GaitFit
from ..results.estimate import Estimate, Interval
from ..results.free_motion import BodyWave, FreeMotion, JointMotion
from ..signals.columns import by_plane
from .wave import Oscillation, amplitude, phase_lag, phase_line, travelling_index


@dataclass(frozen=True)
class MotionFit:
    """Joint angles fitted at the frequency that they share; heavy.

    Attributes:
        series: Angles of the m joints that are not constant, in chain order.
        fit: Their harmonics, in this order.
        oscillation: Their fundamentals, with errors.
        chain: Names of these joints and of those whose angles are constant, in chain order.
        omega_dof: Degrees of freedom of the variance of the frequency.
    """

    series: tuple[Series, ...]
    fit: HarmonicFit
    oscillation: Oscillation
    chain: tuple[str, ...]
    omega_dof: float

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the joints that are not constant."""
        return tuple(one.name for one in self.series)


def fit_motion(angles: Mapping[str, Series], gait: GaitFit) -> MotionFit | None:
    """Fit joint angles at their common frequency.

    Args:
        angles: Joint angles by name, in chain order.
        gait: Its frequency, found from the same angles.

    Returns:
        The fit; None where no joint moves.
    """
    enough = [one for one in angles.values() if one.count > gait.fit.model.size + 1]
    series = [one for one in enough if np.ptp(one.values) > 0]
    if not series:
        return None
    fit = fit_at(series, gait.fit.omega, gait.fit.model)
    _, bins = residual_spectrum(series, fit)
    return MotionFit(
        series=tuple(series),
        fit=fit,
        oscillation=Oscillation(fit.fundamental, bins, fit.mean_time_s, gait.omega_error**2),
        chain=tuple(one.name for one in enough),
        omega_dof=gait.omega_dof,
    )


def free_motion(robot: Robot | None, moved: MotionFit) -> tuple[FreeMotion, tuple[str, ...]]:
    """Measure a periodic motion.

    Args:
        robot: Gives planes and lengths.

    Returns:
        The motion, and the names of moving joints whose phase noise leaves open.
    """
    motion, names = moved.oscillation, moved.names
    known = motion.known_phases()
    lags = dict.fromkeys(names, Estimate())
    planes: dict[str, str] = {}
    waves: list[BodyWave] = []
    for plane, members in by_plane(robot, moved.chain).items():
        planes |= dict.fromkeys(members, plane)
        rows = [names.index(name) for name in members if name in names]
        rows = [row for row in rows if known[row]]
        for before, joint in pairwise(rows):
            lags[names[joint]] = phase_lag(motion, joint, before)[0]
        if len(rows) > 1:
            index = np.array([members.index(names[row]) for row in rows], dtype=np.float64)
            of_plane = motion.select(np.array(rows))
            members_known = [names[row] for row in rows]
            wave = _body_wave(of_plane, index, members_known, robot, moved.fit.omega)
            waves.append(replace(wave, plane=None if robot is None else plane))
    joints = tuple(
        JointMotion(
            name=one.name,
            plane=None if robot is None else planes[one.name],
            amplitude_rad=_amplitude(motion, row),
            offset_rad=_offset(one, moved.fit, row),
            lag_rad=lags[one.name],
        )
        for row, one in enumerate(moved.series)
    )
    return FreeMotion(joints, tuple(waves)), tuple(
        name for name, one in zip(names, known, strict=True) if not one
    )


def _amplitude(motion: Oscillation, row: int) -> Estimate:
    size, error = amplitude(motion, row)
    half = t_factor(motion.dof) * error
    return Estimate(size, (max(0.0, size - half), size + half))


def _offset(one: Series, fit: HarmonicFit, row: int) -> Estimate:
    """Return the mean beside the harmonics; its interval is from the scatter of whole cycles."""
    constant = float(fit.trend[row, 0])
    left = one.values - fit.predict(row, one.t_s)
    turns = (one.t_s - one.t_s[0]) * fit.frequency_hz
    cycle = turns.astype(np.int64)
    counts, sums = np.bincount(cycle), np.bincount(cycle, weights=left)
    means = (sums[counts > 0] / counts[counts > 0])[: max(int(turns[-1]), 1)]
    if means.size < 2:
        return Estimate(constant)
    half = t_factor(means.size - 1.0) * float(means.std(ddof=1)) / means.size**0.5
    return Estimate(constant, around(constant, half))


def _body_wave(
    motion: Oscillation, index: FloatArray, names: Sequence[str], robot: Robot | None, omega: float
) -> BodyWave:
    """Measure the wave along joints with known phases.

    Args:
        index: Number of each joint in its plane.
        omega: Angular frequency [rad/s].
    """
    line = phase_line(motion, index, index)
    metres = Estimate()
    if robot is not None:
        # Joint k is between links k and k + 1.
        along = np.cumsum([link.length for link in robot.links])
        places = along[[robot.joint_names.index(name) for name in names]]
        metres = wave_speed(phase_line(motion, index, places).slope, omega)
    slope, (low, high) = line.slope.value or 0.0, absolute(line.slope.ci95 or (0.0, 0.0))
    turns = float(index[-1] - index[0]) / (2 * np.pi)
    return BodyWave(
        plane=None,
        joints=tuple(names),
        wave_number=line.slope,
        waves=Estimate(abs(slope) * turns, (low * turns, high * turns)),
        speed=wave_speed(line.slope, omega),
        speed_m_s=metres,
        travelling_index=travelling_index(motion)[0],
        deviation_rad=line.deviation_rad,
    )


def absolute(ends: Interval) -> Interval:
    """Return the interval of the absolute value."""
    low, high = sorted(map(abs, ends))
    return (0.0 if ends[0] <= 0 <= ends[1] else low), high


def wave_speed(slope: Estimate, omega: float) -> Estimate:
    """Return omega / |kappa|; empty where kappa may be zero.

    The error of the frequency is left out: it is smaller by the number of cycles.
    """
    low, high = absolute(slope.ci95 or (0.0, 0.0))
    if slope.value is None or low == 0:
        return Estimate()
    return Estimate(omega / abs(slope.value), (omega / high, omega / low))
