"""Armed drives over a connection that stalls: the far end judges by its own arrival times.

The far end is a socketcand server of its own, with servos behind it, and nothing of undulog in it.
For each joint and any two of its commands, the later one differs from the earlier one by at most
``max_rate`` times the time between their arrivals, and by the steps that may be on their way
beside that (an arrival lies between two looks at the connection, which a busy machine spreads): one
where replies answer requests; where feedback comes unasked, one for each control tick until the
hold begins, and one more. Those ticks follow from the reply interval that the drive measured before
arming and wrote to its session; it may exceed that of the far end by :data:`SPREAD_S`.
"""

import math
import os
import random
import select
import socket
import struct
import time
from collections import deque
from contextlib import suppress
from dataclasses import dataclass, field

from mcap.reader import make_reader

from undulog.capture import load_robot

from .base import DBC, ROBOT, SCENARIO, write_files
from .case import Result, run_command

PERIOD_S = 0.01
MAX_RATE = 4.0
STEP = MAX_RATE * PERIOD_S
ROUNDING = math.radians(0.011)
LIMIT = 0.5235987755982988
SAFETY = f"""
[safety]
max_rate = {MAX_RATE}
ramp_rate = 1.0
max_tracking_error = 0.5
max_current = 5.0
max_temperature = 60.0
reply_timeout_s = 1.0
max_late_s = 1.0
"""
SPREAD_S = 0.05
"""What a busy machine may add to the gap between two states."""

DRIVE_S = 60.0
"""A drive of 3 s that takes so long hangs."""
POLLED = 0x14B


@dataclass
class FarEnd:
    """Servos at a socketcand server; the connection stalls at given times.

    Attributes:
        polled: Whether a servo only replies to requests.
        interval_s: How often unasked states are sent [s].
        latency_s: Of what is sent back [s].
        stalls: (Begin after the first command [s], length [s], whether only the way to the bus).
        bursts: Whether a router takes what comes meanwhile and delivers it at once; else nothing is
            read from the connection.
        commands: Joint to (arrival not before [s], nor after [s], angle [rad]).
    """

    polled: bool
    interval_s: float
    latency_s: float
    stalls: list[tuple[float, float]]
    bursts: bool
    pose: float
    commands: dict[int, list[tuple[float, float, float]]] = field(default_factory=dict)
    first_s: float | None = None
    longest_look_s: float = 0.0

    def __post_init__(self):
        """Listen."""
        self.server = socket.create_server(("127.0.0.1", 0))
        self.port = self.server.getsockname()[1]
        self._angles = dict.fromkeys(range(1 if self.polled else 4), self.pose)
        self._inbox = deque()
        self._outbox = deque()

    def serve(self, child):
        """Serve one client after the other until a process ends."""
        deadline = time.monotonic() + DRIVE_S
        self.server.settimeout(0.05)
        while time.monotonic() < deadline and _alive(child):
            try:
                link, _ = self.server.accept()
            except TimeoutError:
                continue
            link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._inbox.clear()
            self._outbox.clear()
            with link, suppress(OSError):
                link.sendall(b"< hi >")
                self._connected(link, deadline)

    def _connected(self, link, deadline):
        """Serve one client until it leaves."""
        text, opened, next_state = b"", False, time.monotonic()
        self._looked_s = time.monotonic()
        before = time.monotonic()
        while (now := time.monotonic()) < deadline:
            self.longest_look_s = max(self.longest_look_s, now - before)
            before, stalled = now, self._stalled(now)
            if stalled and not self.bursts:
                time.sleep(0.0005)
            elif select.select([link], [], [], 0.0005)[0]:
                data = link.recv(65536)
                if not data:
                    return
                *whole, text = (text + data).split(b">")
                self._inbox.extend(word.strip() for word in whole)
            if stalled:
                self._looked_s = now
                continue
            while self._inbox:
                word = self._inbox.popleft().strip(b"< ").split()
                if word[0] == b"send":
                    self._frame(int(word[1], 16), bytes(int(byte, 16) for byte in word[3:]))
                    continue
                if word[0] == b"rawmode":  # python-can takes its answer and a frame for one text
                    opened, next_state = True, time.monotonic() + 0.2
                answers = {b"open": b"< ok >", b"rawmode": b"< ok >", b"echo": b"< echo >"}
                self._outbox.append((0.0, answers.get(word[0], b"< error unknown command >")))
            self._looked_s, now = now, time.monotonic()
            if opened and not self.polled and now >= next_state:
                next_state = max(next_state + self.interval_s, now - self.interval_s)
                for joint, angle in self._angles.items():
                    raw = round(math.degrees(angle) * 100)
                    self._reply(0x200 + joint, struct.pack("<hhhh", raw, 0, 100, 0))
            while self._outbox and self._outbox[0][0] <= now:
                link.sendall(self._outbox.popleft()[1])

    def _stalled(self, now):
        if self.first_s is None:
            return False
        return any(begin <= now - self.first_s < begin + length for begin, length in self.stalls)

    def _reply(self, identifier, data):
        now = time.time()
        words = f"< frame {identifier:X} {now:.6f} {data.hex().upper()} >"
        self._outbox.append((time.monotonic() + self.latency_s, words.encode()))

    def _frame(self, identifier, data):
        now = time.monotonic()
        if self.polled and identifier == POLLED and data[0] == 0x92:
            raw = round(math.degrees(self._angles[0]) * 100)
            self._reply(POLLED, bytes([0x92]) + raw.to_bytes(7, "little", signed=True))
            return
        if self.polled and identifier == POLLED and data[0] == 0xA4:
            joint, angle = 0, math.radians(struct.unpack("<i", data[4:])[0] / 100)
            self._reply(POLLED, struct.pack("<BbhhH", 0xA4, 30, 10, 0, 0))
        elif not self.polled and 0x100 <= identifier < 0x104:
            joint = identifier - 0x100
            angle = math.radians(struct.unpack("<h", data[:2])[0] / 100)
        else:
            return
        if self.first_s is None:
            self.first_s = now
        self._angles[joint] = angle
        self.commands.setdefault(joint, []).append((self._looked_s, now, angle))

    def check(self, limit, measured_s):
        """Return the failures, and the largest number of steps beyond the rate.

        Args:
            limit: Of all angles [rad].
            measured_s: The reply interval that the drive measured [s].
        """
        failures, worst = [], 0.0
        if not self.polled and measured_s > self.interval_s + SPREAD_S:
            failures.append(f"reply interval: {measured_s:.3f} s, {self.interval_s:.3f} s sent")
        ticks = max(3, math.ceil(3 * max(self.interval_s, measured_s) / PERIOD_S - 1e-9))
        allowed = 1 if self.polled else ticks + 1
        for joint, rows in self.commands.items():
            if (most := max(abs(angle) for _, _, angle in rows)) > limit + ROUNDING:
                failures.append(
                    f"position: joint {joint} commanded to {most:.4f} rad, limit {limit:.4f}"
                )
            first_s = rows[0][0] - PERIOD_S
            low, high = self.pose - MAX_RATE * first_s, self.pose + MAX_RATE * first_s
            for after_s, until_s, angle in rows:
                worst = max(worst, angle - MAX_RATE * until_s - low)
                worst = max(worst, high - angle - MAX_RATE * until_s)
                low = min(low, angle - MAX_RATE * after_s)
                high = max(high, angle + MAX_RATE * after_s)
        if worst > allowed * STEP + 2 * ROUNDING:
            failures.append(
                f"step: {worst:.4f} rad beyond the rate, {allowed} x {STEP:.2f} allowed"
            )
        return failures, worst / STEP


