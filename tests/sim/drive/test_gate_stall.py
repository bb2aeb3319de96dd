"""The gate under a far end that stops, delays, or delivers in bursts, judged at the far end.

Robot, router and drive are processes of their own (``far_end.py``); the far end's own arrival
times tell what reached the robot, and how fast. The clock of the robot is set again and again, and
so is that of the drive.
"""

import json
import math
import os
import signal
import sys
import time
from contextlib import contextmanager
from subprocess import PIPE

import numpy as np
import pytest

from support import far_end
from support.arm_limits import ARM_LIMITS
from support.far_end import beyond_rate, largest_burst
from support.processes import process, start
from support.witness import LateComputerError
from support.written_sessions import write_commands
from undulog.capture import Session, load_robot

# A stall of the far end, or of the way to it, is one of processes and of the kernel's sockets.
pytestmark = pytest.mark.clock(0.02, "processes are stopped, and routers delay what they route")

MAX_RATE, PERIOD_S = 4.0, 0.01
STEP = MAX_RATE * PERIOD_S
ROUNDING = 2 * math.radians(0.01)  # of two commands on the bus
# The wall clock is set by a day to and fro while it drives.
DRIVE = """
import sys, time
own, own_ns = time.time, time.time_ns
time.time = lambda: own() + 86400 * (int(own() / 0.9) % 2)
time.time_ns = lambda: own_ns() + 86400 * 10**9 * (int(own() / 0.9) % 2)
import undulog
sys.exit(undulog.run(sys.argv[1:]))
"""


