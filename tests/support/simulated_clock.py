"""A clock that a test moves."""

from undulog.capture.common.clock import Clock

NS = 1_000_000_000


class SimulatedClock:
    """Time that passes only where it is slept, or where the test says so.

    Attributes:
        now_ns: Time, monotonic [ns]; the wall clock is ahead by ``wall_ahead_ns``.
        late_s: By how much the next sleeps are longer than asked for [s], each once.
        clock: What is given to the code under test.
    """

    def __init__(self, now_ns=5 * NS, wall_ahead_ns=1_700_000_000 * NS):
        self.now_ns, self.wall_ahead_ns = now_ns, wall_ahead_ns
        self.late_s = []
        self.clock = Clock(
            lambda: self.now_ns, lambda: self.now_ns + self.wall_ahead_ns, self._sleep
        )

    def _sleep(self, seconds):
        assert seconds >= 0
        self.pass_s(seconds + (self.late_s.pop(0) if self.late_s else 0.0))

    def pass_s(self, seconds):
        """Let time pass."""
        self.now_ns += round(seconds * NS)
