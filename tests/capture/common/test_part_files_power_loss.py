"""Outputs on a disk that forgets what wasn't synced: whole, or what was there before."""

import pytest

from support.forgetting_disk import ForgettingDisk, Loss

OLD, NEW = b"old " * 3000, b"new " * 5000

START = """
import os, signal, sys
from pathlib import Path
from undulog.capture.common.files import part_file
from undulog.capture.common.part_files import publish_durably
"""
PUBLISHED = """
output, replace = Path(sys.argv[1]), sys.argv[2] == "True"
part = output.with_name("run.mcap.part")
part.write_bytes(b"new " * 5000)
publish_durably(part, output, replace=replace)
os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.parametrize("replace", [False, True])
def test_what_was_published_is_there_under_its_name_and_whole(disk, replace):
    if replace:
        (disk.root / "run.mcap").write_bytes(OLD)
        disk.settle()
    disk.run(PUBLISHED, disk.root / "run.mcap", replace)
    for loss in Loss:
        left = disk.after(loss)
        assert [path.name for path in left.iterdir()] == ["run.mcap"]
        assert (left / "run.mcap").read_bytes() == NEW


REPLACED = """
with part_file(Path(sys.argv[1]), durable=True) as part:
    part.write_bytes(b"new " * 5000)
"""


def test_a_replacement_that_loses_its_power_is_the_old_file_or_the_new_one(tmp_path, programs):
    """At each sync, and after the last one."""
    for number in range(1, 10):
        disk = ForgettingDisk(tmp_path / str(number), programs)
        (disk.root / "out.mcap").write_bytes(OLD)
        disk.settle()
        code, _ = disk.run(REPLACED, disk.root / "out.mcap", code=None, ends=number)
        for loss in Loss:
            kept = (disk.after(loss) / "out.mcap").read_bytes()
            assert kept in ((NEW,) if code == 0 else (OLD, NEW)), (number, loss)
        if code == 0:
            break
    assert number == 3
