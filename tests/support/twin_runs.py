"""Scenarios as text, and runs of the twin in this process."""

import pytest

from undulog.capture.common.errors import ScenarioError
from undulog.sim import parse_scenario
from undulog.sim.physics.ledger import TERMS
from undulog.sim.twin.twin import Twin

GAIT = """
[gait.horizontal]
amplitude = 0.3
frequency_hz = 0.5
lag = 0.5
"""
SNAKE13, SNAKE25 = (
    f'description = "a test"\nrobot = "{robot}"\nduration_s = 2.0\n{GAIT}'
    for robot in ("snake13", "snake25")
)


def faults_of(text):
    """Return the faults of a scenario's text by their keys."""
    with pytest.raises(ScenarioError) as caught:
        parse_scenario(text, "x.toml")
    return {fault.key: str(fault) for fault in caught.value.faults}


def simulate(scenario, gait=None, **options):
    """Return all samples of a run."""
    with Twin(scenario, gait, **options) as twin:
        return list(twin.samples())


def sensed(scenario, gait=None):
    """Return all sensor samples of a run, also those that arrive after its end."""
    with Twin(scenario, gait) as twin:
        return [reading for sample in twin.samples() for reading in sample.sensed] + twin.flush()


def energies(last, first=None):
    """Return the ledger at a sample by term, or its change since another one [J]."""
    change = last.energy if first is None else last.energy - first.energy
    return dict(zip(TERMS, change, strict=True))


def check_keys(faults, keys):
    """Check that the faults are of these keys, which are separated by spaces."""
    assert set(faults) == set(keys.split())
