"""Describe a motion without commands: amplitudes, lags from joint to joint, and waves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from undulog.capture.common.arrays import FloatArray
from undulog.capture.judgement.levels import ANGLE_MARGIN_RAD
from undulog.capture.robot.model import Robot

from ...common.estimate import Estimate
from ...estimators.harmonic import HarmonicFit
from ...estimators.intervals import around, t_factor
from ...estimators.series import Series
from ...signals.columns import by_plane
from ..body.oscillation import (
    MotionFit,
    Oscillation,
    absolute,
    amplitude,
    local_wave_numbers,
    phase_lag,
    phase_line,
    travelling_index,
    wave_speed,
)
from .result import BodyWave, FreeMotion, JointMotion, LocalWaveNumber


def free_motion(robot: Robot | None, moved: MotionFit) -> tuple[FreeMotion, tuple[str, ...]]:
    """Measure a periodic motion.

    Args:
        robot: Gives planes and lengths.

    Returns:
        The motion, and the names of moving joints whose phase noise leaves open.
    """
    motion, names = moved.oscillation, moved.names
    has_phase = motion.known_phases()
    lags = dict.fromkeys(names, Estimate())
    planes: dict[str, str] = {}
    waves: list[BodyWave] = []
    for plane, members in by_plane(robot, moved.chain).items():
        planes |= dict.fromkeys(members, plane)
        rows = [names.index(name) for name in members if name in names]
        rows = [row for row in rows if has_phase[row]]
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
            name=series.name,
            plane=None if robot is None else planes[series.name],
            amplitude_rad=_amplitude(motion, row),
            offset_rad=_offset(series, moved.fit, row),
            lag_rad=lags[series.name],
        )
        for row, series in enumerate(moved.series)
    )
    return FreeMotion(joints, tuple(waves)), tuple(
        name for name, phased in zip(names, has_phase, strict=True) if not phased
    )


def _amplitude(motion: Oscillation, row: int) -> Estimate:
    size, error = amplitude(motion, row)
    half = t_factor(motion.dof) * error
    return Estimate(size, (max(0.0, size - half), size + half))


def _offset(series: Series, fit: HarmonicFit, row: int) -> Estimate:
    """Return the mean beside the harmonics; its interval is from the scatter of whole cycles."""
    constant = float(fit.trend[row, 0])
    left = series.values - fit.predict(row, series.t_s)
    turns = (series.t_s - series.t_s[0]) * fit.frequency_hz
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
    travelling = travelling_index(motion)[0]
    travels = travelling.ci95 is not None and travelling.ci95[0] > 0
    bent = travels and not line.straight and line.deviation_rad >= ANGLE_MARGIN_RAD
    return BodyWave(
        plane=None,
        joints=tuple(names),
        wave_number=line.slope,
        waves=Estimate(abs(slope) * turns, (low * turns, high * turns)),
        speed=wave_speed(line.slope, omega),
        speed_m_s=metres,
        travelling_index=travelling,
        deviation_rad=line.deviation_rad,
        local=_local(motion, index, line.phases_rad, names) if bent else (),
    )


def _local(
    motion: Oscillation, index: FloatArray, phases_rad: FloatArray, names: Sequence[str]
) -> tuple[LocalWaveNumber, ...]:
    numbers = local_wave_numbers(motion, index, phases_rad)
    pairs = zip(pairwise(names), numbers, strict=True)
    return tuple(LocalWaveNumber(*joints, number) for joints, number in pairs)
