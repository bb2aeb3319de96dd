"""Sockets emptied beside the interpreter, the end of a recording, and the priority asked for.

The senders are other processes; what ``send()`` returned to them is the truth.
"""

import ctypes
import fcntl
import math
import os
import random
import select
import shutil
import signal
import socket
import struct
import subprocess
import sys
import termios

import bus_sender
import numpy as np
import pytest

from support.processes import python, start, wait_for
from support.read_back import messages_of
from support.recorders import ended, events, greet, recording, status_of
from support.written_frames import frames_of
from undulog.capture import SessionWriter, load_robot
from undulog.capture.common.process import raised_priority
from undulog.capture.log.messages.frames import empty_frames
from undulog.capture.recorder.bus_recorder import BusRecorder
from undulog.capture.recorder.source_clock import SourceClock
from undulog.capture.sources import reader_thread
from undulog.capture.sources.reader_thread import ReceiveThread

# One frame a packet; at each line of stdin so many, with 0.1 ms between. A frame for which there is
# no room is refused, or sent once there is.
SENDER = """
import select, socket, struct, sys, time
peer = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
while peer.connect_ex(sys.argv[1]):
    time.sleep(0.01)
peer.setblocking(False)
number = 0
for line in sys.stdin:
    refused, times = 0, []
    count, waits = map(int, line.split())
    for _ in range(count):
        try:
            if waits:
                select.select([], [peer], [])
            peer.send(struct.pack("<QQIBB2x8s", number, 0, 1, 8, 0, bytes(8)))
            number += 1
        except BlockingIOError:
            refused += 1
        except OSError:
            break
        times.append(time.time_ns())
        if not waits:
            time.sleep(0.0001)
    print(number, refused, *times, flush=True)
"""


class Sender:
    """A sender in another process."""

    def __init__(self, path):
        self.process = start(sys.executable, "-c", SENDER, path, stdin=subprocess.PIPE)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.process.kill()
        self.process.communicate()

    def start(self, count, *, waits=False):
        self.process.stdin.write(f"{count} {waits:d}\n")
        self.process.stdin.flush()

    def result(self):
        """Frames accepted since the start, refused of the last ones, when each was sent."""
        accepted, refused, *times = map(int, self.process.stdout.readline().split())
        return accepted, refused, times


def hold_the_interpreter(until):
    """Keep the interpreter's lock in a C call until a file can be read, a minute at most."""
    asked = struct.pack("ihh", until.fileno(), select.POLLIN, 0)
    assert ctypes.PyDLL(None).poll(asked, ctypes.c_ulong(1), 60_000) == 1


@pytest.mark.slow
def test_packets_are_taken_while_the_interpreter_is_held(tmp_path, monkeypatch):
    """An AF_UNIX socket of the default size holds 277 such packets; the sender waits for room.

    The thread's room grows at any pace of the sender: 256 packets, then 1024 at a time, of which
    1500 fill the first two and a part of the third.
    """
    monkeypatch.setattr(reader_thread, "_BRIEF_S", math.inf)
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as listener:
        listener.bind(str(tmp_path / "s"))
        listener.listen()
        with Sender(tmp_path / "s") as sender:
            receiver = ReceiveThread(listener.accept()[0], 100)
            sizes, stamps = [], []

            def taken(count):
                for batch in receiver.take(10_000):
                    sizes.extend(batch.sizes)
                    stamps.extend(batch.stamps_ns)
                return len(sizes) >= count

            sender.start(1500)
            accepted, _, _ = sender.result()
            wait_for(lambda: taken(accepted), "the first packets")
            before = accepted
            sender.start(500, waits=True)
            hold_the_interpreter(sender.process.stdout)
            accepted, refused, sent_ns = sender.result()
            assert refused == 0
            wait_for(lambda: taken(accepted), "all packets")
            assert sizes == [32] * accepted
            apart = np.array(stamps[before:]) - np.array(sent_ns)
            assert np.percentile(apart, 90) <= 0  # the kernel's time, not ours
            receiver.close()


