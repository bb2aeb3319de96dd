"""Disks that fill up, vanish, or are read-only, under every command that writes."""

import contextlib
import os
import random
import shlex
import shutil
import signal
import subprocess
import time
from contextlib import contextmanager
from pathlib import Path

from .case import Result, judge, run_command
from .kills import LINES, lay_out, whole_outputs
from .recording import check_kept, recorder, senders

TEXTS = (
    *("log info run.mcap", "log check run.mcap --json", "analyse run.mcap", "info", "sim list"),
    *("compare run.mcap other.mcap", "log cut run.mcap -o new.mcap", "--help"),
)


@contextmanager
def disk(place, size, *, read_only=False):
    """Mount a file system of a size at a folder; yield whether mounting is permitted here."""
    place.mkdir(exist_ok=True)
    command = ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(place)]
    mounted = subprocess.run(command, capture_output=True, check=False).returncode == 0
    try:
        if mounted and read_only:
            subprocess.run(["mount", "-o", "remount,ro", str(place)], check=True)
        yield mounted
    finally:
        if mounted:
            subprocess.run(["umount", "-l", str(place)], capture_output=True, check=False)


def run(seed, stage):
    """Run one command, or the recorder, on a bad disk."""
    rng = random.Random(seed)
    kinds = {"small": 8, "text": 4, "read-only": 2, "vanish": 4}
    kinds |= {"recorder small": 1, "recorder vanish": 1}
    (kind,) = rng.choices(list(kinds), list(kinds.values()))
    with stage.fresh() as folder:
        if kind == "text":
            return _full_terminal(rng.choice(TEXTS), folder, stage)
        if kind.startswith("recorder"):
            return _recorder(kind, folder, rng)
        return _command(kind, folder, rng, stage)


def _full_terminal(line, folder, stage):
    lay_out(folder, stage)
    result = Result(f"{line!r} to a full device")
    outcome = run_command(shlex.split(line), folder, stdout=Path("/dev/full"))
    result.add(outcome)
    if outcome.code == 0 and line != "log cut run.mcap -o new.mcap":
        result.failures.append("accepted: exit code 0 though nothing could be printed")
    return result


def _command(kind, folder, rng, stage):
    line = rng.choice(LINES)
    size = f"{rng.choice([4, 16, 64, 256])}k"
    result = Result(f"{line!r}: {kind} disk of {size}")
    lay_out(folder, stage)
    words = shlex.split(line)
    at = words.index("--save" if "--save" in words else "-o") + 1
    name, words[at] = words[at], f"disk/{words[at]}"
    size = size if kind == "small" else "8m"
    with disk(folder / "disk", size, read_only=kind == "read-only") as can:
        if not can:
            result.skipped = "mounting is not permitted here"
            return result

        def vanish(_child):
            time.sleep(rng.random() * 0.5)
            if rng.random() < 0.5:
                subprocess.run(["umount", "-l", str(folder / "disk")], check=False)
            else:
                with contextlib.suppress(OSError):
                    shutil.rmtree(folder / "disk", ignore_errors=True)

        meanwhile = vanish if kind == "vanish" else None
        outcome = run_command(words, folder, meanwhile=meanwhile)
        result.add(outcome)
        if kind != "vanish":
            result.failures += whole_outputs(folder / "disk")
        written = (folder / "disk" / name).exists()
        if kind == "read-only" and outcome.code == 0:
            result.failures.append("accepted: exit code 0 on a read-only disk")
        if kind == "small" and outcome.code == 0 and not written:
            result.failures.append("accepted: exit code 0 without an output")
    return result


def fill(place, spare):
    """Fill a disk, but for a number of bytes."""
    state = os.statvfs(place)
    with contextlib.suppress(OSError), (place / "other").open("wb", buffering=0) as stream:
        for _ in range((state.f_bavail * state.f_frsize - spare) // 4096):
            stream.write(bytes(4096))


def _recorder(kind, folder, rng):
    result = Result(f"record, {kind}")
    with disk(folder / "disk", "96m") as can:
        if not can:
            result.skipped = "mounting is not permitted here"
            return result
        output = folder / "disk" / "run.mcap"
        rate = 20_000 if kind.endswith("small") else 2000
        with (
            recorder(folder, ("a",), output=output) as running,
            senders(folder, ("a",), rate=rate, per_packet=64, seconds=40) as sending,
        ):
            sending[0].wait_for(20)
            time.sleep(rng.random() * 2)
            if kind.endswith("small"):  # somebody else fills it, but for a little
                fill(folder / "disk", rng.choice([0, 4096, 500_000]))
            else:
                subprocess.run(["umount", "-l", str(folder / "disk")], check=False)
                time.sleep(2)
                with contextlib.suppress(ProcessLookupError):
                    os.kill(running.pid, signal.SIGTERM)
            code = running.wait(80)
            accepted = sending[0].rows()[-1][1]
        errors = (folder / "recorder.err").read_bytes()
        if code < 0:
            result.failures.append(f"signal: ended by {signal.Signals(-code).name}")
        if b"Traceback" in errors:
            result.failures.append(f"traceback: {errors.decode(errors='replace').splitlines()[-1]}")
        if kind.endswith("small"):
            if code != 1 or b"error:" not in errors:
                result.failures.append(f"full disk: exit code {code}, {errors[-200:]!r}")
            (folder / "kept").mkdir()
            words = ["log", "recover", output, "-o", folder / "kept" / "r.mcap"]
            outcome = run_command(words, folder)
            result.failures += judge(outcome)
            if outcome.code:  # the recording is whole already
                shutil.copy(output, folder / "kept" / "r.mcap")
            # What the kernel still held as the recorder ended was never taken: its socket holds
            # fewer packets than that.
            result.failures += check_kept(folder / "kept", sending[0], max(0, accepted - 300 * 64))
            result.figures["n_accepted"] = accepted
    return result
