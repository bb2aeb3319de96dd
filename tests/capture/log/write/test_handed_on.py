"""What the sinks and channels hand on to each other can't be changed."""

import pytest

from support.frozen_records import mutable_dataclasses

MODULES = (
    "undulog.capture.log.write.channels",
    "undulog.capture.log.write.disk_thread",
    "undulog.capture.log.write.ring_sink",
)


@pytest.mark.parametrize("package", [*MODULES, "undulog.capture.log.write"])
def test_records_are_frozen(package):
    assert mutable_dataclasses(package) == set()
