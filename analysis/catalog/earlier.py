"""The latest session of a robot against its earlier ones, joint by joint, where they are few.

Each joint is compared with itself, so joints needn't be alike. With one earlier session the error
is that within both sessions: how sessions differ by themselves isn't known. With several it is
their scatter, at least that of all joints together (in the root mean square) and the error within
each, with Student's distribution for as many earlier sessions as there are, less one: sessions move
all joints together. Joints and quantities are one family (Holm); a difference is stated at a level
of 1 %, and where it matters.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pandas as pd
from scipy.special import stdtr, stdtrit

from undulog.capture.common.arrays import FloatArray
from undulog.capture.common.console import plain
from undulog.capture.judgement.levels import (
    ANGLE_MARGIN_RAD,
    COVERAGE,
    FEWEST,
    GAIN_MARGIN,
    LEVEL,
    TINY,
    reaches,
)

from ..common.estimate import Interval
from ..estimators.intervals import holm, t_factor, welch_satterthwaite
from .joint_tables import Frame, column, conditions_of, pivoted, values_of

_SOURCES = {
    "gain": ("gain", "tracking_gain"),
    "lag": ("lag_rad",),
    "delay": ("tracking_lag_s",),
    "offset": ("offset_rad",),
}
"""Quantities that are compared, and the columns with their intervals."""


DIFFERENCES = ("lag", "delay", "offset")
"""Quantities whose changes are differences and not ratios."""


@dataclass(frozen=True)
class Departure:
    """A joint that responds differently in the latest session than in earlier ones.

    Attributes:
        serial: Of the robot, or empty.
        quantity: ``gain``, ``lag``, ``delay`` or ``offset``.
        path: Of the latest session.
        date: Its start (UTC, ISO 8601).
        first: Start of the first of the earlier sessions.
        last: Start of the last of them.
        earlier: How many there are, of the same motion. With one the interval holds the noise
            within both sessions alone.
        change: Ratio minus 1 for a gain; rad, or s for a delay.
        change_ci95: Its interval; all of a robot hold together at 95 %.
        p: Corrected by Holm's method over the robot's joints and quantities.
    """

    robot: str
    serial: str
    joint: str
    quantity: str
    path: str
    date: str
    first: str
    last: str
    earlier: int
    change: float
    change_ci95: Interval
    p: float


def departure_sentence(departure: Departure) -> str:
    """Return how a joint differs from earlier sessions, without a full stop."""
    joint, change = plain(departure.joint), departure.change
    ends = " to ".join(sorted(size_text(departure.quantity, end) for end in departure.change_ci95))
    size = f"{size_text(departure.quantity, change)} [{ends}]"
    way = "more" if change > 0 else "less"
    what = {
        "gain": f"{joint} follows with {size} {way}",
        "lag": f"{joint} lags by {size} {way}",
        "delay": f"{joint} lags by {size} {way}",
        "offset": f"the offset of {joint} moved by {'+' if change > 0 else '−'}{size}",
    }[departure.quantity]
    than = "against" if departure.quantity == "offset" else "than in"
    if departure.earlier == 1:
        return (
            f"{what} {than} {departure.first[:10]} (of two sessions: the interval holds the noise "
            "within each alone)"
        )
    dates = f"{departure.first[:10]} to {departure.last[:10]}"
    return f"{what} {than} {departure.earlier} earlier sessions ({dates})"


def size_text(quantity: str, value: float | None) -> str:
    """Return the size of a change in degrees, milliseconds or percent, without its sign."""
    by = abs(value or 0.0)
    if quantity == "delay":
        return f"{by * 1e3:.2g} ms"
    return f"{math.degrees(by):.2g}°" if quantity in DIFFERENCES else f"{by * 100:.2g} %"


@dataclass(frozen=True)
class _Difference:
    """Of one joint in one quantity: its size, error, degrees of freedom, and what matters."""

    joint: str
    quantity: str
    size: float
    error: float
    dof: float
    margin: float

    @property
    def p(self) -> float:
        """Two-sided p-value by itself."""
        return 2 * float(stdtr(self.dof, -abs(self.size) / max(self.error, TINY)))


def departures(robot: str, serial: str, sessions: Frame, joints: Frame) -> list[Departure]:
    """Find the joints of a robot's latest session that differ from its earlier ones.

    Args:
        sessions: Rows of the view ``catalog``, by their start.
        joints: Rows of the view ``joints`` of these sessions.

    Returns:
        The surest first; none without an earlier session of the same motion.
    """
    ordered = sessions.set_index("path")
    numbers = conditions_of(joints, ordered)
    paths = [str(path) for path in ordered.index[numbers == numbers[-1]]]
    if len(paths) < 2:
        return []
    of_motion = joints[joints["path"].isin(paths)]
    values = values_of(of_motion, sessions)
    differences = [
        difference
        for quantity in _SOURCES
        for difference in _of_quantity(quantity, values[quantity], of_motion, paths)
    ]
    level = 1 - (1 - COVERAGE) / 2 / max(len(differences), 1)
    adjusted = holm(np.array([difference.p for difference in differences])).tolist()
    dates = {path: _date(ordered["start"][path]) for path in paths}
    results: list[tuple[float, Departure]] = []
    for difference, p in zip(differences, adjusted, strict=True):
        half = float(stdtrit(difference.dof, level)) * difference.error
        if p >= LEVEL or not reaches(abs(difference.size), half, difference.margin):
            continue
        ends = (difference.size - half, difference.size + half)
        change, low, high = (_plain(difference.quantity, end) for end in (difference.size, *ends))
        departure = Departure(
            *(robot, serial, difference.joint, difference.quantity, paths[-1], dates[paths[-1]]),
            *(dates[paths[0]], dates[paths[-2]], len(paths) - 1, change, (low, high), p),
        )
        results.append((difference.p, departure))
    return [departure for _, departure in sorted(results, key=lambda pair: pair[0])]


def _of_quantity(
    quantity: str, values: Frame, joints: Frame, paths: list[str]
) -> list[_Difference]:
    """Return the difference of each joint that has the quantity in the latest and in all earlier.

    Joints without an error in one of them are left out.
    """
    every = [pivoted(joints, column_of) for column_of in (values, *_errors(quantity, joints))]
    tables = [table for table in every if table is not None]
    if len(tables) < len(every):
        return []
    value, error, dof = (table.reindex(paths) for table in tables)
    whole = [name for name in value if value[name].notna().all() and error[name].notna().all()]
    rates: Mapping[str, float] = (
        joints.groupby("joint")["command_speed_rad_s"].max().to_dict()
        if quantity == "delay"
        else {}
    )
    if not whole:
        return []
    sizes, within, freedom = (table[whole].to_numpy(float) for table in (value, error, dof))
    error_of, dof_of = _error(sizes[:-1], within, freedom)
    change = sizes[-1] - sizes[:-1].mean(axis=0)
    return [
        _Difference(
            *(name, quantity, float(change[k]), float(error_of[k]), float(dof_of[k])),
            _margin(quantity, rates, name),
        )
        for k, name in enumerate(whole)
    ]


def _error(
    earlier: FloatArray, within: FloatArray, freedom: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return standard errors of the latest value less the mean of the earlier, and their freedom.

    Args:
        earlier: Values, shape (m, joints).
        within: Standard errors of all sessions' values, shape (m + 1, joints).
        freedom: Of these, shape (m + 1, joints).
    """
    count = len(earlier)
    weights = np.append(np.full(count, 1 / count**2), 1.0)[:, None]
    inside = np.sum(weights * within**2, axis=0)
    dof = welch_satterthwaite(weights * within**2, freedom)
    if count == 1:
        return np.sqrt(inside), dof
    scatter = earlier.var(axis=0, ddof=1)
    between = np.maximum(scatter, scatter.mean()) * (1 + 1 / count)
    return np.sqrt(np.maximum(between, inside)), np.minimum(dof, count - 1.0)


