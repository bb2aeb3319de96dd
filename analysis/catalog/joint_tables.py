"""Tables of a robot's joints over its sessions: one a quantity, a row a session, a column a joint.

Gain enters by its logarithm, and energy by that of the energy per second, so that a difference is a
ratio; lags enter in rad, those of commands that are no gait in s, offsets in rad.
"""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np
import pandas as pd

from undulog.capture.common.arrays import FloatArray, IntArray
from undulog.capture.judgement.levels import ANGLE_MARGIN_RAD

Frame: TypeAlias = Any  # pandas.DataFrame; its stubs don't know the columns' types

OTHER_COMMAND = float(np.log(1.25))
"""Logarithm of the ratio of ranges or rates from which commands that are no gait are others, as
:mod:`undulog.analysis.compare.tracking` has it."""

FEWEST_JOINTS = 3
"""Joints that are compared with each other: of two neither deviates from the other's median."""


def values_of(joints: Frame, sessions: Frame) -> dict[str, Frame]:
    """Return the values of each quantity, one a row of ``joints``; NaN where there is none."""
    gain = column(joints, "gain").fillna(column(joints, "tracking_gain"))
    values: dict[str, Frame] = {
        "gain": np.log(gain.where(gain > 0)),
        "lag": column(joints, "lag_rad"),
        "delay": column(joints, "tracking_lag_s"),
        "offset": _offsets(joints),
        "energy": _log_power(joints, sessions),
    }
    return values


def column(joints: Frame, name: str) -> Frame:
    """Return a column as numbers; NaN where rows of an earlier version lack it."""
    values: list[float] = joints[name].to_list() if name in joints else [np.nan] * len(joints)
    return pd.Series(values, joints.index, np.float64)


def _offsets(joints: Frame) -> Frame:
    """Return offsets at one command of each joint, the median of its means.

    Offsets of a gait whose mean is the margin or more from it are left out.
    """
    mean = column(joints, "command_mean_rad")
    by = mean.groupby(joints["joint"]).transform("median") - mean
    slope = column(joints, "tracking_gain") - 1
    moved = (slope * by).where(slope.notna(), np.where(by.abs() < ANGLE_MARGIN_RAD, 0.0, np.nan))
    return column(joints, "offset_rad") + moved


def _log_power(joints: Frame, sessions: Frame) -> Frame:
    length_s = joints["stop_s"] - joints["start_s"]
    whole_s = joints["path"].map(sessions.set_index("path")["duration_s"])
    power = joints["energy_abs_j"] / length_s.fillna(whole_s)
    return np.log(power.where(power > 0))


def by_session(joints: Frame, values: Frame) -> Frame | None:
    """Return values by session and joint, of joints in most sessions, sessions with most joints.

    Returns:
        None with fewer than :data:`FEWEST_JOINTS` joints.
    """
    table = pivoted(joints, values)
    if table is None:
        return None
    table = table.loc[:, table.notna().mean() >= 0.5]
    table = table[table.notna().sum(axis=1) >= max(FEWEST_JOINTS, table.shape[1] / 2)]
    return table if table.shape[1] >= FEWEST_JOINTS and len(table) else None


def pivoted(joints: Frame, values: Frame) -> Frame | None:
    """Return values by session and joint, in chain order; None without any."""
    latest = joints.assign(value=values).dropna(subset=["value"])
    if latest.empty:
        return None
    table = latest.pivot_table(index="path", columns="joint", values="value", aggfunc="last")
    return table.reindex(columns=latest.groupby("joint")["position"].first().sort_values().index)


def conditions_of(joints: Frame, sessions: Frame) -> IntArray:
    """Number the motions of sessions: gaits of one frequency and mean amplitude, to two digits.

    Commands that are no gait are one motion where their ranges and rates are alike.

    Args:
        sessions: Indexed by path.
    """

    def mean(chosen: Frame, name: str) -> Frame:
        of_joints = column(chosen, name).groupby(chosen["path"]).mean()
        return of_joints.reindex(sessions.index)

    driven, tracked = (joints[column(joints, name).notna()] for name in ("gain", "tracking_gain"))
    amplitude = mean(driven, "command_amplitude_rad").fillna(0.0)
    frequency = mean(driven, "frequency_hz").fillna(0.0)
    extents = [
        _alike(np.log(mean(tracked, name).to_numpy(float)))
        for name in ("commanded_range_rad", "command_speed_rad_s")
    ]
    rows = zip(amplitude, frequency, *extents, strict=True)
    keys = [f"{size:.1e}/{rate:.1e}/{kind}/{pace}" for size, rate, kind, pace in rows]
    return np.unique(keys, return_inverse=True)[1].astype(np.int64)


def _alike(values: FloatArray) -> IntArray:
    """Number groups of values between which there is a gap; those without a value are one."""
    order = np.argsort(values)  # NaN last
    steps = np.diff(values[order], prepend=values[order][:1])
    numbers = np.empty(values.size, np.int64)
    numbers[order] = np.cumsum(steps > OTHER_COMMAND)
    return np.where(np.isfinite(values), numbers, -1)