@pytest.mark.slow
@pytest.mark.parametrize(
    "seed", [0, *(pytest.param(seed, marks=pytest.mark.nightly) for seed in (1, 2))]
)
def test_what_was_accepted_before_the_end_is_in_the_session(seed, tmp_path):
    path, output = tmp_path / "bus.sock", tmp_path / "run.mcap"
    with recording(output, f"bus=unix:{path}") as recorder, Sender(path) as sender:
        wait_for(path.exists, "the recorder")
        sender.start(1_000_000)
        least = random.Random(seed).randrange(20_000)
        wait_for(lambda: status_of(output)["sources"][0]["frames"] > least, "frames")
        report, err = ended(recorder, signal.SIGINT)
        accepted, _, _ = sender.result()  # its send() failed: nobody records
    assert recorder.returncode == 0, err
    np.testing.assert_array_equal(frames_of(output, "/can/bus")["t_device_ns"], np.arange(accepted))
    assert report["sources"]["bus"]["frames"] == accepted


@pytest.mark.slow
def test_a_stream_is_kept_up_to_the_end(tmp_path):
    """socketcand can't refuse: what was sent before the signal is there, and nothing is missing."""
    output = tmp_path / "run.mcap"
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        address = f"bus=can:socketcand:can0?host=127.0.0.1&port={port}"
        with recording(output, address) as recorder, server.accept()[0] as client:
            greet(client)
            for number in range(4000):
                if number == 3000:
                    recorder.send_signal(signal.SIGINT)
                try:
                    client.sendall(b"< frame 1 %d.000000 11 >" % number)
                except OSError:
                    break
            _, err = ended(recorder)
    assert recorder.returncode == 0, err
    frames = frames_of(output, "/can/bus")
    seconds = frames["t_device_ns"] // 1_000_000_000
    np.testing.assert_array_equal(seconds, np.arange(len(seconds)))
    assert len(seconds) >= 3000


def test_decoding_stops_when_its_time_is_over(tmp_path):
    """Also within what one slice of frames gives; nothing is lost or doubled by it."""
    robot = load_robot("snake25")
    frames = bus_sender.payloads(bus_sender.cycle_frames(), 0, 2000, 9000.0, 10**18)
    frames["t_host_ns"] = frames["t_device_ns"]
    for name, until_ns in (("whole", 1 << 62), ("bits", 5)):
        path = tmp_path / f"{name}.mcap"
        with SessionWriter(path, session_id=name, epoch_ns=10**18, robot=robot) as writer:
            bus = BusRecorder("bus", writer, SourceClock(), robot, directions=True)
            bus.add(frames.copy())
            bus.write_raw(lambda: 10**18)
            calls, most = 0, 0
            while (bus.behind or bus.backlog) and calls < 100_000:
                looks = iter(range(1, 1 << 40))  # a clock that goes on by 1 ns a look
                bus.decode(lambda looks=looks: next(looks), until_ns)
                most = max(most, next(looks))
                calls += 1
            bus.finish(lambda: 1)
        assert name == "whole" or (most <= until_ns + 2 and calls > 20)
    paths = [tmp_path / f"{name}.mcap" for name in ("whole", "bits")]
    for topic in ("/joint_states", "/joint_commands", "/joint_sample_offset"):
        both = [messages_of(path, topics=[topic]) for path in paths]
        first, second = (sorted(m.data for *_, m in messages) for messages in both)
        assert first == second
        assert len(first) > 10


root_only = pytest.mark.skipif(
    os.geteuid() != 0 or shutil.which("setpriv") is None, reason="needs root and setpriv"
)


def permitted(call):
    """Whether the system lets a process of ours do this."""
    return python(f"import os; os.{call}").returncode == 0


