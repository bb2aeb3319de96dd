"""What the bus reports back, against plain models of it: requests, replies, bounds and silence."""

import random

import numpy as np
import pytest

from undulog.sim.drive.feedback import Confirmation, CurrentLimiter, Silence

MS = 1_000_000
PERIOD_MS = 10
RATE = np.array([4.0, 2.0, 1.0])


class Requests:
    """Rounds of requests, each with the joints that may answer it yet; from 1 on.

    Attributes:
        owed: Of each joint the requests that were taken for lost, and whose replies may come.
    """

    def __init__(self, joints):
        self.rounds, self.owed, self.count, self.answered = {}, [0] * joints, 0, 0
        self.by_replies, self.pausing, self.heard = True, False, False
        self.quiet = self.silent = 0
        self.most, self.limit, self.longest, self.usual = 1, 0, 0, 50
        self.patience = self.wait = 8
        self.lags, self.needed = [], 16
        self.commands = []  # the command before, the newest round before, its confirmation [ms]

    def arm(self, interval, limit, longest):
        self.limit, self.longest = limit, longest
        self.patience = self.wait = max(2, (3 * interval + 1) // 2)
        self.most, self.usual, self.needed = (2, interval - 1, 16) if interval < 3 else (1, 0, 2)
        self.lags = []

    def receive(self, replies, at_ms):
        self.quiet, self.silent = self.quiet + 1, self.silent + 1
        if not sum(replies):
            return
        self.quiet, self.silent, self.wait, self.heard = 0, 0, self.patience, True
        for joint, count in enumerate(replies):
            for _ in range(count):
                first = min((n for n, left in self.rounds.items() if joint in left), default=None)
                if first is None:
                    self.owed[joint] -= 1
                    self.by_replies &= self.owed[joint] >= 0
                else:
                    self.rounds[first].remove(joint)
                    self.answered = max(self.answered, first)
        self.give_up(self.answered - 2)
        for command in self.commands:
            if command[2] is None and self.answered > command[1]:
                command[2] = at_ms

    def give_up(self, last):
        for number in [n for n in self.rounds if n <= last]:
            for joint in self.rounds.pop(number):
                self.owed[joint] += 1

    def ask(self):
        lag = self.count - self.answered
        if self.pausing:
            if lag and self.quiet < min((lag + 1) * self.limit, self.longest):
                return False
            if lag:
                self.give_up(self.count)
            self.pausing, self.lags = False, []
            lag, self.answered = 0, self.count
        if lag >= self.most:
            if self.quiet < self.wait:
                return False
            if self.silent >= self.limit:
                self.wait = min(50, 2 * self.wait)
        self.lags = [*self.lags, lag] if self.heard else []
        if len(self.lags) >= self.needed and min(self.lags[-self.needed :]) > self.usual:
            self.pausing = True
            return False
        self.count += 1
        self.rounds[self.count] = set(range(len(self.owed)))
        self.quiet, self.heard = 0, False
        return True

    def bounds(self, now_ms, rate):
        """The bound of each command on its way, as the module states it."""
        self.commands = [c for c in self.commands if c[2] is None or now_ms - c[2] < PERIOD_MS]
        if not self.commands or not self.by_replies:
            return None
        lower, upper = np.full(len(rate), -np.inf), np.full(len(rate), np.inf)
        for before, _, confirmed_ms in self.commands:
            later_ms = 0 if confirmed_ms is None else now_ms - confirmed_ms
            span_s = (PERIOD_MS + (later_ms if 2 * later_ms >= PERIOD_MS else 0)) * 1e-3
            lower, upper = (
                np.fmax(lower, before - rate * span_s),
                np.fmin(upper, before + rate * span_s),
            )
        return lower, upper


def traffic(chance, joints, ticks):
    """How a bus answers: rounds and joints to delays [ticks], None where a reply is lost."""
    loss, slow = chance.choice([0.0, 0.0, 0.03, 0.3]), chance.choice([1, 1, 1, 2, 3, 4])
    dumb = chance.choice([None, None, chance.randrange(joints)])
    dead = range(chance.randrange(ticks), ticks) if chance.random() < 0.3 else range(0)
    dead = dead[: chance.choice([12, 70])]

    def delay(tick, joint):
        if tick in dead or joint == dumb or chance.random() < loss:
            return None
        return slow + (chance.random() < 0.05) * chance.randrange(1, 9)

    return delay


@pytest.mark.parametrize("joints", [1, 3])
def test_requests_pauses_and_bounds_are_those_of_a_plain_count(joints):
    paused = unasked = 0
    for seed in range(18):
        chance, now, rate = random.Random(seed), [0], RATE[:joints]
        count = Confirmation(rate, PERIOD_MS * 1e-3, lambda now=now: now[0] * MS)
        model, due, ticks = Requests(joints), {}, 140
        delay, interval = traffic(chance, joints, ticks), chance.choice([1, 1, 2, 3, 5])
        armed = interval, chance.choice([3, 3 * interval]), chance.choice([8, 8, 20, 0])
        extra, last = chance.random() < 0.15, None
        for tick in range(ticks):
            if tick == 12:
                count.arm(*armed)
                model.arm(*armed)
            replies = due.pop(tick, [0] * joints)
            if extra and chance.random() < 0.02:
                replies[chance.randrange(joints)] += chance.choice([1, 3])
            now[0] = tick * PERIOD_MS
            at_ms = now[0] - chance.choice([0, 1, 4, 5, 6, 9])
            count.receive(np.array(replies), at_ms * MS)
            model.receive(replies, at_ms)
            expected, bounds = model.bounds(now[0], rate), count.bounds()
            assert (bounds is None) == (expected is None), (seed, tick)
            if expected is not None:
                assert np.abs(np.subtract(bounds, expected)).max() < 1e-12, (seed, tick)
            if tick >= 12 and len(model.commands) < 5 and chance.random() < 0.8:
                command = np.array([chance.uniform(-0.5, 0.5) for _ in range(joints)])
                pose = np.zeros(joints)
                count.send(command, pose)
                model.commands.append([pose if last is None else last, model.count, None])
                last = command
            asked = count.ask()
            assert asked == model.ask(), (seed, tick)
            state = count.pausing, count.by_replies
            assert state == (model.pausing, model.by_replies), (seed, tick)
            paused, unasked = paused + model.pausing, unasked + (not model.by_replies)
            for joint in range(joints if asked else 0):
                if (late := delay(tick, joint)) is not None:
                    due.setdefault(tick + late, [0] * joints)[joint] += 1
    assert min(paused, unasked) > 8  # such things happened


@pytest.mark.parametrize("interval", [1, 2])
def test_ticks_of_silence_are_counted_from_the_first_one(interval):
    """Left-out ticks count, once one takes place; three have to take place."""
    for seed in range(30):
        chance, silence = random.Random(seed), Silence()
        silence.interval = interval
        share, tick, ticks, looked = chance.choice([0.1, 0.3]), 0, 0, 0
        left_out = 1  # since the last one that counted in full; the first tick is one
        for _ in range(60):
            received, expected = chance.random() < share, chance.random() < 0.8
            silence.tick(tick, received=received, expected=expected)
            if received:
                ticks = looked = 0
            elif expected:
                ticks, looked = ticks + left_out, looked + 1
            assert silence.ticks == ticks
            assert silence.silent == (looked >= 3 and ticks >= 3 * interval), (seed, tick)
            left_out = chance.choice([1, 1, 1, 2, 9])
            tick += left_out


def test_the_share_of_a_command_falls_by_a_fifth_and_grows_by_a_fiftieth():
    """Each joint by itself, at its own limit; a joint without a known angle is left alone."""
    chance, limit = random.Random(4), [1.0, 0.5, float("nan"), 2.0]
    limiter, shares = CurrentLimiter(np.array(limit)), [1.0] * 4
    for _ in range(120):
        commands, angle = ([chance.uniform(-1, 1) for _ in limit] for _ in range(2))
        current = [chance.choice([-1.0, 1.0]) * chance.choice([0.4, 1.0, 1.01, 3.0]) for _ in limit]
        if chance.random() < 0.2:
            angle[chance.randrange(4)] = float("nan")
            current[chance.randrange(4)] = float("nan")
        limited = limiter.apply(*map(np.array, (commands, angle, current)))
        for joint, most in enumerate(limit):
            beyond = abs(current[joint]) > most
            share = shares[joint] * 0.8 if beyond else min(1.0, shares[joint] + 0.02)
            shares[joint] = share
            at, to = angle[joint], commands[joint]
            expected = to if share == 1.0 or np.isnan(at) else at + share * (to - at)
            assert limited[joint] == pytest.approx(expected, abs=1e-12)
        assert limiter.yields.tolist() == [share < 1.0 for share in shares]
    assert min(shares[:2]) < 1.0 == shares[2]
