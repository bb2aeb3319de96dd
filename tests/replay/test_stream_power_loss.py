"""Saved recordings on a disk that forgets what wasn't synced."""

from support.forgetting_disk import Loss

START = """
import os, signal, sys
from pathlib import Path
from undulog.capture.common.files import part_file
from undulog.replay.stream import RrdFile
"""
WRITTEN = """
output = Path(sys.argv[1])
with part_file(output) as draft, RrdFile(draft, output) as file:
    with open(f"/dev/fd/{file._far_end}", "wb") as stream:
        stream.write(b"new " * 100_000)
    file.finish()
os.kill(os.getpid(), signal.SIGKILL)
"""


def test_a_file_that_replaces_another_is_whole_under_its_name(disk):
    """The name needn't have reached the disk: then the former file is there."""
    (disk.root / "run.rrd").write_bytes(b"old")
    disk.settle()
    disk.run(WRITTEN, disk.root / "run.rrd")
    assert (disk.after(Loss.EVERYTHING) / "run.rrd").read_bytes() == b"old"
    assert (disk.after(Loss.BYTES) / "run.rrd").read_bytes() == b"new " * 100_000
