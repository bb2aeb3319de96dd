"""Logs that are dropped without being closed, while others are read."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np

from undulog.capture import SessionWriter

READS = """
import gc, sys, weakref
from undulog.capture.log.mcap_payloads import McapPayloads
from pathlib import Path

class Ring:
    pass

path = Path(sys.argv[1])
for allocations in range(1, 60):  # after as many, the collector works: at each place once
    gc.collect()
    gc.disable()
    ring = Ring()
    ring.log, ring.ring = McapPayloads(path), ring
    dropped = weakref.ref(ring)
    del ring
    log = McapPayloads(path)
    gc.set_threshold(allocations)
    gc.enable()
    log.forget()
    log.close()
    gc.collect()
    assert dropped() is None
print("read")
"""


def test_a_forgotten_log_may_be_collected_at_any_moment(tmp_path: Path) -> None:
    path = tmp_path / "some.mcap"
    with SessionWriter(path, session_id="some", epoch_ns=1_735_689_600_000_000_000) as writer:
        states = writer.joint_state("/joint_states", ("a", "b"), unit="rad")
        for tick in range(100):
            states.write(1_735_689_600_000_000_000 + tick * 10_000_000, np.zeros(2))
    done = subprocess.run(
        [sys.executable, "-c", READS, str(path)],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
        cwd=Path(__file__).parents[2],
    )
    assert done.stdout == "read\n", done.stderr
