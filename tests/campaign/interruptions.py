"""Recorders that are stopped and continued: SIGSTOP and SIGCONT at random moments under load.

What a sender's write returned for is accepted. All of it is in the session, in order, however long
the recorder stood; the recorder ends with exit code 0, and each stop is an event of the session.
"""

import json
import os
import random
import signal
import subprocess
import sys
import time
from contextlib import ExitStack
from pathlib import Path

from support.processes import UNDULOG
from support.read_back import messages_of

from .case import Result
from .recording import PATIENCE_S, Sending, start
from .recording import SENDER as PACKET_SENDER

NUMBERED_SENDER = Path(__file__).with_name("numbered_sender.py")
RATE = 3000
"""Frames a second of each of two sources: 6,000 packets or lines a second."""

STOPS_S = (0.05, 1.0, 10.0)
COUNTS = {0.05: 5, 1.0: 4, 10.0: 1}
"""Stops in one case."""

KINDS = ("unix", "socketcand", "slcan", "serial", "reopened")
AT = {
    "unix": ("can", 32, 24),
    "socketcand": ("can", 32, 24),
    "reopened": ("can", 32, 24),
    "slcan": ("can", 32, 24),
    "serial": ("serial", 88, 29),
}
"""Topic, size of a record, place of the number in it (the log contract; a Feetech packet)."""

TICK_S = 0.02
"""Of the recorder: it need not have run between two stops that are less apart."""

WHEN = ("running", "running", "running", "twice", "ending", "splitting", "group")


def run(seed, stage):
    """Stop a recorder of two sources at random moments; each accepted frame is kept once."""
    rng = random.Random(seed)
    kind, stop_s = KINDS[seed % 5], STOPS_S[seed // 5 % 3]
    with stage.fresh() as folder:
        return run_case(folder, kind, stop_s, rng.choice(WHEN), rng)


def run_case(folder, kind, stop_s, when, rng):
    """Return the result of one case."""
    result = Result(f"record 2 x {kind} {RATE}/s, {COUNTS[stop_s]} stops of {stop_s} s, {when}")
    with ExitStack() as stack:
        _stop_and_check(folder, stack, (kind, stop_s, when), rng, result)
    return result


def _stop_and_check(folder, stack, case, rng, result):
    kind, stop_s, when = case
    count = COUNTS[stop_s]
    seconds = 3.0 + count * (stop_s + 0.5)
    sending, addresses = line_up(folder, stack, kind, seconds)
    options = ["--split-time", "1s"] if when == "splitting" else []
    words = [*UNDULOG, "record", *addresses, *options, "--quiet", "--json", "--floor", "0"]
    words += ["--socket", folder / "control.sock", "-o", folder / "run.mcap"]
    errors = stack.enter_context((folder / "recorder.err").open("wb"))
    running = start(
        stack, *words, stdout=subprocess.PIPE, stderr=errors, start_new_session=when == "group"
    )
    for sender in sending:
        sender.wait_for(200)
    stops = apart = 0
    for _ in range(count):
        gap_s = rng.uniform(0.0, 0.8)
        time.sleep(gap_s)
        stop(running, stop_s, group=when == "group")
        apart += not stops or gap_s > TICK_S
        stops += 1
        if when == "twice":
            stop(running, stop_s)
            stops += 1
    reports = [report(sender) for sender in sending]
    if when != "ending":
        time.sleep(1.0)
    running.send_signal(signal.SIGTERM)
    if when == "ending":
        time.sleep(rng.uniform(0.0, 0.05))
        if running.poll() is None:
            stop(running, stop_s)
    running.communicate(timeout=PATIENCE_S)
    text = (folder / "recorder.err").read_text(errors="replace")
    if running.returncode != 0 or "Traceback" in text:
        result.failures.append(f"recorder: exit code {running.returncode}: {text[-300:]}")
    paths = sorted(folder.glob("*.mcap"))
    for sender, accepted in zip(sending, reports, strict=True):
        result.failures += check_numbers(paths, kind, sender.bus, accepted["accepted"])
    if (counted := stop_events(paths)) < apart:
        result.failures.append(f"event: {counted} events of {stops} stops")
    result.figures = {"n_accepted": sum(r["accepted"] for r in reports), "n_stops": stops}


def line_up(folder, stack, kind, seconds):
    """Start two senders of a kind; return them and the addresses of the sources."""
    sending, addresses = [], []
    for bus in ("a", "b"):
        log, place = folder / f"{bus}.accepted", folder / f"{bus}.place"
        if kind == "unix":
            words = [PACKET_SENDER, folder / f"{bus}.sock", log, RATE, 1, seconds]
            addresses.append(f"{bus}=unix:{folder / bus}.sock")
        else:
            words = [NUMBERED_SENDER, kind, place, log, RATE, seconds]
        process = start(
            stack, sys.executable, *words, stdout=subprocess.PIPE, stdin=subprocess.PIPE
        )
        for pipe in (process.stdin, process.stdout):
            stack.callback(pipe.close)
        sending.append(Sending(bus, process, log))
        if kind != "unix":
            wait_for_place(place, process)
            addresses.append(f"{bus}={address(kind, place)}")
    return sending, addresses


def address(kind, place):
    """Return the address of a line or a server."""
    if kind == "slcan":
        return f"can:slcan:{place}?tty_baud=1000000"
    if kind == "serial":
        return f"serial:{place}?protocol=feetech&baud=1000000"
    return f"can:socketcand:can0?host=127.0.0.1&port={place.read_text()}"


def wait_for_place(place, process):
    """Wait until a sender can be reached."""
    until = time.monotonic() + PATIENCE_S
    while not os.path.lexists(place):
        if time.monotonic() > until or process.poll() is not None:
            raise TimeoutError(f"no {place.name}")
        time.sleep(0.01)


def stop(running, stop_s, *, group=False):
    """Stop a process, or its group, and continue it after a time."""
    send = os.killpg if group else os.kill
    send(running.pid, signal.SIGSTOP)
    time.sleep(stop_s)
    send(running.pid, signal.SIGCONT)


def report(sender):
    """Return a sender's report at its end."""
    line = sender.process.stdout.readline()
    return json.loads(line)


def check_numbers(paths, kind, bus, least):
    """Return failures unless each accepted frame is there once, in order, and no other."""
    topic, size, at = AT[kind]
    numbers = []
    try:
        for path in paths:
            for *_, message in messages_of(path, topics=[f"/{topic}/{bus}"], log_time_order=False):
                data = message.data
                begin = len(data) - size
                while begin >= size and int.from_bytes(data[begin - 4 : begin], "little") != (
                    len(data) - begin
                ):
                    begin -= size
                ends = range(begin + at, len(data), size)
                numbers += [int.from_bytes(data[k : k + 8], "little") for k in ends]
    except Exception as error:  # noqa: BLE001 - whatever the foreign reader raises
        return [f"output: unreadable: {type(error).__name__}: {error}"]
    if numbers == list(range(least)):
        return []
    wrong = next((k for k, number in enumerate(numbers) if k != number), len(numbers))
    return [f"lost: {len(numbers)} of {least} accepted frames of {bus}; the first at {wrong}"]


def stop_events(paths):
    """Return the number of events of stops, as mcap's own reader gives them."""
    return sum(
        b"stopped by a signal" in message.data
        for path in paths
        for *_, message in messages_of(path, topics=["/rosout"], log_time_order=False)
    )
