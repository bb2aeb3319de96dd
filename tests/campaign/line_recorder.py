"""``kill -9`` of a recorder of a serial line that has faults, then ``log recover``.

A sender that contains nothing of undulog logs each byte that the kernel accepted. The recorder
keeps every byte of a line, noise included; so the bytes of the recovered session in their order
must be the beginning of what was accepted. What may be missing is what was accepted in the last
50 ms, and what the kernel still held for the recorder: a terminal's buffer, 4 kB. How full that was
at the kill nothing shows, so it is counted.
"""

import os
import random
import signal
import struct
import sys
import time
from contextlib import ExitStack
from pathlib import Path

from support.paths import ROOT
from support.processes import UNDULOG, wait_for
from support.read_back import messages_of

from .case import Result, run_command
from .recording import start

SENDER = Path(__file__).with_name("line_sender.py")
FAULTS = ("none", "noise", "stalls", "vanishes", "stopped")
"""In turn by the seed; with ``stopped`` the recorder itself is stopped for a while."""

RATES = (10_000, 40_000, 100_000)
"""Bytes a second: a tenth of a line of 1 Mbit/s, and all of it."""

RECENT_NS = 50_000_000
TTY_BUFFER = 4096
"""Input buffer of a terminal (N_TTY_BUF_SIZE)."""

RECORD = 88
LENGTH_AT, DATA_AT = 20, 24
"""Bytes of a CAN FD frame's record, of its length and of its data (the log contract)."""


def bytes_of(path):
    """Return the bytes of the line in the order of the session, by mcap's own reader."""
    line_bytes = bytearray()
    for *_, message in messages_of(path, topics=["/serial/line"], log_time_order=False):
        data, size = message.data, len(message.data)
        at = size - RECORD  # the array is the last field: a length before it, then whole records
        while at >= RECORD and struct.unpack_from("<I", data, at - 4)[0] != size - at:
            at -= RECORD
        for row in range(at, size, RECORD):
            line_bytes += data[row + DATA_AT : row + DATA_AT + data[row + LENGTH_AT]]
    return bytes(line_bytes)


def accepted(folder):
    """Return pairs of monotonic time [ns] and bytes accepted by then."""
    data = (folder / "accepted").read_bytes()
    return list(struct.iter_unpack("<QQ", data[: len(data) // 16 * 16]))


def run(seed, stage):
    """Run one case."""
    rng, fault = random.Random(seed), FAULTS[seed % len(FAULTS)]
    rate = rng.choice(RATES)
    result = Result(f"record serial line, {rate} B/s, {fault}, SIGKILL")
    with stage.fresh() as folder, ExitStack() as stack:
        port = folder / "port"
        sender = start(stack, sys.executable, SENDER, port, folder, rate, fault, 60, seed)
        errors = stack.enter_context((folder / "recorder.err").open("wb"))
        words = [*UNDULOG, "record", f"line=serial:{port}?protocol=feetech", "--quiet"]
        words += ["--floor", "0", "--socket", folder / "control.sock", "-o", folder / "run.mcap"]
        running = start(stack, *words, cwd=ROOT, stderr=errors)

        def begun():
            return (folder / "accepted").exists() and len(accepted(folder)) > 200

        wait_for(begun, "the line", alive=[sender, running])
        time.sleep(rng.uniform(0.0, 3.0))
        if fault == "stopped":
            running.send_signal(signal.SIGSTOP)
            time.sleep(rng.uniform(0.2, 2.0))
            running.send_signal(signal.SIGCONT)
            time.sleep(rng.uniform(0.0, 1.0))
        killed_ns = time.monotonic_ns()
        os.kill(running.pid, signal.SIGKILL)
        running.wait(30)
        sender.kill()
        sender.wait(30)
        rows = accepted(folder)
        least = max((count for at_ns, count in rows if at_ns < killed_ns - RECENT_NS), default=0)
        recovered = folder / "recovered.mcap"
        outcome = run_command(["log", "recover", folder / "run.mcap", "-o", recovered], folder)
        result.add(outcome)
        if outcome.code:
            result.failures.append(f"recover: {outcome.errors}")
            return result
        kept, sent = bytes_of(recovered), (folder / "sent").read_bytes()
        if kept != sent[: len(kept)]:
            wrong = next(k for k, (a, b) in enumerate(zip(kept, sent, strict=False)) if a != b)
            result.failures.append(
                f"lost: byte {wrong} of {len(kept)} is another one than was sent"
            )
        if len(kept) < least - TTY_BUFFER:
            result.failures.append(f"lost: {least - len(kept)} of {least} accepted bytes")
        first = next((at_ns for at_ns, count in rows if count > len(kept)), killed_ns)
        result.figures["n_bytes"] = least
        result.figures["n_in_the_kernel"] = max(0, least - len(kept))
        result.figures["tail_ms"] = max(0, killed_ns - first) / 1e6
    return result
