"""A robot over many sessions: joints that change, trends, variance components, outliers.

Of robots with few sessions the latest is compared with the earlier ones (:mod:`.earlier`).
"""

from __future__ import annotations

import json
import math
import warnings
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np
import pandas as pd

from undulog.capture.common.arrays import FloatArray, IntArray
from undulog.capture.common.errors import MissingExtraError

from ..common.estimate import Interval
from ..estimators.intervals import holm
from .change_points import (
    LEAST_SESSIONS,
    ChangePoint,
    DepartureKind,
    JudgedQuantity,
    find_change_points,
)
from .earlier import DIFFERENCES, Departure, departure_sentence, departures, size_text
from .joint_tables import Frame, by_session, conditions_of, values_of
from .session_noise import relative_to_others

QUANTITIES = {
    "gain": "gain",
    "lag": "lag [rad]",
    "delay": "lag [s]",
    "offset": "offset [rad]",
    "energy": "energy [W]",
}
"""Quantity of a joint to its name with the unit; a delay is the lag of any other motion."""

SIZES = {
    "gain": math.log(1.05),
    "lag": 0.05,
    "delay": 0.01,
    "offset": math.radians(1),
    "energy": math.log(1.1),
}
"""Changes that matter, of ln gain, lag [rad], delay [s], offset [rad] and ln energy: a twentieth of
the amplitude, in phase or a quarter of a cycle from it, and of energy, which goes with its square,
twice that; a delay of 10 ms is a twentieth of a cycle's radian at 0.8 Hz."""

