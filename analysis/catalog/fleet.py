"""A robot over many sessions: joints that change, trends, variance components, outliers.

Gain enters by its logarithm and energy by that of the energy per second, so that a change is a
ratio; lag enters in rad.
"""

from __future__ import annotations

import json
import math
import warnings
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any, TypeAlias

import numpy as np
import pandas as pd

from undulog.capture.common.arrays import FloatArray, IntArray
from undulog.capture.common.errors import MissingExtraError

from ..estimators.intervals import holm
from ..results.estimate import Interval
from .change_points import LEAST_SESSIONS, LEVEL, find_change_points, relative_to_others

_Frame: TypeAlias = Any  # pandas.DataFrame; its stubs don't know the columns' types

QUANTITIES = {"gain": "gain", "lag": "lag [rad]", "energy": "energy [W]"}
"""Quantity of a joint to its name with the unit."""

_TRENDS = ("lag_sd", "gain_cv", "energy_cv", "cost_of_transport", "distance_m", "frequency_hz")
_LEAST_JOINTS = 3
_SAME = 1e-9  # relative: equal but for rounding
_MOST_OUTLIERS = 50
_MOST_ROWS = 2000  # of a mixed-effects model


@dataclass(frozen=True)
class JointChange:
    """A joint that responds differently from a session on.

    Attributes:
        quantity: Key of :data:`QUANTITIES`.
        since: Path of the first session after the change.
        date: Its start (UTC, ISO 8601).
        earliest: Start of the last session before the 95 % interval of the change.
        latest: Start of the last session in it.
        change: Ratio minus 1 for gain and energy; rad for lag.
        gradual: Whether the change takes time; else it is a step.
        t: Size over its standard error. A joint that wears moves its neighbours, too, and less.
        p: Family-wise over all joints and quantities of the robot.
    """

    joint: str
    quantity: str
    since: str
    date: str
    earliest: str
    latest: str
    change: float
    gradual: bool
    t: float
    p: float


@dataclass(frozen=True)
class Trend:
    """A monotonic trend of a result of sessions.

    Attributes:
        against: ``date`` (per day), or a parameter of a sweep.
        slope: Median of the slopes of all pairs (Theil and Sen), with its 95 % interval.
        tau: Kendall's rank correlation.
        p: Of no correlation, corrected by Holm's method over all trends of the robot.
    """

    quantity: str
    against: str
    slope: float
    slope_ci95: Interval
    tau: float
    p: float
    sessions: int


@dataclass(frozen=True)
class Components:
    """Standard deviations of a quantity by their cause, from a mixed-effects model (REML).

    Attributes:
        session: From session to session, all joints alike.
        joint: From joint to joint, all sessions alike.
        residual: The rest.
        why: Why there are none, or empty.
    """

    quantity: str
    session: float | None = None
    joint: float | None = None
    residual: float | None = None
    why: str = ""


@dataclass(frozen=True)
class Outlier:
    """A joint in a session that deviates from its other sessions and from the other joints.

    Attributes:
        deviation: In the unit of :attr:`JointChange.change`.
        p: Of a normal residual, corrected by Bonferroni over all joints and sessions.
    """

    path: str
    date: str
    joint: str
    quantity: str
    deviation: float
    p: float


@dataclass(frozen=True)
class RobotHistory:
    """One robot over its sessions.

    Attributes:
        sessions: Analysed sessions, of one set of joints.
        conditions: Sets of sessions with the same gait; joints are compared within each.
        warnings: What was left out, one sentence each.
    """

    robot: str
    sessions: int
    joints: tuple[str, ...]
    first: str
    last: str
    conditions: int
    changes: tuple[JointChange, ...]
    trends: tuple[Trend, ...]
    components: tuple[Components, ...]
    outliers: tuple[Outlier, ...]
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True)
class Fleet:
    """What the sessions of a catalogue say over time.

    Attributes:
        answer: The first sentence.
    """

    answer: str
    robots: tuple[RobotHistory, ...]
    warnings: tuple[str, ...] = field(default=())

    def to_dict(self) -> dict[str, Any]:
        """Return the result as plain JSON values."""
        return asdict(self)


