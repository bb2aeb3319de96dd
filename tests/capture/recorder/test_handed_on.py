"""What the parts of the recorder hand on to each other can't be changed."""

import pytest

from support.frozen_records import mutable_dataclasses

CHANGED = {
    "undulog.capture.recorder.control": {"_Client"},
    "undulog.capture.recorder.health": {"_Topic"},
    "undulog.capture.recorder.links": {"SourceLink"},
    "undulog.capture.recorder.live_feed": {"LiveCounts"},
    "undulog.capture.recorder.loop": set(),
    "undulog.capture.recorder.pauses": set(),
    "undulog.capture.recorder.record_report": set(),
    "undulog.capture.recorder.settings": set(),
    "undulog.capture.recorder.source_clock": set(),
    "undulog.capture.recorder.status": set(),
}
"""Modules with dataclasses, and those of them that count or collect."""


@pytest.mark.parametrize("module", CHANGED)
def test_records_are_frozen_but_those_that_count(module):
    assert mutable_dataclasses(module) == CHANGED[module]


def test_no_other_module_has_records_that_can_be_changed():
    assert mutable_dataclasses("undulog.capture.recorder") == set().union(*CHANGED.values())
