"""A robot over many sessions: joints that change, trends, variance components, outliers.

Gain enters by its logarithm and energy by that of the energy per second, so that a change is a
ratio; lag enters in rad.
"""

from __future__ import annotations

import json
import math
import warnings
from dataclasses import asdict, dataclass, field, replace
from typing import Any, TypeAlias

import numpy as np
import pandas as pd

from undulog.capture.common.arrays import FloatArray, IntArray
from undulog.capture.common.errors import MissingExtraError

from ..estimators.intervals import holm
from ..results.estimate import Interval
from .change_points import LEAST_SESSIONS, ChangePoint, Judged, Kind, find_change_points
from .session_noise import relative_to_others

_Frame: TypeAlias = Any  # pandas.DataFrame; its stubs don't know the columns' types

QUANTITIES = {"gain": "gain", "lag": "lag [rad]", "energy": "energy [W]"}
"""Quantity of a joint to its name with the unit."""

SIZES = {"gain": math.log(1.05), "lag": 0.05, "energy": math.log(1.1)}
"""Changes that matter, of ln gain, lag [rad] and ln energy: a twentieth of the amplitude, in phase
or a quarter of a cycle from it, and of energy, which goes with its square, twice that."""

_TRENDS = ("lag_sd", "gain_cv", "energy_cv", "cost_of_transport", "distance_m", "frequency_hz")
_LEAST_JOINTS = 3
_SAME = 1e-9  # relative: equal but for rounding
_MOST_UNCHANGED = 5
"""Robots without changes that the first sentence names."""
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
        change_ci95: Its 95 % interval.
        gradual: Whether the change takes time; else it is a step.
        t: Size over its standard error. A joint that wears moves its neighbours, too, and less.
        p: Family-wise over all joints, sessions and quantities of the robot.
    """

    joint: str
    quantity: str
    since: str
    date: str
    earliest: str
    latest: str
    change: float
    change_ci95: Interval
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
        p: Family-wise, as that of a change.
    """

    path: str
    date: str
    joint: str
    quantity: str
    deviation: float
    p: float


@dataclass(frozen=True)
class Memory:
    """How much a quantity remembers from session to session, and what could be found in it.

    Attributes:
        lag_one: Lag-one correlation, pooled over the joints, without bias in the median; None if no
            joint has enough sessions.
        upper: Its upper 90 % limit, for which the level holds.
        smallest_step: In the middle of the sessions, found in 9 of 10 robots; unit of
            :attr:`JointChange.change`.
        sessions_needed: About how many sessions show a step of :data:`SIZES`, or more than there
            are if no joint has enough. With fewer, that nothing is found decides nothing.
    """

    quantity: str
    lag_one: float | None
    upper: float | None
    smallest_step: float | None
    sessions_needed: int


@dataclass(frozen=True)
class RobotHistory:
    """One robot over its sessions.

    Attributes:
        serial: Serial number; empty if the sessions have none, and the name stands for one robot.
        sessions: Analysed sessions, of one set of joints.
        conditions: Sets of sessions with the same gait; joints are compared within each.
        warnings: What was left out, one sentence each.
    """

    robot: str
    serial: str
    sessions: int
    joints: tuple[str, ...]
    first: str
    last: str
    conditions: int
    changes: tuple[JointChange, ...]
    trends: tuple[Trend, ...]
    components: tuple[Components, ...]
    outliers: tuple[Outlier, ...]
    memory: tuple[Memory, ...]
    warnings: tuple[str, ...] = ()

    @property
    def label(self) -> str:
        """The robot's name, with its serial number if it has one."""
        return _label(self.robot, self.serial)


def _label(robot: str, serial: str) -> str:
    return f"{robot} ({serial})" if serial else robot


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
    serial = analysed["serial"] if "serial" in analysed else pd.Series("", analysed.index)
    names = [analysed["robot"].fillna("(no name)"), serial.fillna("")]
    for (robot, number), own in analysed.groupby(names, sort=True):
        history = _history(str(robot), str(number), own.sort_values("start"), joints)
        if isinstance(history, RobotHistory):
            histories.append(history)
        else:
            name = _label(str(robot), str(number))
            few = f"{history} of at least {LEAST_SESSIONS} analysed sessions with the same joints"
            left_out.append(f"{name}: not decided, {few}")
    answer = _answer(histories, left_out)
    if missing := len(sessions) - len(analysed):
        left_out.append(f"{missing} sessions are not analysed: undulog catalog --analyse")
    return Fleet(answer, tuple(histories), tuple(left_out))


def _answer(histories: list[RobotHistory], left_out: list[str]) -> str:
    changes = [(history, change) for history in histories for change in history.changes]
    if not histories:
        few = f" ({left_out[0]})" if left_out else ""
        return f"No robot has enough analysed sessions to compare them over time{few}."
    if not changes:
        return " ".join(map(_unchanged, histories[:_MOST_UNCHANGED]))
    history, change = max(changes, key=lambda pair: pair[1].t)
    more = len(changes) - 1
    others = f"; {more} more change{'s' if more > 1 else ''}" if more else ""
    return f"{history.label}: {sentence(change)}{others}{_correlations(history)}."


def _unchanged(history: RobotHistory) -> str:
    """Return what is known of a robot without changes: what would show, and what is open."""
    decided = [memory for memory in history.memory if memory.sessions_needed <= history.sessions]
    parts: list[str] = []
    if decided:
        sizes = ", ".join(
            f"{m.quantity} {_size_text(m.quantity, m.smallest_step)}" for m in decided
        )
        parts.append(
            f"no joint changes over {history.sessions} sessions, where steps show ({sizes})"
        )
    parts += [
        f"{m.quantity} not decided, {history.sessions} of about {m.sessions_needed} sessions"
        for m in history.memory
        if m not in decided
    ]
    return f"{history.label}: {'; '.join(parts)}{_correlations(history)}."


