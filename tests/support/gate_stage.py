"""A small robot, its process, a listener, and checks, for the tests of the armed gate.

Robot, listener and controller are processes of their own. What was on the bus is judged by what the
listener wrote, with python-can and cantools; sessions are read by the ``mcap`` package itself.
"""

import json
import math
import signal
import sys
from contextlib import ExitStack, contextmanager
from pathlib import Path

import can
import numpy as np
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from support.processes import UNDULOG, pause, process, serving, wait_for
from support.twin_chains import snake4
from support.witness import LateComputerError
from support.written_sessions import write_commands
from undulog.capture import load_robot

LISTENER = Path(__file__).with_name("bus_listener.py")
RATE_HZ = 100
MARK = 0x7F0  # an identifier that nobody else uses
SILENT = "the bus was silent: no joint was received for "
MOST_GAP_S = 2 / RATE_HZ  # without a reply, after which three control ticks may find none
STEP = math.radians(0.01)  # of a command on the bus
JOINTS = ("joint01", "joint02", "joint03", "joint04")
LIMIT, MAX_RATE, RAMP_RATE = math.radians(30.0), 4.0, 1.0
FRAME = np.dtype(
    [
        *(("t_device_ns", "<u8"), ("t_host_ns", "<u8"), ("id_flags", "<u4")),
        *(("dlc", "u1"), ("dir", "u1"), ("pad", "V2"), ("data", "u1", (8,))),
    ]
)

SAFETY = {
    "max_rate": MAX_RATE,
    "ramp_rate": RAMP_RATE,
    "max_tracking_error": 0.3,
    "max_current": 1.4,
    "max_temperature": 70.0,
    "reply_timeout_s": 1.0,  # a busy machine must not look like a robot that is lost
    "max_late_s": 1.5,
    "fault_after_s": 0.5,
    "on_fault": '"ramp-down"',
}

SIGNALS = (
    ("command", "position", "tx", "command", "deg"),
    ("state", "position", "rx", "position", "deg"),
    ("state", "velocity", "rx", "velocity", "deg/s"),
    ("state", "torque", "rx", "effort", "mN m"),
    ("state", "current", "rx", "current", "mA"),
)
SCENARIO = """
description = "Four joints on flat ground."
robot = "{robot}"
duration_s = 600.0
[gait.horizontal]
amplitude = 0.1
frequency_hz = 0.5
lag = 1.0
"""


def robot_files(folder, *, safety=SAFETY):
    """Write the small robot and a scenario for it; return both files."""
    folder.mkdir(exist_ok=True)
    (folder / "snake25.dbc").write_text(dict(load_robot("snake25").databases)["snake25.dbc"])
    text = snake4("snake25.dbc", SIGNALS)
    if safety:
        text += "[safety]\n" + "".join(f"{key} = {value}\n" for key, value in safety.items())
    robot, scenario = folder / "snake4.toml", folder / "short.toml"
    robot.write_text(text)
    scenario.write_text(SCENARIO.format(robot=robot.name))
    return robot, scenario


def wave(times_s):
    """Return four sines that do not begin at zero [rad], shape (n, 4)."""
    turns = 0.25 * times_s[:, None] + np.array([0.2, 0.0, 0.6, 0.35])
    return np.array([0.3, 0.15, 0.45, 0.1]) * np.sin(2 * np.pi * turns)


def commanded(path, robot, duration_s, *, names=JOINTS, commands=wave):
    """Write a session of commands for a robot (its name or file)."""
    given = commands(np.arange(round(duration_s * RATE_HZ) + 1) / RATE_HZ)
    facts = {"robot": load_robot(robot), "clock": {"computer": "host"}}
    return write_commands(path, names, given[:, : len(names)], **facts)


