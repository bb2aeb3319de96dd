"""Recorders in processes of their own, and what tests send to them and read of them."""

import json
import os
import socket
from collections import Counter
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
from mcap.reader import make_reader

from support.paths import ROOT
from support.processes import UNDULOG, pause, process, wait_for
from undulog.capture import Session
from undulog.capture.log.messages.frames import DIR_TX, empty_frames
from undulog.capture.recorder.control_client import ControlClient


def command(output, *arguments):
    control = output.with_name("control.sock")
    return [*UNDULOG, "record", *arguments, "-o", str(output), "--socket", str(control)]


@contextmanager
def recording(output, *arguments, env=None, floor="0", before=()):
    """Run a recorder in another process; it is running when the block begins."""
    words = (*before, *command(output, *arguments), "--floor", floor, "--json")
    with process(*words, cwd=ROOT, env=env) as running:
        control = output.with_name("control.sock")
        wait_for(lambda: control.exists() or running.poll() is not None, "the recorder")
        yield running


def ended(running, number=None):
    """The report of a recorder that ends, after a signal if one is given, and its errors."""
    if number is not None:
        running.send_signal(number)
    out, err = running.communicate()
    assert "Traceback" not in err, err
    return json.loads(out) if out else None, err


def counts(path):
    """Messages of each topic, as mcap's own reader counts them."""
    with path.open("rb") as stream:
        messages = make_reader(stream, validate_crcs=True).iter_messages()
        return Counter(channel.topic for _, channel, _ in messages)


def polling(cycles, start_ns=10**9):
    """Polling cycles of 10 ms of the shipped robot: each servo's command, then its answer.

    Returns the frames, and the angles in them in hundredths of a degree.
    """
    frames = empty_frames(50 * cycles)
    number = np.arange(len(frames))
    is_command = number % 2 == 0
    frames["t_device_ns"] = start_ns + number * 200_000
    frames["id_flags"] = np.where(is_command, 257, 513) + number // 2 % 25
    frames["dlc"] = np.where(is_command, 2, 8)
    frames["dir"] = np.where(is_command, DIR_TX, 0)
    hundredths = np.rint(2000 * np.sin(0.05 * number)).astype("<i2")
    frames["data"][:, :2] = hundredths[:, None].view(np.uint8)
    return frames, hundredths


def greet(client, listening=b"< hi >"):
    """What a socketcand server says until its client is in raw mode."""
    client.sendall(listening)
    for _ in range(2):
        client.recv(4096)
        client.sendall(b"< ok >")


def sockets_of(pid):
    """Return the open sockets of a process."""
    links = []
    for descriptor in Path(f"/proc/{pid}/fd").iterdir():
        with suppress(FileNotFoundError):  # closed since it was listed
            links.append(os.readlink(descriptor))  # noqa: PTH115
    return [link for link in links if link.startswith("socket:")]


def status_of(output):
    """Return the state of a recorder that :func:`recording` runs."""
    with ControlClient(output.with_name("control.sock")) as client:
        return client.ask({"do": "status"})


def events(path):
    """Return (source, text) of each event on ``/rosout``."""
    with Session.open(path) as session:
        return [(message.name, message.msg) for _, message in session.messages("/rosout")]


@contextmanager
def connected_sender(path):
    """A sender at a source ``unix:PATH``, as soon as it is there, that has sent one frame."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as sender:
        wait_for(lambda: sender.connect_ex(str(path)) == 0, "the source")
        sender.send(empty_frames(1).tobytes())
        yield sender


def send(path, frames, per_packet=50, pause_s=0.01, stamp_ns=None):
    """Send frames to a source ``unix:PATH`` as soon as it is there; ``stamp_ns`` is a clock."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as sender:
        wait_for(lambda: sender.connect_ex(str(path)) == 0, "the source")
        for start in range(0, len(frames), per_packet):
            packet = frames[start : start + per_packet]
            if stamp_ns:
                packet["t_device_ns"] = stamp_ns() - np.arange(len(packet))[::-1] * 100_000
            sender.send(packet.tobytes())
            pause(pause_s)