def _correlations(history: RobotHistory) -> str:
    known = [(memory.quantity, memory.lag_one) for memory in history.memory]
    listed = ", ".join(f"{name} {rho:.2f}" for name, rho in known if rho is not None)
    return f"; lag-one correlation of sessions: {listed}"


def _size_text(quantity: str, value: float | None) -> str:
    by = abs(value or 0.0)
    return f"{math.degrees(by):.2g}°" if quantity == "lag" else f"{by * 100:.2g} %"


def sentence(change: JointChange) -> str:
    """Return a change in words, without a full stop."""
    size = _size_text(change.quantity, change.change)
    way = "rises" if change.change > 0 else "falls"
    gradually = ", gradually," if change.gradual else ""
    return (
        f"the {change.quantity} of {change.joint} {way} by {size}{gradually} against the other "
        f"joints from {change.date[:10]} on (95 %: {change.earliest[:10]} to {change.latest[:10]})"
    )


def _history(robot: str, serial: str, sessions: _Frame, joints: _Frame) -> RobotHistory | int:
    """Return the history of a robot, or the number of its sessions where they are too few."""
    own = joints[joints["path"].isin(sessions["path"])]
    tables = {
        "gain": _table(own, np.log(own["gain"].where(own["gain"] > 0))),
        "lag": _table(own, own["lag_rad"]),
        "energy": _table(own, _log_power(own, sessions)),
    }
    tables = {name: table for name, table in tables.items() if table is not None}
    if "gain" not in tables or len(tables["gain"]) < LEAST_SESSIONS:
        return len(tables.get("gain", ()))
    ordered = sessions[sessions["path"].isin(tables["gain"].index)].set_index("path")
    tables = {name: table.reindex(ordered.index) for name, table in tables.items()}
    conditions = _conditions(own, ordered)
    times_s = ordered["start"].astype("int64").to_numpy() / 1e9
    relative = [relative_to_others(table.to_numpy(float), conditions) for table in tables.values()]
    judged = dict(zip(tables, find_change_points(relative, times_s, conditions), strict=True))
    points = [
        (name, str(tables[name].columns[point.joint]), point)
        for name, quantity in judged.items()
        for point in quantity.points
    ]
    points.sort(key=lambda named: -named[2].t)
    left_out = (
        [] if serial else [f"{robot}: taken as one robot by its name, without a serial number"]
    )
    if lacking := len(sessions) - len(ordered):
        left_out.append(f"{lacking} sessions lack the response of most joints")
    if partly := int(tables["gain"].isna().any(axis=1).sum()):
        left_out.append(f"{partly} sessions lack the response of a joint")
    return RobotHistory(
        robot=robot,
        serial=serial,
        sessions=len(ordered),
        joints=tuple(tables["gain"].columns),
        first=_date(ordered["start"].iloc[0]),
        last=_date(ordered["start"].iloc[-1]),
        conditions=len(np.unique(conditions)),
        changes=tuple(
            _change(*named, ordered) for named in points if named[2].kind is not Kind.OUTLIER
        ),
        trends=tuple(_trends(ordered)),
        components=tuple(_components(name, one, conditions) for name, one in tables.items()),
        outliers=tuple(
            _outlier(*named, ordered) for named in points if named[2].kind is Kind.OUTLIER
        ),
        memory=tuple(_memory(name, of, len(ordered)) for name, of in judged.items()),
        warnings=tuple(left_out),
    )


def _table(joints: _Frame, values: _Frame) -> _Frame | None:
    """Return values by session and joint, of joints in most sessions, sessions with most joints."""
    latest = joints.assign(value=values).dropna(subset=["value"])
    if latest.empty:
        return None
    table = latest.pivot_table(index="path", columns="joint", values="value", aggfunc="last")
    table = table.reindex(columns=latest.groupby("joint")["position"].first().sort_values().index)
    table = table.loc[:, table.notna().mean() >= 0.5]
    table = table[table.notna().sum(axis=1) >= max(_LEAST_JOINTS, table.shape[1] / 2)]
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


def _change(quantity: str, joint: str, point: ChangePoint, sessions: _Frame) -> JointChange:
    starts = sessions["start"]
    low, high = point.change_ci95
    return JointChange(
        joint=joint,
        quantity=quantity,
        since=str(sessions.index[point.session]),
        date=_date(starts.iloc[point.session]),
        earliest=_date(starts.iloc[point.first - 1]),
        latest=_date(starts.iloc[point.last]),
        change=_as_change(quantity, point.change),
        change_ci95=(_as_change(quantity, low), _as_change(quantity, high)),
        gradual=point.kind is Kind.GRADUAL,
        t=point.t,
        p=point.p,
    )


def _outlier(quantity: str, joint: str, point: ChangePoint, sessions: _Frame) -> Outlier:
    return Outlier(
        path=str(sessions.index[point.session]),
        date=_date(sessions["start"].iloc[point.session]),
        joint=joint,
        quantity=quantity,
        deviation=_as_change(quantity, point.change),
        p=point.p,
    )


def _memory(quantity: str, judged: Judged, sessions: int) -> Memory:
    """Return how much a quantity remembers, and what could be found in it."""
    if judged.noise is None:
        return Memory(quantity, None, None, None, max(LEAST_SESSIONS, sessions + 1))
    needed = math.ceil(sessions * (judged.smallest / SIZES[quantity]) ** 2)
    return Memory(
        quantity=quantity,
        lag_one=judged.noise.rho,
        upper=judged.noise.upper,
        smallest_step=_as_change(quantity, judged.smallest),
        sessions_needed=max(needed, LEAST_SESSIONS),
    )


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