def analyse_fleet(sessions: pd.DataFrame, joints: pd.DataFrame) -> Fleet:
    """Compare the sessions of each robot over time.

    Args:
        sessions: Rows of the view ``catalog``, as :meth:`.Catalog.find` returns them.
        joints: Rows of the view ``joints`` of the same sessions.

    Raises:
        MissingExtraError: If statsmodels is not installed.
    """
    table: _Frame = sessions
    analysed = table[(table["status"] == "analysed") & table["start"].notna()]
    histories: list[RobotHistory] = []
    left_out: list[str] = []
    for robot, own in analysed.groupby(analysed["robot"].fillna("(no name)"), sort=True):
        history = _history(str(robot), own.sort_values("start"), joints)
        if history is None:
            left_out.append(f"{robot}: no {LEAST_SESSIONS} analysed sessions with the same joints")
        else:
            histories.append(history)
    if missing := len(sessions) - len(analysed):
        left_out.append(f"{missing} sessions are not analysed: undulog catalog --analyse")
    return Fleet(_answer(histories), tuple(histories), tuple(left_out))


def _answer(histories: list[RobotHistory]) -> str:
    changes = [(history, change) for history in histories for change in history.changes]
    if not histories:
        return "No robot has enough analysed sessions to compare them over time."
    if not changes:
        n_sessions = sum(history.sessions for history in histories)
        return f"No joint changes over {n_sessions} sessions, at a family-wise level of 1 %."
    history, change = max(changes, key=lambda pair: pair[1].t)
    more = len(changes) - 1
    others = f"; {more} more change{'s' if more > 1 else ''}" if more else ""
    return f"{history.robot}: {sentence(change)}{others}."


def sentence(change: JointChange) -> str:
    """Return a change in words, without a full stop."""
    by = abs(change.change)
    size = f"{math.degrees(by):.2g}°" if change.quantity == "lag" else f"{by * 100:.2g} %"
    way = "rises" if change.change > 0 else "falls"
    gradually = ", gradually," if change.gradual else ""
    return (
        f"the {change.quantity} of {change.joint} {way} by {size}{gradually} against the other "
        f"joints from {change.date[:10]} on (95 %: {change.earliest[:10]} to {change.latest[:10]})"
    )


def _history(robot: str, sessions: _Frame, joints: _Frame) -> RobotHistory | None:
    own = joints[joints["path"].isin(sessions["path"])]
    tables = {
        "gain": _table(own, np.log(own["gain"].where(own["gain"] > 0))),
        "lag": _table(own, own["lag_rad"]),
        "energy": _table(own, _log_power(own, sessions)),
    }
    tables = {name: table for name, table in tables.items() if table is not None}
    if "gain" not in tables or len(tables["gain"]) < LEAST_SESSIONS:
        return None
    ordered = sessions[sessions["path"].isin(tables["gain"].index)].set_index("path")
    tables = {name: table.reindex(ordered.index) for name, table in tables.items()}
    conditions = _conditions(own, ordered)
    times_s = ordered["start"].astype("int64").to_numpy() / 1e9
    values = {name: table.to_numpy(float) for name, table in tables.items()}
    relative = {name: relative_to_others(one, conditions) for name, one in values.items()}
    changes = _changes(tables, relative, ordered, times_s, conditions)
    dropped = len(sessions) - len(ordered)
    return RobotHistory(
        robot=robot,
        sessions=len(ordered),
        joints=tuple(tables["gain"].columns),
        first=_date(ordered["start"].iloc[0]),
        last=_date(ordered["start"].iloc[-1]),
        conditions=len(np.unique(conditions)),
        changes=tuple(changes),
        trends=tuple(_trends(ordered)),
        components=tuple(_components(name, one, conditions) for name, one in tables.items()),
        outliers=tuple(_outliers(tables, relative, ordered, changes, conditions)),
        warnings=(f"{dropped} sessions lack the response of a joint",) if dropped else (),
    )


