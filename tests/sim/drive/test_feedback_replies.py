"""Requests and replies of a bus that is asked: which are sent when, and what a reply confirms."""

import numpy as np
import pytest

from undulog.sim.drive.feedback import Confirmation

MS, PERIOD_S = 1_000_000, 0.01
RATE = np.array([4.0, 2.0])


class Line:
    """Counts for some joints, stepped once a control tick of a clock that stands still between.

    Attributes:
        ticks: The ticks in which requests were sent.
        paused: Those in which they paused.
    """

    def __init__(self, joints=1, armed=None):
        self.now_ms, self.ticks, self.paused, self._tick = 0, [], [], 0
        self.count = Confirmation(RATE[:joints], PERIOD_S, lambda: self.now_ms * MS)
        if armed is not None:
            self.count.arm(*armed)
        self._none = [0] * joints

    def step(self, *replies):
        self.count.receive(np.array(replies or self._none), self.now_ms * MS)
        asked = self.count.ask()
        self.ticks += [self._tick] * asked
        self.paused += [self._tick] * self.count.pausing
        self._tick, self.now_ms = self._tick + 1, self.now_ms + 10
        return asked

    def answering(self, ticks, delay, lost=(), until=10**9):
        """Run with replies so many ticks after requests but for some, by number from 1."""
        due = []
        for tick in range(ticks):
            if self.step(due.count(tick)) and len(self.ticks) not in lost and tick < until:
                due.append(tick + delay)
        return self


@pytest.mark.parametrize(
    ("armed", "ticks"),
    [
        # Before arming a round waits for 8 ticks; without any reply twice as long each time, to 50.
        (None, [0, 8, 24, 56, 106, 156]),
        # Two rounds under way, then 1.5 intervals, at least 2 ticks; twice as long where silent.
        ((1, 3, 99), [0, 1, 3, 7, 15, 31, 63, 113, 163]),
        ((2, 6, 99), [0, 1, 4, 7, 13, 25, 49, 97, 147, 197]),
        # Silent is the bus from the limit on.
        ((1, 4, 99), [0, 1, 3, 7, 15, 31, 63, 113, 163]),
        ((1, 5, 99), [0, 1, 3, 5, 9, 17, 33, 65, 115, 165]),
        # One round under way.
        ((3, 9, 99), [0, 5, 10, 20, 40, 80, 130, 180]),
        ((5, 15, 99), [0, 8, 16, 32, 64, 114, 164]),
    ],
)
def test_a_bus_that_says_nothing_is_asked_less_and_less_often(armed, ticks):
    line = Line(armed=armed).answering(200, 0, until=0)
    assert line.ticks == ticks
    assert line.paused == []
    line.step(1)
    quiet = Line(armed=armed).answering(400, 1, until=100).ticks
    patience = ticks[-1] - ticks[-2]
    assert patience == 50
    assert np.diff(quiet)[-1] == patience  # a reply set it back, then it grew again


@pytest.mark.parametrize(("interval", "patience"), [(1, 2), (2, 3), (3, 5), (4, 6), (5, 8)])
def test_a_reply_sets_the_patience_back(interval, patience):
    line = Line(armed=(interval, 3 * interval, 99))
    for _ in range(260):
        line.step(0)
    assert np.diff(line.ticks)[-1] == 50
    while not line.step(0):
        pass
    asked = len(line.ticks)
    line.step(1)  # one of many rounds: the others stay open
    for _ in range(patience + 1):
        line.step(0)
    after = [tick - line.ticks[asked - 1] for tick in line.ticks[asked:]]
    assert after[0] == 1 + patience


@pytest.mark.parametrize(
    ("armed", "delay", "lost", "asked"),
    [
        ((1, 3, 99), 1, (), set(range(60))),
        # The fifth reply is lost, in tick 5: in 16 rounds one more is under way than usual. Then
        # 2 x 3 ticks without a reply tell that none will come.
        ((1, 3, 99), 1, (5,), set(range(60)) - set(range(21, 27))),
        ((1, 3, 4), 1, (5,), set(range(60)) - set(range(21, 25))),  # the longest pause
        # Where all replies come it goes on at once.
        ((1, 3, 99), 2, (), set(range(60)) - {17, 35, 53}),
        ((2, 6, 99), 2, (), set(range(60))),
        ((2, 6, 99), 3, (), set(range(60)) - set(range(2, 60, 3))),
        # A slower bus: each round after the reply to the one before; a lost one by patience.
        ((3, 9, 99), 3, (), set(range(0, 60, 3))),
        ((3, 9, 99), 4, (), set(range(0, 60, 4))),
        ((3, 9, 99), 3, (5,), {0, 3, 6, 9, 12, 17, 25, 46, 49, 52, 55, 58}),
        ((5, 15, 99), 5, (5,), {0, 5, 10, 15, 20, 28, 41}),
    ],
)
def test_requests_go_on_as_replies_come_and_pause_where_some_were_lost(armed, delay, lost, asked):
    line = Line(armed=armed).answering(60, delay, lost)
    assert set(line.ticks) == asked
    assert line.count.by_replies