def test_priority_is_what_the_system_grants_and_is_given_back():
    policy = os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK
    before = policy, os.getpriority(os.PRIO_PROCESS, 0)
    real_time = permitted("sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))")
    nicer = permitted("setpriority(os.PRIO_PROCESS, 0, -10)")
    alone = before[0] != os.SCHED_OTHER or before[1] > 0  # as whoever started it wants it
    with raised_priority() as got:
        assert got.refused == (not alone and not real_time and not nicer)
        policy = os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK
        assert policy == (os.SCHED_RR if real_time and not alone else before[0])
        if nicer and not real_time and not alone:
            assert os.getpriority(os.PRIO_PROCESS, 0) == min(before[1], -10)
        done = python("import os; print(os.sched_getscheduler(0))")
        assert int(done.stdout) == (before[0] if alone else os.SCHED_OTHER)
    after = os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK
    assert (after, os.getpriority(os.PRIO_PROCESS, 0)) == before


@pytest.mark.slow
@root_only
@pytest.mark.parametrize(
    ("before", "text"),
    [
        (("setpriv", "--bounding-set=-sys_nice"), "refused: nice 0"),
        (("nice", "-n", "5"), "as it was started: nice 5"),
    ],
)
def test_the_recorder_reports_its_priority(before, text, tmp_path):
    output, path = tmp_path / "run.mcap", tmp_path / "bus.sock"
    usual = ("nice", "-n", str(-os.nice(0)))  # the tests may run at a lower priority
    with recording(output, f"bus=unix:{path}", before=(*usual, *before)) as recorder:
        wait_for(path.exists, "the recorder")
        wait_for(lambda: status_of(output)["elapsed_s"] > 0, "the loop")
        report, _ = ended(recorder, signal.SIGINT)
    assert report["recorder"]["priority"] == text
    refused = any("priority was refused" in line for _, line in events(output))
    assert refused == text.startswith("refused")


def test_a_quiet_sender_has_no_frames():
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with theirs:
        receiver = ReceiveThread(ours, 100)
        assert receiver.take(10) == []
        assert not receiver.ended
        theirs.send(empty_frames(1).tobytes())
        wait_for(lambda: receiver.take(10), "the packet")
    wait_for(lambda: receiver.take(10) is not None and receiver.ended, "the end")
    receiver.close()


def unread(sender):
    """Return what the other end of a local socket has not taken yet [byte]."""
    return int.from_bytes(fcntl.ioctl(sender, termios.TIOCOUTQ, bytes(4)), "little")


STOPPED = """
import socket, sys, time
from undulog.capture.sources import reader_thread
from undulog.capture.sources.reader_thread import ReceiveThread
ours = socket.socket(fileno=int(sys.argv[1]))
receiver = ReceiveThread(ours, 100)
print("ready", flush=True)
count = 0
while not receiver.ended:
    count += sum(size > 0 for batch in receiver.take(10_000) for size in batch.sizes)
    time.sleep(0.001)
print(count, receiver.error, flush=True)
"""


@pytest.mark.parametrize("kind", [socket.SOCK_SEQPACKET, socket.SOCK_STREAM])
def test_a_stop_with_packets_in_hand_breaks_no_connection(kind):
    """The kernel leaves its own code 512 in the socket; each packet is received."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, kind)
    options = {"pass_fds": [ours.fileno()], "stdout": subprocess.PIPE, "text": True}
    with (
        theirs,
        subprocess.Popen(
            [sys.executable, "-c", STOPPED, str(ours.fileno())], **options
        ) as receiver,
    ):
        ours.close()
        assert receiver.stdout.readline() == "ready\n"
        sent = 0
        for _ in range(10):
            for _ in range(5):  # received at once; the call goes on waiting for more
                theirs.send(bytes(32))
                sent += 1
                wait_for(lambda: not unread(theirs), "the receiver")
            receiver.send_signal(signal.SIGSTOP)
            os.waitid(os.P_PID, receiver.pid, os.WSTOPPED)
            theirs.send(bytes(32))
            sent += 1
            receiver.send_signal(signal.SIGCONT)
        theirs.shutdown(socket.SHUT_WR)
        out, _ = receiver.communicate()
    count, error = out.split()
    assert error == "None"
    if kind == socket.SOCK_SEQPACKET:
        assert int(count) == sent
