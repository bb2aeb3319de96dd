r"""What the bus reports back: feedback checked against its limits, and commands confirmed by it.

Whether a bus is silent, measured against the interval at which its joints report.

Before arming, the interval is measured as the largest gap but one between control ticks in which
the angle of any joint was received: a single pause does not count, a router that delivers in bursts
does. From then on the bus is silent when no joint was received for the larger of 3 ticks and 3
intervals.

At least 3 ticks have to take place without a joint. A process that was stopped itself sends nothing
meanwhile and finds what came as it goes on: its own pause is no silence of the bus.

A command is confirmed by a reply to a request that was sent after it: requests and commands keep
their order, so the command was at the robot before the request. Replies carry no number. They are
counted: the k-th reply of a joint answers its k-th request or a later one, so a count never
confirms too much, whatever was lost on the way. A reply of one joint confirms the commands of all,
since they share the way to the bus.

Let :math:`c_i` be the commands, sent at :math:`s_i`, and :math:`t_i` the time at which the
confirming reply of :math:`c_i` was received. Command i reached the robot at :math:`t_i` at the
latest, command j not before :math:`s_j`. The next command is bounded by

.. math:: |c_j - c_{i-1}| \le r T + r \max(0, s_j - t_i)

with the greatest rate r and the period T: one step where i is not confirmed. So a queue that is
delivered at once changes no joint by more than one step, and any stretch of w seconds at the robot
by no more than :math:`r (T + w)`. A confirmation counts half a period after it was received; a step
that follows a late delivery at once would look like a larger one.

Lost replies make the count lag. It is set right where a later round of requests has been answered
by another joint, or else by a pause: no request is sent, and commands stay within their step, until
all replies came or none of them can come any more: while the bus is never silent for H ticks, the
last of k replies that are not lost comes within (k + 1) H ticks.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass
from itertools import compress

import numpy as np

from undulog.capture.bus.map_entry import bus_messages, frame_id
from undulog.capture.common.arrays import NS, BoolArray, FloatArray, IntArray
from undulog.capture.common.errors import some_names
from undulog.capture.log.messages.frames import (
    DIR_RX,
    ERROR_FLAG,
    REMOTE_FLAG,
    FrameArray,
    identifier_text,
)
from undulog.capture.robot.model import Direction, Robot
from undulog.capture.sources.events import BUS_OFF

from .limits import GateLimits
from .outcome import FaultKind, GateFault, JointStatus

_IDENTIFIERS_SHOWN = 6

_INTERVALS = 3
_LEAST_TICKS = 3
_LEAST_GAPS = 4

_LESS = 0.8
_MORE = 0.02

_SHOWN = 4

# Rounds of requests under way, of a bus that answers within 20 ms; one of a slower bus.
_MOST_ROUNDS = 2
_FIRST_PATIENCE = 8  # ticks, before the reply interval is known
_MOST_PATIENCE = 50
# Rounds after which a count that lags all the time is taken for lost replies, by rounds under way:
# with one, a request before a reply is sent only after a time without.
_LAGGING = {1: 2, 2: 16}


class BusCheck:
    """Counts received frames by identifier and detects foreign ones.

    Attributes:
        known: Frames that the robot's databases know.
        strange: Identifier to number of frames that they don't.
    """

    def __init__(self, robot: Robot) -> None:
        """Start without frames.

        Args:
            robot: The robot; it has a bus map.

        Raises:
            DataError: If it has no bus.
        """
        bus, messages = bus_messages(robot)
        self._robot_name = robot.name
        self._identifiers = _sorted({frame_id(message) for message in messages.values()})
        reported = {s.message for s in bus.signals if s.direction is Direction.RX}
        commanded = {s.message for s in bus.signals if s.direction is Direction.TX}
        replies = {frame_id(messages[name]) for name in reported}
        # Where a request and its reply share an identifier, hearing it tells nothing.
        self._commands = _sorted({frame_id(messages[name]) for name in commanded} - replies)
        self.recognised = 0
        self.strange: Counter[int] = Counter()

    def add(self, frames: FrameArray) -> GateFault | None:
        """Add received frames.

        Args:
            frames: Records of :data:`.capture.log.messages.frames.FRAME_DTYPE`, shape (n,).

        Returns:
            The fault that ends a drive: bus-off, or commands of another controller.
        """
        ids = frames["id_flags"]
        errors = (ids & ERROR_FLAG) != 0
        if (ids[errors] & BUS_OFF).any():
            return GateFault(
                FaultKind.BUS_OFF, "bus-off: a controller left the bus, and its frames may be lost"
            )
        data = ids[~errors & ((ids & REMOTE_FLAG) == 0) & (frames["dir"] == DIR_RX)]
        data = data.astype(np.int64)
        recognised = np.isin(data, self._identifiers)
        self.recognised += int(recognised.sum())
        if not recognised.all():
            self.strange.update(data[~recognised].tolist())
        others = data[np.isin(data, self._commands)]
        if not len(others):
            return None
        return GateFault(
            FaultKind.STRANGER,
            f"another controller commands {self._robot_name} on this bus: frame "
            f"{identifier_text(int(others[0]))} was received; end that controller first",
        )

    def another_robot(self) -> str | None:
        """Return why the bus is that of another robot; None if it may be the right one."""
        if self.strange.total() <= self.recognised:
            return None
        listed = ", ".join(
            identifier_text(identifier)
            for identifier, _ in self.strange.most_common(_IDENTIFIERS_SHOWN)
        )
        return (
            f"another robot is on this bus: of {self.strange.total() + self.recognised} frames "
            f"received {self.recognised} are of {self._robot_name}; others have the identifiers "
            f"{listed}"
        )


def _sorted(identifiers: set[int]) -> IntArray:
    return np.array(sorted(identifiers), dtype=np.int64)


class Silence:
    """Counts control ticks in which no joint of a bus was received.

    Attributes:
        interval: Reply interval [control ticks]; None before it is measured.
        ticks: Control ticks since a joint was received.
    """

    def __init__(self) -> None:
        """Nothing was received yet."""
        self.interval: int | None = None
        self.ticks = 0
        self._tick = -1
        self._looked = 0  # ticks of these that took place
        self._gaps: list[int] | None = None  # None before the first reception

    @property
    def limit(self) -> int:
        """After so many ticks without a joint the bus is silent."""
        return max(_LEAST_TICKS, _INTERVALS * (self.interval or 1))

    @property
    def silent(self) -> bool:
        """Whether it is; never before the interval is measured."""
        long = self.ticks >= self.limit and self._looked >= _LEAST_TICKS
        return self.interval is not None and long

    def tick(self, tick: int, *, received: bool, expected: bool = True) -> None:
        """Count a control tick.

        Args:
            tick: Its number; some may have been left out before it.
            received: Whether the angle of a joint was received since the tick before.
            expected: Whether one should have been; else a tick without one is not counted.
        """
        before, self._tick = self._tick, tick
        if received or expected:
            self.ticks += tick - before
            self._looked += 1
        if not received:
            return
        if self._gaps is None:
            self._gaps = []
        elif self.interval is None:
            self._gaps.append(self.ticks)
        self.ticks = self._looked = 0

    def measure(self) -> bool:
        """Take the interval from what was received so far.

        Returns:
            Whether it was enough: five ticks in which a joint was received.
        """
        if self._gaps is None or len(self._gaps) < _LEAST_GAPS:
            return False
        self.interval = sorted(self._gaps)[-2]
        return True


class CurrentLimiter:
    """Keeps currents below their limits, as far as a position servo can be kept there.

    A position servo's current follows the distance of its command from the joint's angle. While
    the current is beyond its limit that distance shrinks by a fifth in each control tick; below it
    grows back by a fiftieth.
    """

    def __init__(self, limit: FloatArray) -> None:
        """Start without reduction.

        Args:
            limit: Greatest currents [A], NaN where there is none, shape (m,).
        """
        self._limit = limit
        self._share = np.ones(len(limit))

    @property
    def yields(self) -> BoolArray:
        """Joints that give way, shape (m,)."""
        return self._share < 1.0

    def apply(self, requested: FloatArray, angle: FloatArray, current: FloatArray) -> FloatArray:
        """Pull commands towards the measured angles where currents exceed their limits.

        Args:
            requested: Joint angles [rad], shape (m,).
            angle: Measured angles [rad], NaN where unknown, shape (m,).
            current: Measured currents [A], NaN where unknown, shape (m,).

        Returns:
            Joint angles [rad], shape (m,); untouched where nothing gives way.
        """
        beyond = np.abs(current) > self._limit  # False for NaN
        self._share = np.where(beyond, self._share * _LESS, np.minimum(self._share + _MORE, 1.0))
        pulls = self.yields & np.isfinite(angle)
        pulled = np.where(pulls, angle, 0.0)
        pulled += self._share * (requested - pulled)
        return np.where(pulls, pulled, requested)


class Watch:
    """Checks the readings of each tick against the limits."""

    def __init__(self, limits: GateLimits) -> None:
        """Start without a fault."""
        self._limits = limits
        never: FloatArray = np.full(len(limits.joint_names), np.nan)
        self._since_s = dict.fromkeys(FaultKind, never)

    def look(self, time_s: float, status: JointStatus, command: FloatArray) -> GateFault | None:
        """Check the readings at a tick.

        Args:
            time_s: Now, on the loop's clock [s].
            command: What they were commanded last [rad], shape (m,).

        Returns:
            The fault, None if all is well.
        """
        of, error = self._limits, np.abs(status.angle - command)
        faults = (
            self._lost(time_s, status.silence_s),
            self._excess(time_s, FaultKind.CURRENT, "A", np.abs(status.current), of.current),
            self._excess(time_s, FaultKind.TEMPERATURE, "degC", status.temperature, of.temperature),
            self._excess(time_s, FaultKind.VOLTAGE, "V", status.voltage, of.voltage),
            self._excess(time_s, FaultKind.TRACKING, "rad", error, of.tracking_error),
        )
        return next((fault for fault in faults if fault is not None), None)

    def _lost(self, time_s: float, silence_s: FloatArray) -> GateFault | None:
        limit_s = self._limits.reply_timeout_s
        silent = silence_s > limit_s
        if not silent.any():
            return None
        names = _named(self._limits.joint_names, silent)
        value = float(np.max(silence_s[silent]))
        return GateFault(
            FaultKind.LOST,
            f"{names} lost: no angle for more than {limit_s:g} s",
            joint=self._limits.joint_names[int(np.argmax(silent))] if silent.sum() == 1 else "",
            value=value,
            limit=limit_s,
            since_s=time_s - value,
        )

    def _excess(
        self, time_s: float, kind: FaultKind, unit: str, values: FloatArray, bound: FloatArray
    ) -> GateFault | None:
        beyond = values < bound if kind is FaultKind.VOLTAGE else values > bound  # False for NaN
        began = self._since_s[kind]
        since_s = np.where(beyond, np.where(np.isnan(began), time_s, began), np.nan)
        self._since_s[kind] = since_s
        due = beyond & (time_s - since_s >= self._limits.fault_after_s - 1e-9)
        if not due.any():
            return None
        joint = int(np.argmax(np.where(due, np.abs(values - bound), -np.inf)))
        name, value, limit = self._limits.joint_names[joint], values[joint], bound[joint]
        what = "tracking error" if kind is FaultKind.TRACKING else str(kind)
        than = "less than" if kind is FaultKind.VOLTAGE else "more than"
        return GateFault(
            kind,
            f"{name}: {what} {value:.3g} {unit}, {than} {limit:g} {unit} "
            f"for {time_s - since_s[joint]:.2g} s",
            joint=name,
            value=float(value),
            limit=float(limit),
            since_s=float(since_s[joint]),
        )


def _named(names: tuple[str, ...], chosen: BoolArray) -> str:
    """Return the chosen names as the subject of a sentence."""
    if chosen.all():
        return "the robot is"
    listed = list(compress(names, chosen))
    return some_names(listed, _SHOWN) + (" is" if len(listed) == 1 else " are")


@dataclass
class _Sent:
    """A command on its way: the one before it, the last round before it, and its confirmation."""

    before: FloatArray
    round: int
    confirmed_ns: int | None = None


class Confirmation:
    """Counts requests and replies, and bounds the next command.

    Attributes:
        by_replies: Whether readings answer requests, at most one each. Where there are more the
            joints report unasked, and commands are not bounded here.
        pausing: Whether requests pause, so that no joint can be expected to be received.
    """

    def __init__(self, rate: FloatArray, period_s: float, now_ns: Callable[[], int]) -> None:
        """Start without requests.

        Args:
            rate: Greatest rates [rad/s], shape (m,).
            period_s: Control period [s].
            now_ns: The session's clock [ns].
        """
        self.by_replies, self.pausing = True, False
        self._rate, self._period_s, self._now_ns = rate, period_s, now_ns
        self._open: list[deque[int]] = [deque() for _ in rate]  # rounds that may be answered yet
        self._given_up = [0] * len(rate)  # requests taken for lost
        self._round = self._answered = 0
        self._received = False  # since the newest round
        self._quiet = self._silent = 0  # ticks without a reply or a request; without a reply
        self._most, self._limit, self._longest = 1, 0, 0
        self._patience = self._wait = _FIRST_PATIENCE
        self._lags: deque[int] = deque(
            maxlen=max(_LAGGING.values())
        )  # rounds without a reply at each request
        self._usual = _MOST_PATIENCE
        self._last: FloatArray | None = None
        self._sent: list[_Sent] = []

    def arm(self, interval: int, limit: int, longest: int) -> None:
        """Set the measured properties of the bus; from here on commands may be sent.

        Args:
            interval: Reply interval [control ticks].
            limit: The bus is silent after so many control ticks.
            longest: The longest pause [control ticks]; a joint must not be taken for lost.
        """
        self._limit, self._longest = limit, longest
        self._patience = self._wait = max(2, math.ceil(1.5 * interval))
        self._most = _MOST_ROUNDS if interval <= _MOST_ROUNDS else 1
        self._usual = interval - 1 if interval <= _MOST_ROUNDS else 0
        self._lags = deque(maxlen=_LAGGING[self._most])

    def receive(self, replies: IntArray, received_ns: int) -> None:
        """Take the replies of a control tick.

        Args:
            replies: Angles received of each joint since the tick before, shape (m,).
            received_ns: When the last of them was received, on the session's clock [ns].
        """
        self._quiet, self._silent = self._quiet + 1, self._silent + 1
        if not replies.any():
            return
        self._quiet, self._silent, self._wait, self._received = 0, 0, self._patience, True
        for joint, (rounds, count) in enumerate(zip(self._open, replies.tolist(), strict=True)):
            if count > len(rounds):
                self._given_up[joint] -= count - len(rounds)  # they came after all
                self.by_replies = self.by_replies and self._given_up[joint] >= 0
            for _ in range(min(count, len(rounds))):
                self._answered = max(self._answered, rounds.popleft())
        for joint, rounds in enumerate(self._open):  # the bus had them before two that it answered
            while rounds and rounds[0] <= self._answered - 2:
                rounds.popleft()
                self._given_up[joint] += 1
        for sent in self._sent:
            if sent.confirmed_ns is None and sent.round < self._answered:
                sent.confirmed_ns = received_ns

    def ask(self) -> bool:
        """Whether to send the requests in this tick; counts them as sent."""
        lag = self._round - self._answered
        if self.pausing:
            if lag and self._quiet < min((lag + 1) * self._limit, self._longest):
                return False
            if lag:
                for joint, rounds in enumerate(self._open):
                    self._given_up[joint] += len(rounds)
                    rounds.clear()
            self._answered, lag, self.pausing = self._round, 0, False
            self._lags.clear()
        if lag >= self._most:
            if self._quiet < self._wait:
                return False
            if self._silent >= self._limit:  # it is held: less and less often
                self._wait = min(2 * self._wait, _MOST_PATIENCE)
        if self._received:
            self._lags.append(lag)
        else:
            self._lags.clear()
        if len(self._lags) == self._lags.maxlen and min(self._lags) > self._usual:
            self.pausing = True
            return False
        self._round += 1
        self._quiet, self._received = 0, False
        for rounds in self._open:
            rounds.append(self._round)
        return True

    def send(self, command: FloatArray, pose: FloatArray) -> None:
        """Take a command that was sent, before the requests of its tick.

        Args:
            command: Joint angles [rad], shape (m,).
            pose: The angles that the joints have [rad], shape (m,); the first command starts there.
        """
        self._sent.append(_Sent(pose if self._last is None else self._last, self._round))
        self._last = command

    def bounds(self) -> tuple[FloatArray, FloatArray] | None:
        """The least and the greatest command that may be sent now.

        Returns:
            Joint angles [rad], shapes (m,); None where nothing bounds them.
        """
        kept: list[_Sent] = []
        now_ns = self._now_ns()
        lower, upper = np.full_like(self._rate, -np.inf), np.full_like(self._rate, np.inf)
        for sent in self._sent:
            since_s = 0.0
            if sent.confirmed_ns is not None:
                since_s = (now_ns - sent.confirmed_ns) / NS
                if since_s >= self._period_s:
                    continue  # the bound of the step is the narrower one from here on
            kept.append(sent)
            allowed_s = self._period_s + (since_s if since_s >= self._period_s / 2 else 0.0)
            lower = np.maximum(lower, sent.before - self._rate * allowed_s)
            upper = np.minimum(upper, sent.before + self._rate * allowed_s)
        self._sent = kept
        return (lower, upper) if kept and self.by_replies else None
