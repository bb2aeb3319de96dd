"""Edited logs on a disk that forgets what wasn't synced: the sources may be deleted then."""

from support import durable_child as recorder
from support.forgetting_disk import Loss
from support.read_back import read

START = """
import os, shutil, signal, sys
from pathlib import Path
from support import durable_child as recorder
from undulog.capture.log.cut import recover_log

path = lambda name: Path(sys.argv[1], name)
"""


def test_a_recovered_log_is_there_once_its_sources_may_be_deleted(disk):
    killed = """
sink = recorder.open_sink(path("run.mcap"), segment_size=1 << 18, ballast=0)
for number in range(500):
    recorder.write(sink, number)
os.kill(os.getpid(), signal.SIGKILL)
"""
    disk.run(killed, disk.root)
    disk.settle()
    recovered = """
recover_log(path("run.mcap"), path("whole.mcap"))
path("run.mcap.part").unlink()
shutil.rmtree(path("run.mcap.wal"))
os.kill(os.getpid(), signal.SIGKILL)
"""
    disk.run(recovered, disk.root)
    for loss in Loss:
        messages, warnings = read(disk.after(loss) / "whole.mcap")
        assert messages == recorder.truth(500)
        assert warnings == []
