"""Kills of a recorder while it writes marks of a ring, or begins parts: nothing torn has a name."""

import json
import os
import random
import signal
import socket
import time

from mcap.reader import make_reader

from .case import Result, run_command
from .recording import numbers_in, recorder, senders

BUS = "a"


def asked(folder, request):
    """Send one request to the recorder's control socket; return the reply."""
    with socket.socket(socket.AF_UNIX) as client:
        client.settimeout(30)
        client.connect(str(folder / "control.sock"))
        client.sendall(json.dumps(request).encode() + b"\n")
        return json.loads(client.makefile().readline())


def torn(folder):
    """Return failures: files under a final name that mcap's own reader can't read to the end."""
    failures = []
    for path in sorted(folder.glob("*.mcap")):
        try:
            with path.open("rb") as stream:
                reader = make_reader(stream, validate_crcs=True)
                counted = sum(1 for _ in reader.iter_messages(log_time_order=False))
                stated = reader.get_summary().statistics.message_count
        except Exception as error:  # noqa: BLE001 - whatever the foreign reader raises
            failures.append(f"torn: {path.name}: {type(error).__name__}: {error}")
            continue
        if counted != stated:
            failures.append(f"torn: {path.name}: {counted} of {stated} messages")
    return failures


def unnamed(folder, names, places):
    """Return failures: part files that ``log info`` of some places doesn't name."""
    failures = []
    for place in places:
        outcome = run_command(["log", "info", place], folder)
        text = (outcome.out + outcome.err).decode()
        failures += [f"unnamed: {name} by log info {place}" for name in names if name not in text]
    return failures


def recovered(folder, name, result):
    """Recover a session; return the numbers of its frames, none where no chunk is whole."""
    (folder / "recovered").mkdir(exist_ok=True)
    output = folder / "recovered" / name
    outcome = run_command(["log", "recover", name, "-o", output], folder)
    result.add(outcome)
    if outcome.code:
        part = folder / f"{name}.part"
        begun = part.exists() and part.stat().st_size < EMPTY
        if not begun:
            result.failures.append(f"recover: {name}: {outcome.errors}")
        return []
    return numbers_in([output], BUS)


EMPTY = 64 << 10
"""Size of a mark's part file below which it may have no whole chunk [byte]."""


def run(seed, stage):
    """Kill a recorder up to half a second after marks of its ring, or splits of its session."""
    rng = random.Random(seed)
    ring = rng.random() < 0.6
    options = rng.choice([(), ("--robot", "snake25")])
    options += ("--ring", "30s") if ring else ("--split-size", rng.choice(["1MB", "1GB"]))
    rate, requests = rng.choice([4000, 12000]), rng.randrange(1, 4)
    result = Result(f"record {' '.join(options)} {rate}/s, {requests} requests, SIGKILL")
    with stage.fresh() as folder:
        with (
            recorder(folder, (BUS,), options) as running,
            senders(folder, (BUS,), rate=rate, per_packet=32, seconds=60) as (sending,),
        ):
            sending.wait_for(100)
            time.sleep(rng.uniform(0.0, 2.0))
            for _ in range(requests):
                reply = asked(folder, {"do": "mark" if ring else "split"})
                if not reply["ok"]:
                    result.failures.append(f"refused: {reply}")
            time.sleep(rng.uniform(0.0, rng.choice([0.005, 0.05, 0.5])))
            killed_ns = time.monotonic_ns()
            os.kill(running.pid, signal.SIGKILL)
            running.wait(30)
            least = sending.accepted_before(killed_ns - 50_000_000)
        result.failures += torn(folder)
        parts = sorted(folder.glob("*.part"))
        result.figures["n_whole"] = len(list(folder.glob("*.mcap")))
        result.figures["n_parts"] = len(parts)
        names = [part.name for part in parts]
        if ring:
            _check_marks(folder, parts, names, result)
        elif names:
            result.failures += unnamed(folder, names[-1:], [".", "run.mcap"])
            numbers = recovered(folder, "run.mcap", result)
            if numbers != list(range(len(numbers))):
                result.failures.append("lost: frames of the session are not in order, each once")
            if len(numbers) < least:
                result.failures.append(f"lost: {least - len(numbers)} of {least} frames")
        else:
            result.failures.append("lost: no part file of the open part")
    return result


def _check_marks(folder, parts, names, result):
    """The whole chunks of a mark are what is recovered of it; each frame once, in order."""
    result.failures += unnamed(folder, names, ["."]) if names else []
    for part in parts:
        final = part.name.removesuffix(".part")
        result.failures += unnamed(folder, [part.name], [final])
        numbers = recovered(folder, final, result)
        if numbers and numbers != list(range(numbers[0], numbers[0] + len(numbers))):
            result.failures.append(f"lost: frames of {part.name} are not in order, each once")