@contextmanager
def running_far_end(*words):
    """One process, and its port."""
    with start(sys.executable, far_end.__file__, *words, stdin=PIPE, stderr=None) as far_process:
        try:
            yield far_process, int(far_process.stdout.readline())
        finally:
            far_process.kill()


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Commands at 3.25 rad/s, for the snake and for a servo that answers requests."""
    folder = tmp_path_factory.mktemp("stall")
    polled, unasked = load_robot("arcsnake-joint"), load_robot("snake25")
    wide = unasked.toml.replace("-0.5235987755982988", "-3.0").replace("0.5235987755982988", "3.0")
    tomls = {"polled": polled.toml + ARM_LIMITS, "unasked": wide}
    for name, text in (*polled.databases, *unasked.databases):
        (folder / name).write_text(text)
    for kind, toml in tomls.items():
        (folder / f"{kind}.toml").write_text(toml)
        robot = load_robot(folder / f"{kind}.toml")
        triangle = 2.6 * (1 - np.abs((np.arange(3000) + 80) % 320 - 160) / 80)
        commands = np.repeat(triangle[:, None], len(robot.joints), axis=1)
        write_commands(folder / f"{kind}.mcap", robot.joint_names, commands, robot=robot)
    return folder


class Drive:
    """A drive under way, and what came of it."""

    def __init__(self, robot, router, session):
        self.robot, self.router, self.path = robot, router, session

    def stop_far_end(self, seconds):
        os.kill(self.robot.pid, signal.SIGSTOP)
        time.sleep(seconds)
        os.kill(self.robot.pid, signal.SIGCONT)

    def route(self, line):
        self.router.stdin.write(f"{line}\n")
        self.router.stdin.flush()

    def end(self):
        """Wait for it: the exit code, the report, the session, and what arrived."""
        out, self.errors = self.running.communicate()
        self.code, self.report = self.running.returncode, json.loads(out)
        self.route("hold none")
        time.sleep(0.3)
        self.robot.stdin.close()
        report = json.loads(self.robot.stdout.readline())
        self.arrivals, self.pause_s = report["arrivals"], report["pause_s"]
        self.burst = largest_burst(self.arrivals)
        self.beyond = beyond_rate(self.arrivals, MAX_RATE, PERIOD_S)
        with Session.open(self.path) as session:
            self.phases = [message.data for _, message in session.messages("/gate/phase")]
            self.verdict, self.facts = session.verdict, session.metadata["undulog.gate.feedback"]

    def check_bound(self):
        """What arrived within 5 ms is within the bound that the session gives."""
        steps = int(self.facts["most_steps"])
        assert steps == (1 if self.facts["confirmed_by"] == "replies" else self.hold_after + 1)
        assert self.burst <= steps * STEP + ROUNDING
        if steps == 1:
            assert self.beyond <= ROUNDING

    @property
    def hold_after(self):
        return int(self.facts["hold_after_ticks"])

    def check_held(self):
        """It held, and was brought to rest."""
        assert (self.code, self.report["fault"]["kind"]) == (1, "silent")
        assert "the bus was silent: no joint was received for " in self.errors
        assert self.phases[:4] == ["reading the pose", "run", "hold", "ending"]
        assert (self.phases[-1], self.verdict) == ("ending", "bad")
        assert self.report["held_s"] > 0
        assert abs(self.arrivals[-1][2]) < ROUNDING


@contextmanager
def driving(folder, tmp_path, kind, *, period_s=0.01, latency_s=0.0, duration_s=3.0, route=()):
    path, which = tmp_path / "a.mcap", "unasked" if kind == "unasked" else "polled"
    with (
        running_far_end("robot", kind, period_s, latency_s) as (robot, port),
        running_far_end("router", port) as (router, front),
    ):
        drive = Drive(robot, router, path)
        for line in route:
            drive.route(line)
        on = f"can:socketcand:can0?host=127.0.0.1&port={front}&plain=yes"
        words = ["drive", str(folder / f"{which}.mcap"), "--on", on, "--arm", "--json"]
        words += ["-o", str(path), "--duration", str(duration_s)]
        env = os.environ | {"XDG_RUNTIME_DIR": str(tmp_path)}
        with process(sys.executable, "-c", DRIVE, *words, env=env) as drive.running:
            assert robot.stdout.readline() == "first\n", drive.running.communicate()
            time.sleep(1.2)
            yield drive


def cases(named, by_day):
    """Return parameters, of which others than those by day are for the night.

    Each kind of confirmation is stopped, and each way of a router delayed, in one of the cases by
    day; the rules themselves are tested on a simulated clock (``test_gate_machine.py``).
    """
    night = pytest.mark.nightly
    return [pytest.param(*v, id=k, marks=() if k in by_day else night) for k, v in named.items()]


STOPS = {f"{k}, {s} s": (k, s) for s in (0.2, 1.0, 5.0) for k in ("polled", "unasked")}


@pytest.mark.parametrize(("kind", "stall_s"), cases(STOPS, {"polled, 1.0 s", "unasked, 0.2 s"}))
def test_a_far_end_that_stops_is_held_and_then_brought_to_rest(folder, tmp_path, kind, stall_s):
    with driving(folder, tmp_path, kind, duration_s=4.0 + stall_s) as drive:
        drive.stop_far_end(stall_s)
        drive.end()
    drive.check_bound()
    drive.check_held()


BOTH = {kind: (kind,) for kind in ("polled", "unasked")}


@pytest.mark.parametrize("kind", cases(BOTH, {"polled"}))
def test_short_stalls_change_no_joint_beyond_the_bound(folder, tmp_path, kind):
    with driving(folder, tmp_path, kind, duration_s=5.0) as drive:
        for stall_s in (0.02, 0.03, 0.02, 0.025, 0.02):
            drive.stop_far_end(stall_s)
            time.sleep(0.3)
        drive.end()
    drive.check_bound()


WAYS = {
    "up": (["hold up", 0.4, "hold none"],),
    "down": (["hold down", 0.4, "hold none"],),
    "up, down": (["hold up", 0.025, "hold both", 0.1, "hold down", 0.1, "hold none"],),
    "bursts": (["bursts 0.025", 1.0, "bursts 0"],),
    "wide bursts": (["bursts 0.1", 1.0, "bursts 0"],),
    "late": (["late 0.015", 0.5, "late 0.1", 0.5, "late 0"],),
    "late bursts": (["late 0.02", "bursts 0.025", 1.0, "bursts 0"],),
}


@pytest.mark.parametrize("way", cases(WAYS, {"up, down", "late", "late bursts"}))
def test_a_router_on_the_way_makes_no_step_larger(folder, tmp_path, way):
    with driving(folder, tmp_path, "polled", duration_s=4.0) as drive:
        for part in way:
            if isinstance(part, str):
                drive.route(part)
            else:
                time.sleep(part)
        drive.end()
    drive.check_bound()


@pytest.mark.parametrize("kind", cases(BOTH, {"unasked"}))
def test_a_half_open_connection_ends_without_a_ramp(folder, tmp_path, kind):
    with driving(folder, tmp_path, kind, duration_s=20.0) as drive:
        drive.route("hold both")
        drive.end()
    drive.check_bound()
    assert (drive.code, drive.report["fault"]["kind"]) == (1, "silent")
    assert drive.report["held_s"] == pytest.approx(10.0, abs=1.0)
    assert drive.report["ended"].startswith("nothing more was sent")
    assert drive.phases[:3] == ["reading the pose", "run", "hold"]
    assert drive.phases[-2:] == ["hold", "done"]


HEALTHY = {
    "20 Hz": ("unasked", {"period_s": 0.05}),
    "20 Hz, asked": ("slow", {"period_s": 0.05}),
    "16 ms": ("unasked", {"route": ["late 0.016"]}),
    "16 ms, asked": ("polled", {"latency_s": 0.016}),
    "bursts": ("polled", {"route": ["bursts 0.025"]}),
    "lossy": ("lossy", {}),
}


@pytest.mark.parametrize(("kind", "more"), cases(HEALTHY, {"20 Hz", "16 ms, asked", "lossy"}))
def test_a_bus_that_is_slow_late_or_lossy_is_never_held(folder, tmp_path, kind, more):
    with driving(folder, tmp_path, kind, duration_s=4.0, **more) as drive:
        drive.end()
    if kind != "unasked":
        drive.check_bound()
    if drive.pause_s > 0.8 * float(drive.facts["hold_after_s"]):
        raise LateComputerError(f"{drive.pause_s:.3f} s, in which the robot could not report")
    assert (drive.code, drive.report["outcome"], drive.report["held_s"]) == (0, "complete", 0.0)
    assert drive.phases == ["reading the pose", "run"]
