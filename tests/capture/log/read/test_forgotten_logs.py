"""Logs that are dropped without being closed, while others are read."""

import numpy as np
import pytest

from support.paths import ROOT
from support.processes import python
from support.written_topics import EPOCH_NS, write_topics
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


@pytest.mark.slow
def test_a_forgotten_log_may_be_collected_at_any_moment(tmp_path):
    topics = {"/joint_states": (("a", "b"), "rad", np.zeros((100, 2)))}
    t_ns = EPOCH_NS + np.arange(100) * 10_000_000
    path = write_topics(tmp_path / "some.mcap", t_ns, topics)
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
