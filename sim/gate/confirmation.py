r"""Commands confirmed by the bus, where its joints answer requests.

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
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from undulog.capture.common.arrays import FloatArray, IntArray

# Rounds of requests under way, of a bus that answers within 20 ms; one of a slower bus.
_MOST_ROUNDS = 2
_FIRST_PATIENCE = 8  # ticks, before the reply interval is known
_MOST_PATIENCE = 50
# Rounds after which a count that lags all the time is taken for lost replies, by rounds under way:
# with one, a request before a reply is sent only after a time without.
_LAGGING = {1: 2, 2: 16}
_NS = 1e9


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
        for joint, (own, count) in enumerate(zip(self._open, replies.tolist(), strict=True)):
            if count > len(own):
                self._given_up[joint] -= count - len(own)  # they came after all
                self.by_replies = self.by_replies and self._given_up[joint] >= 0
            for _ in range(min(count, len(own))):
                self._answered = max(self._answered, own.popleft())
        for joint, own in enumerate(self._open):  # the bus had them before two that it answered
            while own and own[0] <= self._answered - 2:
                own.popleft()
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
                for joint, own in enumerate(self._open):
                    self._given_up[joint] += len(own)
                    own.clear()
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
        for own in self._open:
            own.append(self._round)
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
                since_s = (now_ns - sent.confirmed_ns) / _NS
                if since_s >= self._period_s:
                    continue  # the bound of the step is the narrower one from here on
            kept.append(sent)
            allowed_s = self._period_s + (since_s if since_s >= self._period_s / 2 else 0.0)
            lower = np.maximum(lower, sent.before - self._rate * allowed_s)
            upper = np.minimum(upper, sent.before + self._rate * allowed_s)
        self._sent = kept
        return (lower, upper) if kept and self.by_replies else None