class Stage:
    """A virtual robot and a listener on its bus.

    Attributes:
        robot: The robot's process.
        bus: Name of the bus.
        port: Its port.
        on: Its address.
        lockstep: Whether the robot waits for commands at each tick.
    """

    def __init__(self, robot, bus, port, listener, heard, *, lockstep):
        self.robot, self.bus, self.port, self.lockstep = robot, bus, port, lockstep
        self.on = f"can:socketcand:{bus}?host=127.0.0.1&port={port}"
        self._listener, self._heard = listener, heard

    @property
    def lines(self):
        """Return all frames received so far."""
        text = self._heard.read_text() if self._heard.exists() else ""
        return [json.loads(line) for line in text[: text.rfind("\n") + 1].splitlines()]

    @property
    def command_lines(self):
        """Return the commands among the received frames."""
        return [line for line in self.lines if (line["name"] or "").endswith("_command")]

    @property
    def longest_gap_s(self):
        """Return the longest time without a reply, from the first command on [s].

        On the computer's clock, or on that of the bus: the listener may be late as well.
        """
        lines = self.lines
        first_s = self.command_lines[0]["t_s"]
        replies = [line for line in lines if (line["name"] or "").endswith("_state")]
        times_s = [[reply["t_s"], reply["bus_s"]] for reply in replies if reply["t_s"] >= first_s]
        return float(np.diff(times_s, axis=0).max())

    def _heard_of(self, words):
        """Count lines with some words, without reading each line as JSON many times a second."""
        return self._heard.read_bytes().count(words.encode()) if self._heard.exists() else 0

    def words(self, session, output, *more):
        """Return the command line of the armed controller."""
        return (*UNDULOG, "replay", session, "--on", self.on, "--arm", "-o", output, *more)

    def replay(self, session, output, *more, **options):
        """Run the armed controller as a process."""
        return process(*self.words(session, output, *more), **options)

    def wait_for_commands(self, controller, count=150):
        """Wait until a number of ticks was commanded."""
        most = count * len(JOINTS)
        wait_for(lambda: self._heard_of('_command"') >= most, "commands", alive=[controller])

    def settle(self, quiet_s=0.3):
        """Wait while frames may still be sent, and until all of them are received.

        A frame of our own is sent then: once the listener has it, it has all that came before.
        """
        pause(quiet_s)
        if self.lockstep:  # the robot is silent where nobody commands it
            heard = -1
            while heard != (heard := len(self.lines)):
                pause(2.0)
        elif self.robot.poll() is None:
            place = {"host": "127.0.0.1", "port": self.port, "channel": self.bus}
            with can.Bus(interface="socketcand", **place) as bus:
                bus.send(can.Message(arbitration_id=MARK, is_extended_id=False))
                wait_for(lambda: self._heard_of(f'"id": {MARK},'), "the mark")
        self._listener.send_signal(signal.SIGTERM)
        _, complained = self._listener.communicate()
        assert self._listener.returncode == 0, complained


@contextmanager
def staged(folder, scenario, *faults, pace="--wait"):
    """Run a virtual robot with planned faults, and a listener on its bus.

    Times of faults are after the first command: the robot waits for it, and tells its pose.
    """
    ordered = [word for fault in faults for word in ("--fault", fault)]
    database, heard = folder / "listened.dbc", folder / "heard.jsonl"
    database.write_text(dict(load_robot("snake25").databases)["snake25.dbc"])
    with serving(scenario, pace, *ordered) as (robot, ready):
        words = (sys.executable, LISTENER, ready["port"], ready["bus"], database, heard)
        with process(*words) as listener:
            assert listener.stdout.readline() == "listening\n", listener.stderr.read()
            where = ready["bus"], ready["port"]
            yield Stage(robot, *where, listener, heard, lockstep=pace == "--lockstep")


