"""``sim show``: every number of every scenario has the unit that its class states."""

import dataclasses
import re
import tomllib

import pytest

from undulog.capture.robot.model import Servo
from undulog.sim import load_scenario, scenario_names
from undulog.sim.commands.run import leaves, unit_of
from undulog.sim.scenario.motion import HeadSteering, TailHaste
from undulog.sim.scenario.sensors import AccelerometerModel, CompassModel, InfraredModel, SonarModel
from undulog.sim.scenario.world import Ground


@pytest.mark.parametrize("name", scenario_names())
def test_every_number_has_a_unit_or_is_known_to_have_none(name, report_of):
    shown = report_of("sim", "show", name)["values"]
    every = dict(leaves(tomllib.loads(load_scenario(name).toml())))
    assert {key: entry["value"] for key, entry in shown.items()}.items() <= every.items()
    assert all(entry["unit"] is not None for entry in shown.values())


@pytest.mark.parametrize(
    ("key", "cls"),
    [
        ("world.ground", Ground),
        ("sensing.ir", InfraredModel),
        ("sensing.sonar", SonarModel),
        ("sensing.accelerometer", AccelerometerModel),
        ("sensing.compass", CompassModel),
        ("servo", Servo),
        ("controller.head", HeadSteering),
        ("controller.tail", TailHaste),
    ],
)
def test_units_are_those_of_the_classes_descriptions(key, cls):
    stated = dict(re.findall(r"^\s+(\w+): [^\[\n]*\[([^\]]+)\]", cls.__doc__, re.MULTILINE))
    names = [field.name for field in dataclasses.fields(cls) if field.name in stated]
    assert names
    assert {name: unit_of(f"{key}.{name}") for name in names} == {n: stated[n] for n in names}


def test_an_unknown_key_has_no_unit():
    assert unit_of("world.colour") is None