def _table(joints: _Frame, values: _Frame) -> _Frame | None:
    """Return values by session and joint, of the joints that most sessions have."""
    latest = joints.assign(value=values).dropna(subset=["value"])
    if latest.empty:
        return None
    table = latest.pivot_table(index="path", columns="joint", values="value", aggfunc="last")
    table = table.reindex(columns=latest.groupby("joint")["position"].first().sort_values().index)
    table = table.loc[:, table.notna().mean() >= 0.5].dropna()
    return table if table.shape[1] >= _LEAST_JOINTS and len(table) else None


def _log_power(joints: _Frame, sessions: _Frame) -> _Frame:
    length_s = joints["stop_s"] - joints["start_s"]
    whole_s = joints["path"].map(sessions.set_index("path")["duration_s"])
    power = joints["energy_abs_j"] / length_s.fillna(whole_s)
    return np.log(power.where(power > 0))


def _conditions(joints: _Frame, sessions: _Frame) -> IntArray:
    """Number the gaits: sessions of one frequency and one mean amplitude, to two digits."""
    driven = joints[joints["gain"].notna()]
    amplitude = driven.groupby("path")["command_amplitude_rad"].mean().reindex(sessions.index)
    frequency = driven.groupby("path")["frequency_hz"].mean().reindex(sessions.index)
    pairs = zip(amplitude.fillna(0.0), frequency.fillna(0.0), strict=True)
    keys = [f"{size:.1e}/{rate:.1e}" for size, rate in pairs]
    return np.unique(keys, return_inverse=True)[1].astype(np.int64)


def _changes(
    tables: Mapping[str, _Frame],
    relative: Mapping[str, FloatArray],
    sessions: _Frame,
    times_s: FloatArray,
    conditions: IntArray,
) -> list[JointChange]:
    found = find_change_points(list(relative.values()), times_s, conditions)
    starts = [_date(start) for start in sessions["start"]]
    changes = [
        JointChange(
            joint=str(tables[name].columns[point.joint]),
            quantity=name,
            since=str(sessions.index[point.session]),
            date=starts[point.session],
            earliest=starts[point.first - 1],
            latest=starts[point.last],
            change=_as_change(name, point.change),
            gradual=point.gradual,
            t=point.t,
            p=point.p,
        )
        for name, points in zip(relative, found, strict=True)
        for point in points
    ]
    return sorted(changes, key=lambda change: -change.t)


def _as_change(quantity: str, value: float) -> float:
    return value if quantity == "lag" else math.expm1(value)


def _date(start: Any) -> str:
    return pd.Timestamp(start).isoformat(timespec="seconds")


def _trends(sessions: _Frame) -> list[Trend]:
    """Kendall's tau of each result against the date and each number that a sweep varied."""
    from scipy import stats  # takes half a second

    found: list[Trend] = []
    for against, x in _covariates(sessions).items():
        for name in _TRENDS:
            y = sessions[name].to_numpy(float)
            known = np.isfinite(x) & np.isfinite(y)
            count = int(np.count_nonzero(known))
            if count < LEAST_SESSIONS or any(_is_constant(v[known]) for v in (x, y)):
                continue
            tau: Any = stats.kendalltau(x[known], y[known])
            slope: Any = stats.theilslopes(y[known], x[known], alpha=0.95)
            found.append(
                Trend(
                    name,
                    against,
                    float(slope.slope),
                    (float(slope.low_slope), float(slope.high_slope)),
                    float(tau.statistic),
                    float(tau.pvalue),
                    count,
                )
            )
    found.sort(key=lambda trend: trend.p)
    adjusted = holm(np.array([trend.p for trend in found])).tolist()
    return [replace(trend, p=p) for trend, p in zip(found, adjusted, strict=True)]