_NAMES = {"delay": "lag"}
_TRENDS = ("lag_sd", "gain_cv", "energy_cv", "cost_of_transport", "distance_m", "frequency_hz")
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
        change: Ratio minus 1 for gain and energy; rad for lag and offset, s for delay.
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
class ResultTrend:
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
    trends: tuple[ResultTrend, ...]
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
        departures: Joints of robots with too few sessions for changes, whose latest session
            differs from the earlier ones; the surest first.
    """

    answer: str
    robots: tuple[RobotHistory, ...]
    warnings: tuple[str, ...] = field(default=())
    departures: tuple[Departure, ...] = ()

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
    table: Frame = sessions
    analysed = table[(table["status"] == "analysed") & table["start"].notna()]
    histories: list[RobotHistory] = []
    left_out: list[str] = []
    departed: list[Departure] = []
    serial = analysed["serial"] if "serial" in analysed else pd.Series("", analysed.index)
    names = [analysed["robot"].fillna("(no name)"), serial.fillna("")]
    for (robot, number), group in analysed.groupby(names, sort=True):
        history = _history(str(robot), str(number), group.sort_values("start"), joints)
        if isinstance(history, RobotHistory):
            histories.append(history)
        else:
            name = _label(str(robot), str(number))
            few = f"{history} of at least {LEAST_SESSIONS} analysed sessions with the same joints"
            left_out.append(f"{name}: not decided, {few}")
            of_robot = joints[joints["path"].isin(group["path"])]
            departed += departures(str(robot), str(number), group.sort_values("start"), of_robot)
    departed.sort(key=lambda departure: departure.p)
    answer = _answer(histories, left_out, departed)
    if missing := len(sessions) - len(analysed):
        left_out.append(f"{missing} sessions are not analysed: undulog catalog --analyse")
    return Fleet(answer, tuple(histories), tuple(left_out), tuple(departed))


def _answer(histories: list[RobotHistory], left_out: list[str], departed: list[Departure]) -> str:
    changes = [(history, change) for history in histories for change in history.changes]
    if not histories and not departed:
        few = f" ({left_out[0]})" if left_out else ""
        return f"No robot has enough analysed sessions to compare them over time{few}."
    sentences: list[str] = []
    if changes:
        history, change = max(changes, key=lambda pair: pair[1].t)
        more = len(changes) - 1
        others = f"; {more} more change{'s' if more > 1 else ''}" if more else ""
        sentences.append(f"{history.label}: {sentence(change)}{others}{_correlations(history)}.")
    if departed:
        first, more = departed[0], len(departed) - 1
        others = f"; {more} more difference{'s' if more > 1 else ''}" if more else ""
        label = _label(first.robot, first.serial)
        sentences.append(f"{label}: {departure_sentence(first)}{others}.")
    if not changes:
        sentences += map(_unchanged, histories[:_MOST_UNCHANGED])
    return " ".join(sentences)


def _unchanged(history: RobotHistory) -> str:
    """Return what is known of a robot without changes: what would show, and what is open."""
    decided = [memory for memory in history.memory if memory.sessions_needed <= history.sessions]
    parts: list[str] = []
    if decided:
        sizes = ", ".join(f"{m.quantity} {size_text(m.quantity, m.smallest_step)}" for m in decided)
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
    correlations = [(memory.quantity, memory.lag_one) for memory in history.memory]
    listed = ", ".join(f"{name} {rho:.2f}" for name, rho in correlations if rho is not None)
    return f"; lag-one correlation of sessions: {listed}"


def sentence(change: JointChange) -> str:
    """Return a change in words, without a full stop."""
    size, name = size_text(change.quantity, change.change), change.quantity
    way = "rises" if change.change > 0 else "falls"
    if name == "offset":
        way, size = "moved", f"{'+' if change.change > 0 else '−'}{size}"
    gradually = ", gradually," if change.gradual else ""
    return (
        f"the {_NAMES.get(name, name)} of {change.joint} {way} by {size}{gradually} against the "
        f"other joints from {change.date[:10]} on (95 %: {change.earliest[:10]} to "
        f"{change.latest[:10]})"
    )


def _history(robot: str, serial: str, sessions: Frame, joints: Frame) -> RobotHistory | int:
    """Return the history of a robot, or the number of its sessions where they are too few."""
    rows = joints[joints["path"].isin(sessions["path"])]
    tables = {
        name: table
        for name, values in values_of(rows, sessions).items()
        if (table := by_session(rows, values)) is not None
    }
    if "gain" not in tables or len(tables["gain"]) < LEAST_SESSIONS:
        return len(tables.get("gain", ()))
    ordered = sessions[sessions["path"].isin(tables["gain"].index)].set_index("path")
    tables = {name: table.reindex(ordered.index) for name, table in tables.items()}
    conditions = conditions_of(rows, ordered)
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
            _change(*named, ordered)
            for named in points
            if named[2].kind is not DepartureKind.OUTLIER
        ),
        trends=tuple(_trends(ordered)),
        components=tuple(_components(name, table, conditions) for name, table in tables.items()),
        outliers=tuple(
            _outlier(*named, ordered) for named in points if named[2].kind is DepartureKind.OUTLIER
        ),
        memory=tuple(_memory(name, of, len(ordered)) for name, of in judged.items()),
        warnings=tuple(left_out),
    )


def _change(quantity: str, joint: str, point: ChangePoint, sessions: Frame) -> JointChange:
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
        gradual=point.kind is DepartureKind.GRADUAL,
        t=point.t,
        p=point.p,
    )


def _outlier(quantity: str, joint: str, point: ChangePoint, sessions: Frame) -> Outlier:
    return Outlier(
        path=str(sessions.index[point.session]),
        date=_date(sessions["start"].iloc[point.session]),
        joint=joint,
        quantity=quantity,
        deviation=_as_change(quantity, point.change),
        p=point.p,
    )


def _memory(quantity: str, judged: JudgedQuantity, sessions: int) -> Memory:
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
    return value if quantity in DIFFERENCES else math.expm1(value)


def _date(start: Any) -> str:
    return pd.Timestamp(start).isoformat(timespec="seconds")


def _trends(sessions: Frame) -> list[ResultTrend]:
    """Kendall's tau of each result against the date and each number that a sweep varied."""
    from scipy import stats  # takes half a second

    trends: list[ResultTrend] = []
    for against, x in _covariates(sessions).items():
        for name in _TRENDS:
            y = sessions[name].to_numpy(float)
            finite = np.isfinite(x) & np.isfinite(y)
            count = int(np.count_nonzero(finite))
            if count < LEAST_SESSIONS or any(_is_constant(v[finite]) for v in (x, y)):
                continue
            tau: Any = stats.kendalltau(x[finite], y[finite])
            slope: Any = stats.theilslopes(y[finite], x[finite], alpha=0.95)
            trends.append(
                ResultTrend(
                    name,
                    against,
                    float(slope.slope),
                    (float(slope.low_slope), float(slope.high_slope)),
                    float(tau.statistic),
                    float(tau.pvalue),
                    count,
                )
            )
    trends.sort(key=lambda trend: trend.p)
    adjusted = holm(np.array([trend.p for trend in trends])).tolist()
    return [replace(trend, p=p) for trend, p in zip(trends, adjusted, strict=True)]


def _covariates(sessions: Frame) -> dict[str, FloatArray]:
    """Days since 1970, and the changes of the sweeps that the sessions come from."""
    changes = pd.DataFrame(
        [json.loads(text) if isinstance(text, str) else {} for text in sessions["changes"]]
    )
    days = sessions["start"].astype("int64").to_numpy() / 86_400e9
    numbers = changes.select_dtypes("number")
    return {"date": days} | {str(name): numbers[name].to_numpy(float) for name in numbers}


def _is_constant(values: FloatArray) -> bool:
    return bool(np.ptp(values) <= _SAME * np.abs(values).max())


def _components(name: str, table: Frame, conditions: IntArray) -> Components:
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
