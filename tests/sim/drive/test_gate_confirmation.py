"""Commands confirmed by replies, over a connection that holds up and loses what it likes.

The connection is a model of its own with two queues; who judges is the far end's listener.
"""

import math
import random
from collections import deque

import numpy as np
import pytest

from support.far_end import beyond_rate, largest_burst
from undulog.capture import load_robot
from undulog.sim.drive.feedback import Confirmation, Silence
from undulog.sim.drive.limits import Clamp, gate_limits

LIMITS = gate_limits(load_robot("snake25"))
COUNT, PERIOD_S, STEP = 25, 0.01, 0.04
MS = 1_000_000
ARMED = 50  # ticks


class Connection:
    """Commands and requests up, replies down, each in order; held up at random, some lost."""

    def __init__(self, seed, loss, joints):
        self.chance, self.loss, self.joints = random.Random(seed), loss, joints
        self.up, self.down = deque(), deque()
        self.held_ms = {"up": 0, "down": 0}
        self.received, self.arrivals = np.zeros(COUNT, dtype=np.int64), []
        self.last_ms = 0

    def step(self, now_ms):
        for way, held_ms in self.held_ms.items():
            if now_ms >= held_ms and now_ms > 700 and self.chance.random() < 0.004:
                self.held_ms[way] = now_ms + self.chance.randint(1, 120)
        if now_ms >= self.held_ms["up"]:
            while self.up:
                command = self.up.popleft()
                if command is not None:
                    self.arrivals += [(now_ms / 1e3, 0, command)]
                else:
                    answers = [j for j in range(self.joints) if self.chance.random() >= self.loss]
                    self.down.append(answers)
        if now_ms >= self.held_ms["down"]:
            while self.down:
                self.received[self.down.popleft()] += 1
                self.last_ms = now_ms


@pytest.mark.parametrize("joints", [1, 25])
@pytest.mark.parametrize("loss", [0.0, 0.01])
def test_whatever_is_held_up_no_more_than_a_step_arrives_at_once(joints, loss):
    moved = []
    for seed in range(12):
        line, now = Connection(seed, loss, joints), [0]
        confirmation = Confirmation(LIMITS.rate[:joints], PERIOD_S, lambda now=now: now[0] * MS)
        clamp, silence = Clamp(LIMITS, np.zeros(COUNT), PERIOD_S), Silence()
        before = line.received.copy()
        for tick in range(600):
            fresh, before = line.received - before, line.received.copy()
            confirmation.receive(fresh[:joints], line.last_ms * MS)
            silence.tick(tick, received=fresh.any(), expected=not confirmation.pausing)
            if tick == ARMED:
                assert silence.measure()
                confirmation.arm(silence.interval, silence.limit, 8)
            if tick >= ARMED and not silence.silent:
                bounds = confirmation.bounds()
                if bounds is not None and joints == 1:
                    bounds = tuple(np.broadcast_to(bound, COUNT) for bound in bounds)
                command = clamp.apply(np.full(COUNT, 0.5 * math.sin(tick / 12)), bounds).command
                confirmation.send(command[:joints], np.zeros(joints))
                line.up.append(command[0])
            if confirmation.ask():
                line.up.append(None)
            for _ in range(10):
                now[0] += 1
                line.step(now[0])
        assert confirmation.by_replies
        assert largest_burst(line.arrivals, 0.004) <= STEP + 1e-9
        assert beyond_rate(line.arrivals, 4.0, PERIOD_S) <= 1e-9
        moved.append(np.abs(np.diff([angle for _, _, angle in line.arrivals])).sum())
    assert min(moved) > 3.0  # it moved on between the stalls


def test_the_interval_is_the_largest_gap_but_one():
    silence = Silence()
    for tick in range(60):
        assert not silence.measure() or tick > 20
        silence.interval = None
        silence.tick(tick, received=tick % 5 == 0 and tick != 30)
    assert silence.measure()
    assert (silence.interval, silence.limit) == (5, 15)
    for tick in range(60, 70):
        silence.tick(tick, received=False)
        assert silence.silent == (tick >= 70)  # the last one came at tick 55
    silence.tick(70, received=False)
    assert silence.silent
    silence.tick(71, received=True)
    silence.tick(200, received=False)  # the driving process paused
    assert not silence.silent
