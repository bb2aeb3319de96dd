"""What the modules of a drive hand on to one another can't be changed."""

import pytest

from support.frozen_records import mutable_dataclasses

CHANGED = {
    "undulog.sim.drive.dry_run": set(),
    "undulog.sim.drive.dry_run_gait": set(),
    "undulog.sim.drive.feedback": {"_Sent"},
    "undulog.sim.drive.limits": set(),
    "undulog.sim.drive.loop": {"LoopTally"},
    "undulog.sim.drive.motion": set(),
    "undulog.sim.drive.outcome": set(),
    "undulog.sim.drive.over_bus": {"_Telling"},
    "undulog.sim.drive.plan": set(),
    "undulog.sim.drive.report": {"BusReport"},
}
"""Records that count while they are in use, by module."""


@pytest.mark.parametrize("module", CHANGED)
def test_records_of_a_module_are_frozen_but_for_those_that_count(module):
    assert mutable_dataclasses(module) == CHANGED[module]


def test_no_module_has_others():
    assert mutable_dataclasses("undulog.sim.drive") == set().union(*CHANGED.values())
