"""From the joint angles of a session without commands to amplitudes, lags and waves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
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
from .wave import Oscillation, phase_lag, phase_line, travelling_index


def free_motion(
    robot: Robot | None, angles: Mapping[str, Series], gait: GaitFit
) -> tuple[FreeMotion, tuple[str, ...]]:
    """Measure a periodic motion.

    Args:
        robot: Gives planes and lengths.
        angles: Joint angles by name, in chain order.
        gait: Its frequency, found from the same angles.

    Returns:
        The motion, and the names of moving joints whose phase noise leaves open.
    """
    series = [one for one in angles.values() if one.count > gait.fit.model.size + 1]
    series = [one for one in series if np.ptp(one.values) > 0]
    if not series:
        return FreeMotion(), ()
    fit = fit_at(series, gait.fit.omega, gait.fit.model)
    _, bins = residual_spectrum(series, fit)
    motion = Oscillation(fit.fundamental, bins, fit.mean_time_s, gait.omega_error**2)
    known = motion.known_phases()
    names = [one.name for one in series]
    lags = dict.fromkeys(names, Estimate())
    planes: dict[str, str] = {}
    waves: list[BodyWave] = []
    for plane, members in by_plane(robot, names).items():
        planes |= dict.fromkeys(members, plane)
        rows = [names.index(name) for name in members if known[names.index(name)]]
        for before, joint in pairwise(rows):
            lags[names[joint]] = phase_lag(motion, joint, before)
        if len(rows) > 1:
            index = np.array([members.index(names[row]) for row in rows], dtype=np.float64)
            of_plane = motion.select(np.isin(np.arange(len(names)), rows))
            wave = _body_wave(of_plane, index, [names[row] for row in rows], robot, fit.omega)
            waves.append(replace(wave, plane=None if robot is None else plane))
    joints = tuple(
        JointMotion(
            name=one.name,
            plane=None if robot is None else planes[one.name],
            amplitude_rad=_amplitude(motion, row),
            offset_rad=_offset(one, fit, row),
            lag_rad=lags[one.name],
        )
        for row, one in enumerate(series)
    )
    return FreeMotion(joints, tuple(waves)), tuple(
        name for name, one in zip(names, known, strict=True) if not one
    )


def _amplitude(motion: Oscillation, row: int) -> Estimate:
    size = float(np.abs(motion.amplitudes[row]))
    factor = np.zeros(motion.amplitudes.size, dtype=np.complex128)
    factor[row] = np.conj(motion.amplitudes[row]) / size if size > 0 else 1.0
    half = t_factor(motion.dof) * motion.error(factor)
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
        metres = _speed(phase_line(motion, index, places).slope, omega)
    slope, (low, high) = line.slope.value or 0.0, _sizes(line.slope.ci95 or (0.0, 0.0))
    turns = float(index[-1] - index[0]) / (2 * np.pi)
    return BodyWave(
        plane=None,
        joints=tuple(names),
        wave_number=line.slope,
        waves=Estimate(abs(slope) * turns, (low * turns, high * turns)),
        speed=_speed(line.slope, omega),
        speed_m_s=metres,
        travelling_index=travelling_index(motion),
        deviation_rad=line.deviation_rad,
    )


def _sizes(ends: Interval) -> Interval:
    """Return the interval of the absolute value."""
    low, high = sorted(map(abs, ends))
    return (0.0 if ends[0] <= 0 <= ends[1] else low), high


def _speed(slope: Estimate, omega: float) -> Estimate:
    """Return omega / |kappa|; empty where kappa may be zero.

    The error of the frequency is left out: it is smaller by the number of cycles.
    """
    low, high = _sizes(slope.ci95 or (0.0, 0.0))
    if slope.value is None or low == 0:
        return Estimate()
    return Estimate(omega / abs(slope.value), (omega / high, omega / low))
