"""A recorder, and senders with sequence numbers of their own, held against mcap's own reader."""

import json
import os
import signal
import struct
import subprocess
import sys
import time
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

from support.paths import ROOT
from support.processes import UNDULOG
from support.read_back import messages_of

SENDER = Path(__file__).with_name("sender.py")
RECORD = 32
AT_DATA = 24
"""Bytes of a frame's record, and where its data begins (the log contract)."""
PATIENCE_S = 90.0


@contextmanager
def recorder(folder, buses, options=(), output=None, **streams):
    """Record frames of other processes; errors of the recorder go to ``recorder.err``."""
    sources = [f"{name}=unix:{folder / name}.sock" for name in buses]
    command = [*UNDULOG, "record", *sources, *options, "--quiet", "--floor", "0"]
    command += ["--socket", folder / "control.sock", "-o", output or folder / "run.mcap"]
    with ExitStack() as stack:
        errors = stack.enter_context((folder / "recorder.err").open("wb"))
        yield start(stack, *command, stderr=errors, cwd=ROOT, **streams)


def start(stack, *command, **options):
    """Start a process that is killed when the stack is closed."""
    process = subprocess.Popen([str(word) for word in command], **options)
    stack.callback(process.wait, 30)
    stack.callback(process.kill)
    return process


@dataclass
class Sending:
    """A sender: its process and its log of the frames that the kernel accepted."""

    bus: str
    process: subprocess.Popen[bytes]
    log: Path

    def rows(self):
        """Return pairs of monotonic time [ns] and frames accepted by then."""
        data = self.log.read_bytes() if self.log.exists() else b""
        return list(struct.iter_unpack("<QQ", data[: len(data) // 16 * 16]))

    def accepted_before(self, t_ns):
        """Return the number of frames accepted before a time."""
        return max((count for at_ns, count in self.rows() if at_ns < t_ns), default=0)

    def lost_tail_ms(self, kept, killed_ns):
        """Return the age of the first accepted frame that is not kept at a kill [ms]; 0 if none."""
        first = next((at_ns for at_ns, count in self.rows() if count > kept), killed_ns)
        return max(0, killed_ns - first) / 1e6

    def wait_for(self, packets):
        """Wait until a number of packets was accepted."""
        until = time.monotonic() + PATIENCE_S
        while len(self.rows()) < packets:
            if time.monotonic() > until or self.process.poll() is not None:
                raise TimeoutError(f"the sender of {self.bus} found no recorder")
            time.sleep(0.02)

    def result(self):
        """Return the report of the sender at its end."""
        out, _ = self.process.communicate(timeout=PATIENCE_S)
        return json.loads(out)


@contextmanager
def senders(folder, buses, *, rate, per_packet, seconds):
    """Start senders to a recorder, one a bus."""
    with ExitStack() as stack:
        started = []
        for name in buses:
            log = folder / f"{name}.accepted"
            words = (SENDER, folder / f"{name}.sock", log, rate, per_packet, seconds)
            process = start(stack, sys.executable, *words, stdout=subprocess.PIPE)
            started.append(Sending(name, process, log))
        yield started


def numbers_in(paths, bus):
    """Return the sequence numbers of a bus in the order of the files, by mcap's own reader."""
    numbers = []
    for path in paths:
        for *_, message in messages_of(path, topics=[f"/can/{bus}"], log_time_order=False):
            data, size = message.data, len(message.data)
            # The array is the last field: a length before it, then whole records.
            at = size - RECORD
            while at >= RECORD and struct.unpack_from("<I", data, at - 4)[0] != size - at:
                at -= RECORD
            ends = range(at + AT_DATA, size, RECORD)
            numbers += [struct.unpack_from("<Q", data, end)[0] for end in ends]
    return numbers


def check_kept(folder, sending, least):
    """Return failures unless each accepted frame is there once, in order, and no other."""
    paths = sorted(folder.glob("*.mcap"))
    if not paths:
        return ["lost: no session"]
    try:
        numbers = numbers_in(paths, sending.bus)
    except Exception as error:  # noqa: BLE001 - whatever the foreign reader raises
        return [f"output: unreadable: {type(error).__name__}: {error}"]
    failures = []
    if numbers != list(range(len(numbers))):
        wrong = next(k for k, number in enumerate(numbers) if k != number)
        failures.append(f"lost: frame {wrong} of {sending.bus} is followed by {numbers[wrong]}")
    if len(numbers) < least:
        failures.append(f"lost: {least - len(numbers)} of {least} accepted frames of {sending.bus}")
    return failures


def end(running, by=signal.SIGTERM):
    """End a process by a signal; return its exit code."""
    os.kill(running.pid, by)
    return running.wait(PATIENCE_S)