class Driving:
    """A drive over the bus of the small robot, with a listener.

    Attributes:
        silence: Whether a silent bus is what was ordered; else it says that the computer was late.
    """

    def __init__(self, start, *, silence=False):
        self.silence, self._running = silence, ExitStack()
        self.stage, self.controller, self.path = start(self._running)

    def begun(self, count=150):
        """Wait until so many ticks were commanded."""
        try:
            self.stage.wait_for_commands(self.controller, count)
        except AssertionError as error:
            self._check_silence(str(error))
            raise

    def close(self):
        self._running.close()

    def signal(self, number, pause_s=0.0):
        self.controller.send_signal(number)
        pause(pause_s)

    def communicate(self):
        out, err = self.controller.communicate()
        self.stage.settle()
        self._check_silence(err or "")
        return out, err

    def _check_silence(self, words):
        if SILENT in words and not self.silence and self.stage.longest_gap_s > MOST_GAP_S:
            raise LateComputerError(f"{self.stage.longest_gap_s:.3f} s, between two replies")

    def ended(self, code=1):
        """Wait for the end, and check all of it; returns output, errors and the session."""
        out, err = self.communicate()
        assert self.controller.returncode == code, (out, err)
        lines = self.stage.lines
        check_limits(lines)
        written = check_session(self.path, lines)
        self._check_silence(str(written.notes))
        return out, err, written


# -- what was on the bus ------------------------------------------------------------------------


def commands_of(lines):
    """Return each joint's commands: name to (monotonic times [s], angles [rad])."""
    commands = {}
    for line in lines:
        if (line["name"] or "").endswith("_command"):
            name = line["name"].removesuffix("_command")
            angle = math.radians(line["signals"]["position"])
            commands.setdefault(name, []).append((line["t_s"], angle))
    return {name: tuple(np.array(rows).T) for name, rows in commands.items()}


def check_limits(lines, *, limit=LIMIT, max_rate=MAX_RATE, period_s=1 / RATE_HZ):
    """No command beyond a limit, no step beyond the rate's: but for the bus's rounding.

    A step is that from one command of a joint to its next, and may be as long as the rate allows
    in one control period, however long it really took. The first command is a step from straight
    joints, where the robot stands.
    """
    commands = commands_of(lines)
    assert commands
    for name, (_, angle) in commands.items():
        assert np.abs(angle).max() <= limit + STEP / 2, name
        step = np.abs(np.diff(angle, prepend=0.0))
        assert step.max() <= max_rate * period_s + STEP * (1 + 1e-6), (name, step.max())


# -- the session of it --------------------------------------------------------------------------


class Written:
    """A session, read by the mcap package's own reader and decoder.

    Attributes:
        commands: ``/joint_commands``, a row a tick: (log time [s], joint to angle [rad]).
        said: ``/rosout``: (log time [s], level, text).
        sent: Raw command frames, in order: (identifier, data as hexadecimal).
        sent_ns: When the sender had handed over each of them, on its own clock [ns].
        metadata: All records, by name.
    """

    def __init__(self, path):
        self.commands, self.notes, self.sent, self.sent_ns = [], [], [], []
        with path.open("rb") as stream:
            reader = make_reader(stream, decoder_factories=[DecoderFactory()])
            self.metadata = {record.name: record.metadata for record in reader.iter_metadata()}
            for _, channel, record, message in reader.iter_decoded_messages():
                at_s = record.log_time * 1e-9
                if channel.topic == "/joint_commands":
                    row = zip(message.name, message.position, strict=True)
                    self.commands.append((at_s, dict(row)))
                elif channel.topic == "/rosout":
                    self.notes.append((at_s, message.level, message.msg))
                elif channel.topic == "/can/can0":
                    frames = np.frombuffer(bytes(message.data), FRAME)
                    ours = frames[frames["dir"] != 0]
                    self.sent += [
                        (int(our["id_flags"]), our["data"][: our["dlc"]].tobytes().hex())
                        for our in ours
                    ]
                    self.sent_ns += ours["t_host_ns"].tolist()

    def time_of(self, words):
        """Return when the first event with these words was written [s]."""
        times = [at_s for at_s, _, text in self.notes if words in text]
        assert times, (words, self.notes)
        return times[0]

    def after(self, words):
        """Return commands from an event on: joint to angles [rad]."""
        since_s = self.time_of(words)
        rows = [row for at_s, row in self.commands if at_s >= since_s - 1e-9]
        return {name: np.array([row[name] for row in rows]) for name in self.commands[0][1]}