def _errors(quantity: str, joints: Frame) -> tuple[Frame, Frame]:
    """Return standard errors and their degrees of freedom, one a row of ``joints``."""
    dof = column(joints, "tracking_freedom").fillna(float(FEWEST))  # a gait's aren't recorded
    error: Frame = pd.Series(np.nan, joints.index)
    for name in _SOURCES[quantity]:
        middle, low, high = (column(joints, name + end) for end in ("", "_low", "_high"))
        larger = np.maximum(high - middle, middle - low)  # one that holds several models
        if quantity == "gain":
            larger = larger / middle
        if quantity == "offset":
            larger = larger.where(middle.notna())
        error = error.fillna(larger)
    numbers: list[float] = dof.to_list()
    factors = [t_factor(value) if value > 0 else np.nan for value in numbers]
    return error / factors, dof


def _margin(quantity: str, rates: Mapping[str, float], joint: str) -> float:
    """Return the difference that matters, in the unit of the values."""
    if quantity == "gain":
        return GAIN_MARGIN
    if quantity == "delay":
        return ANGLE_MARGIN_RAD / max(float(rates[joint]), TINY)
    return ANGLE_MARGIN_RAD


def _plain(quantity: str, value: float) -> float:
    return float(np.expm1(value)) if quantity == "gain" else value


def _date(start: Frame) -> str:
    return pd.Timestamp(start).isoformat(timespec="seconds")
