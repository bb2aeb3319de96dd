"""Processes of a driven robot that are killed or stopped at random moments, judged from outside.

The listener on the bus speaks socketcand itself and takes the frames apart by the small robot's
layout; the far end of :mod:`.gate` and the driver of the serial line contain nothing of undulog
either. What is judged:

- after ``kill -9`` of a drive no command comes, and the servos hold their last ones;
- a drive that was stopped goes on without a jump: no command is more than one step from the one
  before it, however long the stop was, and after a long one the drive ends with exit code 1;
- beside a robot that was stopped, commands keep their step, and a recorder has every frame that the
  listener has;
- beside a live view that was stopped, a recorder has every frame that the kernel accepted, and the
  view goes on.
"""

import json
import math
import os
import random
import re
import select
import signal
import socket
import struct
import sys
import termios
import threading
import time
from collections import Counter
from contextlib import ExitStack, contextmanager, suppress

from support import gate_stage
from support.paths import ROOT
from support.processes import UNDULOG, serving, wait_for
from support.read_back import messages_of

from . import gate
from .case import Result, run_command
from .recording import AT_DATA, RECORD, check_kept, end, recorder, senders, start

COMMAND, STATE, JOINTS = 0x101, 0x201, len(gate_stage.JOINTS)
"""Identifiers of the first joint in the robot's database, and the number of joints."""

STEP = gate_stage.MAX_RATE / gate_stage.RATE_HZ + gate_stage.STEP * (1 + 1e-6)
"""Largest step from one command to the next [rad], with the bus's rounding."""

SETTLED_S = 2.0
"""Time that a servo needs to reach a command that stays, and a body to come to rest [s]."""
HELD = math.radians(3.0)
"""Distance of a joint from a command that it holds [rad]: friction of the ground."""
STILL = math.radians(0.5)
"""Motion of a joint that holds within a second [rad]: the body slides to rest on the ground."""
PATIENCE_S = 60.0
FRAME = re.compile(rb"< frame ([0-9A-Fa-f]+) [0-9.]+ ([0-9A-Fa-f]*) >")


class Listener(threading.Thread):
    """All frames of a bus of socketcand, each with its time of arrival [s]."""

    def __init__(self, port):
        super().__init__(daemon=True)
        self.rows = []
        self._link = socket.create_connection(("127.0.0.1", port), 10)
        for word in (None, b"< open can0 >", b"< rawmode >"):
            if word is not None:
                self._link.sendall(word)
            self._link.recv(4096)
        self._link.settimeout(None)
        self.start()

    def run(self):
        rest = b""
        with suppress(OSError):
            while chunk := self._link.recv(65536):
                now, text = time.monotonic(), rest + chunk
                whole = text.rfind(b">") + 1
                rest = text[whole:]
                self.rows += [
                    (now, int(match[1], 16), bytes.fromhex(match[2].decode()))
                    for match in FRAME.finditer(text[:whole])
                ]

    def close(self):
        """End, with all that has come."""
        with suppress(OSError):
            self._link.shutdown(socket.SHUT_RDWR)
        self.join(10)
        self._link.close()

    def angles(self, first):
        """Return the angles of each joint from one frame a joint on: times [s], angles [rad]."""
        angles_of = {joint: [] for joint in range(JOINTS)}
        for at_s, identifier, data in tuple(self.rows):
            if 0 <= identifier - first < JOINTS:
                angle = math.radians(struct.unpack("<h", data[:2])[0] / 100)
                angles_of[identifier - first].append((at_s, angle))
        return angles_of

    @property
    def commands(self):
        """Number of commands so far."""
        return sum(0 <= row[1] - COMMAND < JOINTS for row in tuple(self.rows))


def check_steps(commands, result):
    """No command is more than one step from the one before; the first begins at straight joints."""
    worst = 0.0
    for joint, rows in commands.items():
        before = 0.0
        for at_s, angle in rows:
            if abs(angle - before) > STEP:
                result.failures.append(
                    f"step: joint {joint} from {before:.4f} to {angle:.4f} rad at {at_s:.3f} s"
                )
            worst, before = max(worst, abs(angle - before)), angle
    result.at_most("largest_step_rad", worst)
    result.figures["n_commands"] = sum(map(len, commands.values()))


@contextmanager
def driven(folder, *, max_late_s=0.5):
    """A virtual robot of four joints that waits for commands, and a listener on its bus."""
    safety = gate_stage.SAFETY | {"max_late_s": max_late_s}
    _, scenario = gate_stage.robot_files(folder, safety=safety)
    text = scenario.read_text().replace("amplitude = 0.1", "amplitude = 0.38")
    scenario.write_text(text.replace("frequency_hz = 0.5", "frequency_hz = 1.0"))
    with serving(scenario, "--wait", cwd=ROOT) as (robot, ready):
        listener = Listener(ready["port"])
        try:
            yield robot, listener, f"can:socketcand:can0?host=127.0.0.1&port={ready['port']}"
        finally:
            listener.close()


