"""Logs that are dropped without being closed, while others are read."""

import numpy as np
import pytest

from support.paths import ROOT
from support.processes import python
from undulog.capture import SessionWriter
from undulog.capture.log.mcap.payloads import McapPayloads

READS = """
import gc, sys, weakref
from undulog.capture.log.mcap.payloads import McapPayloads
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


def test_a_forgotten_log_may_be_collected_at_any_moment(tmp_path):
    path = tmp_path / "some.mcap"
    with SessionWriter(path, session_id="some", epoch_ns=1_735_689_600_000_000_000) as writer:
        states = writer.joint_state("/joint_states", ("a", "b"), unit="rad")
        for tick in range(100):
            states.write(1_735_689_600_000_000_000 + tick * 10_000_000, np.zeros(2))
    done = python(READS, path, cwd=ROOT)
    assert done.stdout == "read\n", done.stderr


def test_an_interrupt_stays_one_where_a_frame_still_holds_bytes_of_the_log(tmp_path):
    path = tmp_path / "run.mcap"
    path.write_bytes(b"0123456789" * 100)

    def read(log):
        held = memoryview(log.buffer)[10:20]
        try:
            raise KeyboardInterrupt
        finally:
            log.close()
            assert bytes(held) == b"0123456789"

    with pytest.raises(KeyboardInterrupt):
        read(McapPayloads(path))
