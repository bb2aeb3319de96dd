"""Damaged files of every kind: a session, part of one with warnings, or an error of ours.

Seeded mutations (bits, cuts, blocks moved or zeroed, huge lengths) of MCAP files of several makes,
of what a killed recorder leaves, and of robot descriptions with their bus databases. They are read
in a process whose memory is bounded, whatever sizes a header claims. The fault campaign reads many
more, by the commands.
"""

import collections
import json
import queue
import subprocess
import sys
import threading

import pytest

from support import mutation_child
from support.processes import start

PATIENCE_S = 120.0
"""A small file is read in milliseconds; one that takes so long will take for ever."""


def lines_of(process):
    """Each line of a process as it comes; one that keeps silent is ended and None given."""
    lines = queue.Queue()

    def pump():
        for line in process.stdout:
            lines.put(json.loads(line))
        lines.put(StopIteration)

    thread = threading.Thread(target=pump)
    thread.start()
    try:
        while True:
            try:
                line = lines.get(timeout=PATIENCE_S)
            except queue.Empty:
                yield None
                return
            if line is StopIteration:
                return
            yield line
    finally:
        process.kill()
        process.wait()
        thread.join()


def read_mutated(first, stop):
    """Read the files of some seeds; checks each and gives how many came out in which way."""
    words = (sys.executable, mutation_child.__file__, first, stop)
    process = start(*words, stderr=subprocess.DEVNULL)
    with process.stdout:
        came, stray, seed, done = collections.Counter(), [], None, 0
        for line in lines_of(process):
            assert line is not None, f"seed {seed} was not read within {PATIENCE_S} s"
            if "begin" in line:
                seed = line["begin"]
                continue
            done += 1
            if "stray" in line:
                stray.append(f"seed {line['seed']}\n{line['trace']}")
            else:
                came[line["came"].split(" ")[0]] += 1
            assert line["grown"] < mutation_child.GROWTH, (
                f"seed {seed} needed {line['grown']} bytes"
            )
    assert not stray, f"{len(stray)} stray errors:\n" + "\n".join(stray[:5])
    assert done == stop - first, f"the process ended while it read seed {seed}"
    return came


@pytest.mark.slow
@pytest.mark.parametrize(
    ("first", "count"), [(0, 30), pytest.param(30, 270, marks=pytest.mark.nightly)]
)
def test_a_few_hundred_mutated_files(first, count):
    came = read_mutated(first, first + count)
    # Neither is everything refused nor does damage pass unseen.
    assert came["read"] > count / 3
    assert came["refused:"] > count / 15
    assert came["recovered"] > count / 30