def drive(folder, on, meanwhile, seconds):
    words = ["drive", "short.toml", "--on", on, "--arm", "-o", "new.mcap"]
    return run_command([*words, "--duration", seconds], folder, meanwhile=meanwhile)


def begun(listener, child, rng):
    """Wait until the drive commands, and some more."""
    until = time.monotonic() + PATIENCE_S
    while listener.commands < 4 * JOINTS:
        if time.monotonic() > until or not gate._alive(child):
            return
        time.sleep(0.01)
    time.sleep(rng.uniform(0.0, 3.0))


# -- cases ----------------------------------------------------------------------------------------


def kill_drive(rng, stage):
    """``kill -9`` of an armed drive: the servos hold their last commands."""
    result = Result("armed drive, SIGKILL")
    with stage.fresh() as folder, driven(folder) as (robot, listener, on):
        killed_s = 0.0

        def kill(child):
            nonlocal killed_s
            begun(listener, child, rng)
            os.kill(child, signal.SIGKILL)
            killed_s = time.monotonic()

        outcome = drive(folder, on, kill, 60)
        time.sleep(SETTLED_S + 1.5)
        result.measure(outcome)
        if "the bus was silent" in outcome.errors:
            result.skipped = "a busy machine held up the virtual robot"
            return result
        if outcome.signal != signal.SIGKILL:
            result.failures.append(
                f"drive: ended before, exit code {outcome.code}: {outcome.errors}"
            )
        if robot.poll() is not None:
            result.failures.append("robot: it ended with the drive")
        commands, states = listener.angles(COMMAND), listener.angles(STATE)
        check_steps(commands, result)
        late = [at_s for rows in commands.values() for at_s, _ in rows if at_s > killed_s + 0.5]
        if late:
            result.failures.append(f"commands: {len(late)} came after the kill")
        for joint, rows in states.items():
            last = commands[joint][-1][1]
            held = [angle for at_s, angle in rows if at_s > killed_s + SETTLED_S]
            before = [angle for at_s, angle in rows if at_s <= killed_s]
            if len(held) < 20 or not before:
                result.failures.append(f"states: {len(held)} of joint {joint} after the kill")
                continue
            result.at_most("from_last_command_rad", max(abs(angle - last) for angle in held))
            result.at_most("moved_while_held_rad", max(held) - min(held))
            result.at_most("moved_after_kill_rad", abs(held[-1] - before[-1]))
            if max(abs(angle - last) for angle in held) > HELD:
                result.failures.append(f"hold: joint {joint} is not at its last command {last:.3f}")
            if max(held) - min(held) > STILL:
                result.failures.append(f"hold: joint {joint} moves on")
        result.at_most("last_command_rad", max(abs(rows[-1][1]) for rows in commands.values()))
    return result


STOPS_S = (0.05, 1.0, 10.0)
"""Lengths of a stop [s]: within ``max_late_s``, beyond it, and beyond all time-outs."""


def stop_drive(rng, stage):
    """SIGSTOP and SIGCONT of an armed drive: it goes on without a jump."""
    length = rng.choice(STOPS_S)
    polled = rng.random() < 0.5
    far = gate.FarEnd(polled, 0.01, rng.choice([0.0, 0.004]), [], False, rng.choice([0.0, 0.1]))
    result = Result(f"armed drive stopped for {length:g} s, {'polled' if polled else 'unasked'}")
    with stage.fresh() as folder:
        gate._lay_out(folder, polled)
        path = folder / "snake4.toml"
        path.write_text(path.read_text().replace("max_late_s = 1.0", "max_late_s = 0.5"))

        def stop(child):
            while far.first_s is None:
                time.sleep(0.01)
                if not gate._alive(child):
                    return
            time.sleep(rng.uniform(0.2, 1.8))
            with suppress(ProcessLookupError):
                os.kill(child, signal.SIGSTOP)
                time.sleep(length)
                os.kill(child, signal.SIGCONT)

        def meanwhile(child):
            stopper = threading.Thread(target=stop, args=(child,), daemon=True)
            stopper.start()
            far.serve(child)
            stopper.join(20)

        on = f"can:socketcand:can0?host=127.0.0.1&port={far.port}"
        words = ["drive", "scenario.toml", "--on", on, "--arm", "-o", "new.mcap", "--duration", "3"]
        outcome = run_command(words, folder, meanwhile=meanwhile)
        far.server.close()
        result.add(outcome)
        limit = 6283.2 if polled else gate.LIMIT
        result.failures += far.check(limit, gate._measured_s(folder / "new.mcap"))[0]
    commands = {j: [(at, angle) for _, at, angle in rows] for j, rows in far.commands.items()}
    moved = {j: [(at, angle - far.pose) for at, angle in rows] for j, rows in commands.items()}
    check_steps(moved, result)
    if not commands:
        result.failures.append(f"drive: nothing was sent: {outcome.errors}")
    if length >= 1.0 and outcome.code != 1:
        result.failures.append(f"drive: exit code {outcome.code} after a stop of {length:g} s")
    if length < 1.0 and outcome.code not in (0, 1):
        result.failures.append(f"drive: exit code {outcome.code}: {outcome.errors}")
    result.figures["n_ended"] = outcome.code
    return result


