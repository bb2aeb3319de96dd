"""The recorder beside busy loops and a disk that syncs all the time."""

import os
import random
import subprocess
import sys
import time
from contextlib import ExitStack

from .case import Result
from .recording import check_kept, end, recorder, senders, start

RATE = 9000
SECONDS = 10.0
BUSY = "while True: pass"


def run(seed, stage):
    """Record two buses of 9,000 frames/s, all cores and the disk busy: no accepted frame is lost.

    Frames that the kernel refused are a figure, not a failure: the sender gets the refusal.
    """
    rng = random.Random(seed)
    per_packet = (1, 9)[seed % 2]
    result = Result(f"record 2 x {RATE} frames/s, {per_packet} a packet, all cores busy")
    with stage.fresh() as folder, ExitStack() as stack:
        for words in [*[[sys.executable, "-c", BUSY]] * 4, _syncing(folder)]:
            start(stack, *words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        load = {"rate": RATE, "per_packet": per_packet, "seconds": SECONDS + rng.random()}
        with (
            recorder(folder, ("a", "b")) as running,
            senders(folder, ("a", "b"), **load) as sending,
        ):
            reports = [sender.result() for sender in sending]
            time.sleep(1.0)
            code = end(running)
        errors = (folder / "recorder.err").read_text(errors="replace")
        if code != 0 or "Traceback" in errors:
            result.failures.append(f"recorder: exit code {code}: {errors[-300:]}")
        for sender, report in zip(sending, reports, strict=True):
            result.failures += check_kept(folder, sender, report["accepted"])
        accepted, refused = (
            sum(report[key] for report in reports) for key in ("accepted", "refused")
        )
        result.figures = {
            "n_accepted": accepted,
            "n_refused": refused,
            "refused_percent": round(100 * refused / max(1, accepted + refused), 3),
        }
    return result


def _syncing(folder):
    """Return a command that writes 1 MB blocks and syncs, over and over."""
    dd = f"dd if=/dev/zero of={folder / 'dd'} bs=1M count=64 conv=fsync"
    return ["bash", "-c", f"while kill -0 {os.getpid()}; do {dd}; done"]