def test_a_pause_ends_when_no_reply_can_come_any_more():
    """After (k + 1) H ticks, with k rounds open and the bus never silent for H."""
    line = Line(armed=(1, 3, 99)).answering(60, 1, (5,))
    assert line.paused == list(range(21, 27))
    line = Line(armed=(3, 9, 99)).answering(60, 3, (5,))  # begun by a reply, in tick 28
    assert line.paused == list(range(33, 46))


def test_rounds_that_lag_only_now_and_then_do_not_pause():
    line = Line(armed=(1, 3, 99))
    line.step(0)
    for tick in range(200):  # each eighth tick the reply comes a tick late, with the next one
        line.step({6: 0, 7: 2}.get(tick % 8, 1))
    assert line.paused == []


def test_more_replies_than_requests_say_that_joints_report_unasked():
    line = Line(joints=2, armed=(1, 3, 99))
    line.step(0, 0)
    line.step(1, 1)
    assert line.count.by_replies
    line.count.send(np.zeros(2), np.zeros(2))
    assert line.count.bounds() is not None
    line.step(1, 2)
    assert not line.count.by_replies
    assert line.count.bounds() is None
    line.step(1, 0)
    line.step(1, 1)
    assert not line.count.by_replies  # for good


def test_replies_that_were_given_up_may_come_after_all():
    line = Line(armed=(1, 3, 99)).answering(30, 1, (5,))
    assert line.paused[-1] == 26
    assert line.step(2)  # that of the round before, and the one that was lost
    assert line.count.by_replies
    line.step(2)
    assert not line.count.by_replies


def test_what_another_joint_answered_the_bus_had_before():
    """Joint 2 answers none of five rounds: two rounds later each is given up and may come still."""
    line = Line(joints=2, armed=(1, 3, 99))
    line.step(0, 0)
    for _ in range(5):
        line.step(1, 0)
    line.step(1, 5)  # rounds 5 and 6 are open of it; 1 to 4 came after all
    assert line.count.by_replies
    line.step(1, 2)
    assert line.count.by_replies
    line.step(1, 2)  # one more than there were
    assert not line.count.by_replies


# -- bounds -------------------------------------------------------------------------------------


def test_a_command_bounds_the_next_ones_until_a_reply_to_a_later_request():
    line = Line(joints=2, armed=(1, 3, 99))
    count, commands = (
        line.count,
        [np.array(angles) for angles in ([0.3, 0.1], [0.32, 0.09], [0.35, 0.1])],
    )
    pose, step = np.array([0.28, 0.11]), RATE * PERIOD_S
    assert count.bounds() is None

    def bounds(*before, more_s=0.0):
        lower, upper = count.bounds()
        reach = [step] * (len(before) - 1)
        reach = [step + RATE * more_s, *reach]
        pairs = list(zip(before, reach, strict=True))
        np.testing.assert_allclose(lower, np.max([a - b for a, b in pairs], axis=0), atol=1e-15)
        np.testing.assert_allclose(upper, np.min([a + b for a, b in pairs], axis=0), atol=1e-15)

    count.send(commands[0], pose)
    bounds(pose)
    assert count.ask()
    line.now_ms = 10
    count.send(commands[1], np.full(2, 9.0))  # the pose matters for the first one only
    assert count.ask()
    bounds(pose, commands[0])
    line.now_ms = 12
    count.receive(np.array([1, 0]), 12 * MS)  # to the first request: it confirms the first command
    bounds(pose, commands[0])
    count.send(commands[2], np.full(2, 9.0))
    for now_ms, more_s in ((16, 0.0), (17, 0.005), (21, 0.009)):  # from half a period on
        line.now_ms = now_ms
        bounds(pose, *commands[:2], more_s=more_s)
    line.now_ms = 22  # a whole one: a step of its own is the narrower bound
    bounds(*commands[:2])
    bounds(*commands[:2])
    count.receive(np.array([0, 1]), 23 * MS)  # the first reply of joint 2: nothing new
    line.now_ms = 40
    bounds(*commands[:2])
    count.receive(np.array([1, 0]), 41 * MS)  # to the second request
    line.now_ms = 46
    bounds(commands[0], commands[1], more_s=0.005)
    line.now_ms = 51
    bounds(commands[1])


def test_replies_before_a_request_confirm_no_command():
    line = Line(armed=(1, 3, 99))
    line.step(0)
    line.count.send(np.array([0.1]), np.zeros(1))  # after the first request
    line.step(1)  # to the first one; the second one is sent now
    line.now_ms = 1000
    lower, upper = line.count.bounds()
    assert (lower[0], upper[0]) == (-0.04, 0.04)
    line.step(1)
    line.now_ms = 2000
    assert line.count.bounds() is None