def run(seed, stage):
    """Run one armed drive; every fifth is over a healthy bus and must finish.

    A far end that a busy machine stopped for two ticks or more was not healthy.
    """
    rng = random.Random(seed)
    polled, healthy = rng.random() < 0.5, seed % 5 == 0
    interval_s = rng.choice([0.01, 0.01, 0.05])
    stalls = [
        (rng.uniform(0.3, 2.0), math.exp(rng.uniform(math.log(0.02), math.log(5.0))))
        for _ in range(0 if healthy else rng.choice([1, 1, 2, 4]))
    ]
    latency_s = rng.choice([0.0, 0.0, 0.004, 0.016])
    bursts, pose = rng.random() < 0.5, rng.choice([0.0, 0.1])
    far = FarEnd(polled, interval_s, latency_s, stalls, bursts, pose)
    how = "polled" if polled else f"states each {1000 * interval_s:.0f} ms"
    gaps = ", ".join(f"{1000 * length:.0f} ms" for _, length in stalls) or "none"
    result = Result(f"drive, {how}, stalls: {gaps}{', in bursts' if far.bursts else ''}")
    with stage.fresh() as folder:
        _lay_out(folder, polled)
        on = f"can:socketcand:can0?host=127.0.0.1&port={far.port}"
        words = ["drive", "scenario.toml", "--on", on, "--arm", "-o", "new.mcap", "--duration", "3"]
        outcome = run_command(words, folder, meanwhile=far.serve)
        far.server.close()
        result.add(outcome)
        limit = 6283.2 if polled else LIMIT
        failures, worst = far.check(limit, _measured_s(folder / "new.mcap"))
        result.failures += failures
        result.at_most("steps_beyond_rate_polled" if polled else "steps_beyond_rate_unasked", worst)
        result.figures["n_commands"] = sum(map(len, far.commands.values()))
        ended = f"exit code {outcome.code}: {outcome.errors}"
        if not far.commands:
            result.failures.append(f"drive: nothing was sent: {ended}")
        elif healthy and outcome.code != 0 and far.longest_look_s < 2 * PERIOD_S:
            result.failures.append(f"drive: a healthy bus, and {ended}")
        elif any(length > 1.5 and begin < 1.5 for begin, length in stalls) and outcome.code == 0:
            result.failures.append("drive: exit code 0 though the bus stood still")
    return result


def _measured_s(path):
    """Return the reply interval of a drive's session [s]; 0 where none was armed."""
    if not path.exists():
        return 0.0
    with path.open("rb") as stream:
        records = {record.name: record.metadata for record in make_reader(stream).iter_metadata()}
    return float(records.get("undulog.gate.feedback", {}).get("reply_interval_s", 0.0))


def _lay_out(folder, polled):
    servo = load_robot("arcsnake-joint")
    robot, databases = (servo.toml, servo.databases) if polled else (ROBOT, {"snake4.dbc": DBC})
    scenario = SCENARIO.partition("[gait.vertical]")[0] if polled else SCENARIO
    for key, old, new in (
        ("duration_s", 0.1, 60.0),
        ("ramp_s", 0.02, 0.5),
        ("frequency_hz", 2.0, 1.5),
        ("amplitude", 0.1, 0.38),
    ):
        scenario = scenario.replace(f"{key} = {old}", f"{key} = {new}")
    texts = {"snake4.toml": robot + SAFETY, "scenario.toml": scenario}
    write_files(folder, dict(databases) | texts)


def _alive(child):
    """Return whether a child process still runs; it stays to be awaited."""
    return os.waitid(os.P_PID, child, os.WEXITED | os.WNOHANG | os.WNOWAIT) is None