def stop_robot(rng, stage):
    """SIGSTOP and SIGCONT of the virtual robot under a drive, a recorder and a listener."""
    length = rng.choice((0.05, 1.0, 3.0))
    result = Result(f"virtual robot stopped for {length:g} s under a drive and a recorder")
    with stage.fresh() as folder, driven(folder) as (robot, listener, on), ExitStack() as stack:
        control = folder / "control.sock"
        words = [*UNDULOG, "record", f"can0={on}", "--robot", folder / "snake4.toml", "--quiet"]
        words += ["--floor", "0", "--socket", control, "-o", folder / "run.mcap"]
        recording = start(stack, *words, cwd=ROOT)
        wait_for(control.exists, "the recorder", alive=[recording])
        time.sleep(1.0)

        def stop(child):
            begun(listener, child, rng)
            robot.send_signal(signal.SIGSTOP)
            time.sleep(length)
            robot.send_signal(signal.SIGCONT)

        outcome = drive(folder, on, stop, 5)
        result.add(outcome)
        time.sleep(1.0)
        heard = list(listener.rows)
        if (code := end(recording)) != 0:
            result.failures.append(f"recorder: exit code {code}")
        check_steps(listener.angles(COMMAND), result)
        if outcome.code not in (0, 1) or (length >= 1.0 and outcome.code == 0):
            result.failures.append(f"drive: exit code {outcome.code}: {outcome.errors}")
        kept = Counter(_frames(folder / "run.mcap"))
        # The recorder connected after the listener: from the first command on it has all.
        first = next((k for k, row in enumerate(heard) if 0 <= row[1] - COMMAND < JOINTS), 0)
        counter = Counter((row[1], row[2]) for row in heard[first:])
        if lost := (counter - kept).total():
            result.failures.append(f"lost: {lost} of {counter.total()} frames of the bus")
        result.figures["n_frames"] = counter.total()
    return result


def _frames(path):
    """Yield identifier and data of the frames of a session, by mcap's own reader."""
    for *_, message in messages_of(path, topics=["/can/can0"], log_time_order=False):
        data, size = message.data, len(message.data)
        at = size - RECORD  # the array is the last field: a length before it, then whole records
        while at >= RECORD and struct.unpack_from("<I", data, at - 4)[0] != size - at:
            at -= RECORD
        for row in range(at, size, RECORD):
            identifier, length = struct.unpack_from("<IB", data, row + 16)
            yield identifier & 0x1FFFFFFF, bytes(data[row + AT_DATA : row + AT_DATA + length])


def stop_live(rng, stage):
    """SIGSTOP and SIGCONT of the relay of a live view under two senders."""
    length = rng.uniform(0.3, 3.0)
    result = Result(f"live view stopped for {length:.1f} s under a recorder")
    with stage.fresh() as folder, ExitStack() as stack:
        live, saved = folder / "control.live", folder / "live.rrd"
        with recorder(folder, ("a", "b")) as running:
            wait_for((folder / "control.sock").exists, "the recorder", alive=[running])
            words = [*UNDULOG, "view", "--live", live, "--save", saved, "--json"]
            report = stack.enter_context((folder / "view.json").open("wb"))
            view = start(stack, *words, cwd=ROOT, stdout=report)
            wait_for(live.exists, "the view", alive=[view])
            how = {"rate": 2000, "per_packet": rng.choice([1, 9]), "seconds": length + 4.0}
            with senders(folder, ("a", "b"), **how) as sending:
                for sender in sending:
                    sender.wait_for(200)
                time.sleep(rng.uniform(0.0, 1.0))
                view.send_signal(signal.SIGSTOP)
                time.sleep(length)
                view.send_signal(signal.SIGCONT)
                reports = [sender.result() for sender in sending]
            if (code := end(running)) != 0:
                result.failures.append(f"recorder: exit code {code}")
            view.wait(PATIENCE_S)
        for sender, counted in zip(sending, reports, strict=True):
            result.failures += check_kept(folder, sender, counted["accepted"])
            result.figures["n_accepted"] = result.figures.get("n_accepted", 0) + counted["accepted"]
        if view.returncode != 0:
            result.failures.append(f"view: exit code {view.returncode}")
        else:
            seen = json.loads((folder / "view.json").read_text())
            result.figures["n_shown"] = seen["shown"]
            if not seen["sessions"] or not saved.exists():
                result.failures.append(f"view: {seen}")
    return result