def check_session(path, lines, *, max_rate=MAX_RATE, lockstep=False):
    """The session is whole, and its commands are those on the bus; returns what is written.

    No joint was told to be faster than it may, in true time as the sender's own clock has it: that
    of a robot in lockstep is simulated.
    """
    written = Written(path)
    heard = commands_of(lines)
    for name, (_, angle) in heard.items():
        given = np.array([row[name] for _, row in written.commands])
        assert len(given) == len(angle), (name, given[-5:], angle[-5:])
        assert np.abs(given - angle).max(initial=0.0) <= STEP / 2 * (1 + 1e-6), name
    on_bus = [
        (line["id"], line["data"]) for line in lines if (line["name"] or "").endswith("_command")
    ]
    assert written.sent == on_bus  # bit by bit, and so nothing came after the end
    if not lockstep:
        check_true_rates(written, lines, max_rate=max_rate)
    check_pace(np.array([at_s for at_s, _ in written.commands]))
    return written


def check_true_rates(written, lines, *, max_rate=MAX_RATE):
    """From each command of a joint to its next: no more than the rate allows in the time between.

    What it was told is what the listener heard, when it was sent is what the sender wrote down;
    returns the shortest time between two commands [s].
    """
    sent_ns = {}
    names = [line["name"] for line in lines if (line["name"] or "").endswith("_command")]
    for name, at_ns in zip(names, written.sent_ns, strict=True):
        sent_ns.setdefault(name.removesuffix("_command"), []).append(at_ns)
    shortest_s = math.inf
    for name, (_, angle) in commands_of(lines).items():
        apart_s = np.diff(sent_ns[name]) * 1e-9
        beyond = np.abs(np.diff(angle)) - max_rate * apart_s - STEP * (1 + 1e-6)
        assert beyond.max(initial=0.0) <= 0.0, (name, beyond.max(), apart_s[np.argmax(beyond)])
        shortest_s = min(shortest_s, apart_s.min(initial=math.inf))
    return shortest_s


def check_pace(times_s, late_s=0.02):
    """Never more commands than deadlines have passed: what was late is not made up in a burst."""
    ahead = np.arange(len(times_s)) / RATE_HZ - times_s
    assert (ahead - np.minimum.accumulate(ahead)).max(initial=0.0) <= 1 / RATE_HZ + late_s


def check_ramp_down(written, since, *, ramp_rate=RAMP_RATE, yields=()):
    """From an event on: straight joints within a bound, no faster than the ramp allows.

    A joint that yields to its current has no effort left to come straight: it ends where it is.
    """
    ending = written.after(since)
    for name, angle in ending.items():
        left = abs(angle[0]) + math.radians(2.0) if name in yields else STEP / 2
        assert abs(angle[-1]) <= left, name
        # 3 x^2 - 2 x^3 has a peak rate of 1.5; then the pose is told for a while.
        assert len(angle) <= RATE_HZ * (1.5 * LIMIT / ramp_rate + 0.5), name
        steps = np.abs(np.diff(angle))
        # At first a joint that is away from its command is taken from where it is.
        settled = steps[math.ceil(RATE_HZ * 2 * LIMIT / MAX_RATE) :]
        assert settled.max(initial=0.0) <= ramp_rate / RATE_HZ + 1e-9, name


def check_hold(written, since):
    """From an event on: the pose of then, and soon nothing any more."""
    ending = written.after(since)
    for name, angle in ending.items():
        assert len(angle) <= 0.5 * RATE_HZ, name
        assert len(angle) == 0 or np.ptp(angle) <= 1e-9, name
