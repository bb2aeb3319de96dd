"""Kills at random moments: of every command that writes, and of the recorder under load."""

import os
import random
import shlex
import signal
import time

from .base import gait_session, write_files
from .case import Result, judge, run_command
from .fuzz import check_output
from .recording import check_kept, numbers_in, recorder, senders

LINES = [
    "sim run scenario.toml -o new.mcap --duration 3",
    "log recover unfinished/run.mcap -o new.mcap",
    "log recover run.mcap -o new.mcap",
    "log cut run.mcap --start 0 --stop 9 -o new.mcap",
    "log merge run.mcap other.mcap -o new.mcap",
    "log export run.mcap -o new.csv",
    "log export run.mcap -o new.log",
    "log export run.mcap -o new.blf",
    "log export run.mcap -o new.parquet",
    "log export run.mcap -o newframes.mcap",
    "analyse run.mcap -o new.json",
    "report run.mcap -o new.html",
    "compare run.mcap other.mcap -o new.json",
    "view run.mcap --save new.rrd",
    "import trace.log -o new.mcap -r snake4.toml",
    "import trace.blf -o new.mcap -r snake4.toml",
    "drive scenario.toml --on twin -o new.mcap --duration 3",
    "replay run.mcap --on twin:scenario.toml --duration 2 -o new.mcap",
    "plan lag-sweep --like run.mcap -o new",
    "plan reversal --like run.mcap -o new",
    "record twin:scenario.toml --fast --quiet --floor 1MB --socket c.sock -o new.mcap",
]
END = {".html": b"</html>", ".rrd": b""}


def lay_out(folder, stage):
    """Write the inputs of all command lines."""
    path = stage.folder / "bases" / "long.mcap"
    if not path.exists():
        part = path.with_name(f"part{os.getpid()}.mcap")
        gait_session(part, 2000)
        part.rename(path)
    long = path.read_bytes()
    places = {"unfinished": folder / "unfinished", "trace": folder}
    for base in stage.bases:
        if base.kind in places:
            write_files(places[base.kind], base.files)
    write_files(folder, {"run.mcap": long, "other.mcap": stage.files_of("lz4.mcap")["lz4.mcap"]})


def whole_outputs(folder):
    """Return faults of the files under their final names."""
    output = check_output(folder)
    for suffix, end in END.items():
        for path in folder.glob(f"new*{suffix}"):
            data = path.read_bytes()
            if not data or end not in data[-100:]:
                output.append(f"output: {path.name} is cut short")
    return output


def run(seed, stage):
    """End one command at a random moment, then run it again to its end."""
    rng = random.Random(seed)
    line = rng.choice(LINES)
    words = shlex.split(line)
    by = rng.choice([signal.SIGKILL, signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
    recording = words[0] == "record"
    with stage.fresh() as folder:
        lay_out(folder, stage)
        result = Result(f"{line!r} and {by.name}")
        outcome = run_command(words, folder, end_after_s=rng.random() ** 2 * 1.2, end_by=by)
        result.add(outcome)
        if by == signal.SIGINT:  # before the command has begun Python itself answers
            result.failures = [
                failure for failure in result.failures if not failure.endswith("[?]")
            ]
        leaves_a_log = recording and (folder / "new.mcap.wal").exists()
        result.failures += whole_outputs(folder)
        if not outcome.killed:
            return result
        if leaves_a_log:
            words = ["log", "recover", "new.mcap", "-o", "new.recovered.mcap"]
        elif words[0] == "plan":  # its folder may be there, whole sessions in it
            words = [*words[: words.index("-o")], "-o", "again"]
        else:
            words.append("--force")
        again = run_command(words, folder)
        result.failures += [f"again: {fault}" for fault in judge(again)]
        if again.code and not leaves_a_log:
            result.failures.append(f"again: exit code {again.code}: {again.errors}")
    return result


def run_recorder(seed, stage):
    """Kill the recorder under the load of two senders; accepted frames are kept.

    What may be missing is what the kernel had accepted in the last 50 ms.
    """
    rng = random.Random(seed)
    with stage.fresh() as folder:
        rate, per_packet = rng.choice([500, 2000, 4000]), rng.choice([1, 9, 64])
        options = rng.choice([(), ("--split-size", "1MB"), ("--robot", "snake25", "--bus", "a")])
        result = Result(f"record {' '.join(options)} {rate}/s, {per_packet} a packet, SIGKILL")
        with (
            recorder(folder, ("a", "b"), options) as running,
            senders(folder, ("a", "b"), rate=rate, per_packet=per_packet, seconds=60) as sending,
        ):
            for sender in sending:
                sender.wait_for(200)
            time.sleep(rng.uniform(0.0, 3.0))
            killed_ns = time.monotonic_ns()
            os.kill(running.pid, signal.SIGKILL)
            running.wait(30)
            accepted = [sender.accepted_before(killed_ns - 50_000_000) for sender in sending]
        (folder / "recovered").mkdir()
        words = ["log", "recover", folder / "run.mcap", "-o", folder / "recovered" / "r.mcap"]
        outcome = run_command(words, folder)
        result.add(outcome)
        if outcome.code:
            result.failures.append(f"recover: {outcome.errors}")
        for sender, least in zip(sending, accepted, strict=True):
            result.failures += check_kept(folder / "recovered", sender, least)
            result.figures["n_accepted"] = result.figures.get("n_accepted", 0) + least
            kept = len(numbers_in(sorted((folder / "recovered").glob("*.mcap")), sender.bus))
            tail_ms = sender.lost_tail_ms(kept, killed_ns)
            result.figures["tail_ms"] = max(tail_ms, result.figures.get("tail_ms", 0))
    return result