# -- a serial line --------------------------------------------------------------------------------

SERVOS = range(1, 13)
ARM = """
description = "Twelve STS3215 servos on flat ground."
robot = "snake12-sts3215"
duration_s = 600.0
gait.horizontal = { amplitude = 0.4, frequency_hz = 0.5, lag = 0.52 }
"""
DRIVER = """
import math, os, sys, termios, time, tty
line = os.open(sys.argv[1], os.O_RDWR | os.O_NOCTTY)
tty.setraw(line)
k = 0
while True:
    body = bytes([0xFE, 4 + 3 * 12, 0x83, 42, 2])
    for servo in range(1, 13):
        step = 2048 + round(0.4 * math.sin(math.pi * k / 50 - 0.52 * servo) * 4096 / (2 * math.pi))
        body += bytes([servo, step & 0xFF, step >> 8])
    os.write(line, b"\\xff\\xff" + body + bytes([~sum(body) & 0xFF]))
    k += 1
    print(k, flush=True)
    time.sleep(0.02)
"""
"""A driver of Feetech servos, one sync write of all goals each 20 ms."""


def registers(line, address):
    """Return a register of two bytes of each servo, by read requests of our own."""
    values = {}
    for servo in SERVOS:
        body = bytes([servo, 4, 2, address, 2])
        os.write(line, b"\xff\xff" + body + bytes([~sum(body) & 0xFF]))
        answer, until = b"", time.monotonic() + 5
        while len(answer) < 8 and time.monotonic() < until:
            if select.select([line], [], [], 0.1)[0]:
                answer += os.read(line, 64)
        if len(answer) >= 8:
            values[servo] = struct.unpack_from("<H", answer, 5)[0]
    return values


def kill_serial(rng, stage):
    """``kill -9`` of a driver of serial servos: they hold their last goals."""
    result = Result("driver of serial servos, SIGKILL")
    with stage.fresh() as folder, ExitStack() as stack:
        (folder / "sts.toml").write_text(ARM)
        port = folder / "line"
        words = [*UNDULOG, "sim", "serve", folder / "sts.toml", "--feetech", port, "--json"]
        robot = start(stack, *words, cwd=ROOT, stdout=(folder / "robot.out").open("wb"))
        wait_for(port.exists, "the robot", alive=[robot])
        steps = folder / "driver.out"
        driver = start(stack, sys.executable, "-c", DRIVER, port, stdout=steps.open("wb"))
        wait_for(lambda: len(steps.read_bytes().split()) > 100, "the driver", alive=[driver])
        time.sleep(rng.uniform(0.0, 2.0))
        driver.kill()
        driver.wait(30)
        last = int(steps.read_bytes().split()[-1])
        time.sleep(SETTLED_S)
        line = os.open(port, os.O_RDWR | os.O_NOCTTY)
        try:
            termios.tcflush(line, termios.TCIFLUSH)
            goals = registers(line, 42)
            first = registers(line, 56)
            time.sleep(1.0)
            then, again = registers(line, 56), registers(line, 42)
        finally:
            os.close(line)
        # The last write may have ended before it was printed, or its goals not have come.
        choices = [
            {
                s: 2048 + round(0.4 * math.sin(math.pi * k / 50 - 0.52 * s) * 4096 / (2 * math.pi))
                for s in SERVOS
            }
            for k in (last - 2, last - 1, last)
        ]
        if goals not in choices:
            result.failures.append(f"goals: {goals} are not those of the last write")
        if again != goals:
            result.failures.append("goals: they change without a driver")
        for servo in SERVOS:
            if servo not in first or servo not in then or servo not in goals:
                result.failures.append(f"servo {servo}: no answer")
                continue
            unit = 2 * math.pi / 4096
            result.at_most("moved_while_held_rad", unit * abs(then[servo] - first[servo]))
            result.at_most("from_last_command_rad", unit * abs(then[servo] - goals[servo]))
            if unit * abs(then[servo] - goals[servo]) > HELD:
                result.failures.append(f"hold: servo {servo} is not at its goal")
            if unit * abs(then[servo] - first[servo]) > STILL:
                result.failures.append(f"hold: servo {servo} moves on")
        if robot.poll() is not None:
            result.failures.append("robot: it ended with the driver")
    return result


CASES = (
    kill_drive,
    stop_drive,
    stop_robot,
    stop_live,
    kill_serial,
    kill_drive,
    stop_drive,
    stop_drive,
)
"""In turn by the seed; the first five are one of each."""


def run(seed, stage):
    """Run one case."""
    return CASES[seed % len(CASES)](random.Random(seed), stage)