def _covariates(sessions: _Frame) -> dict[str, FloatArray]:
    """Days since 1970, and the changes of the sweeps that the sessions come from."""
    changes = pd.DataFrame(
        [json.loads(text) if isinstance(text, str) else {} for text in sessions["changes"]]
    )
    days = sessions["start"].astype("int64").to_numpy() / 86_400e9
    numbers = changes.select_dtypes("number")
    return {"date": days} | {str(name): numbers[name].to_numpy(float) for name in numbers}


def _is_constant(values: FloatArray) -> bool:
    return bool(np.ptp(values) <= _SAME * np.abs(values).max())


def _components(name: str, table: _Frame, conditions: IntArray) -> Components:
    """Fit value = condition + session + joint + residual, the last three random."""
    try:
        import statsmodels.formula.api as formulas
    except ImportError as error:
        raise MissingExtraError("report --catalog", "catalog", "statsmodels") from error
    smf: Any = formulas
    rows = table.rename_axis("session").reset_index().melt("session", value_name="value")
    condition = dict(zip(table.index, conditions, strict=True))
    rows = rows.dropna().assign(whole=1, condition=rows["session"].map(condition))
    formula = "value ~ C(condition)" if len(np.unique(conditions)) > 1 else "value ~ 1"
    parts = {"session": "0 + C(session)", "joint": "0 + C(joint)"}
    if len(rows) > _MOST_ROWS:  # the model's matrices have a row and a column each
        rows = rows[rows["session"].isin(table.index[:: -(-len(rows) // _MOST_ROWS)])]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            model: Any = smf.mixedlm(
                formula, rows, groups="whole", vc_formula=parts, re_formula="0", use_sparse=True
            )
            fitted = model.fit()
        except (ValueError, np.linalg.LinAlgError) as error:
            return Components(name, why=f"the model can't be fitted: {error}")
    variances = dict(zip(model.exog_vc.names, fitted.vcomp, strict=True))
    return Components(
        name,
        session=math.sqrt(max(0.0, variances["session"])),
        joint=math.sqrt(max(0.0, variances["joint"])),
        residual=math.sqrt(fitted.scale),
    )


def _outliers(
    tables: Mapping[str, _Frame],
    relative: Mapping[str, FloatArray],
    sessions: _Frame,
    changes: list[JointChange],
    conditions: IntArray,
) -> list[Outlier]:
    """Single values far from those of their joint, which are taken apart where it changes."""
    from scipy import stats

    found: list[Outlier] = []
    total = sum(values.size for values in relative.values())
    positions = {str(path): k for k, path in enumerate(sessions.index)}
    for name, values in relative.items():
        for column, joint in enumerate(tables[name].columns):
            apart = [positions[c.since] for c in changes if (c.joint, c.quantity) == (joint, name)]
            after = np.searchsorted(apart, np.arange(len(values)), side="right")
            residual = values[:, column].copy()
            for group in set(zip(conditions.tolist(), after.tolist(), strict=True)):
                rows = (conditions == group[0]) & (after == group[1])
                residual[rows] -= np.nanmedian(residual[rows])
            scale = float(stats.median_abs_deviation(residual, scale="normal", nan_policy="omit"))
            if not scale > 0:
                continue
            p = np.minimum(1.0, total * 2 * stats.norm.sf(np.abs(residual) / scale))
            found += [
                Outlier(
                    path=str(sessions.index[k]),
                    date=_date(sessions["start"].iloc[k]),
                    joint=str(joint),
                    quantity=name,
                    deviation=_as_change(name, float(residual[k])),
                    p=float(p[k]),
                )
                for k in np.flatnonzero(p <= LEVEL)
            ]
    return sorted(found, key=lambda outlier: outlier.p)[:_MOST_OUTLIERS]
