"""The manual's page on world and sensors: its example runs, its tables say what the code does."""

import dataclasses
import re

import pytest

from support.paths import DOCS
from undulog import sim

PAGE = (DOCS / "reference/twin-world.md").read_text()


def test_the_examples_make_a_scenario():
    examples = re.findall(r"```toml\n(.*?)```", PAGE, re.DOTALL)
    scenario = sim.parse_scenario("\n".join(examples), "x.toml")
    assert [push.link for push in scenario.disturbances] == ["link07"]
    assert (len(scenario.world.obstacles), scenario.sensing.ir.noise_v) == (10, 0.058)


@pytest.mark.parametrize(
    ("table", "kind"),
    [
        ("world.field", sim.RandomField),
        ("world.obstacle_contact", sim.ObstacleMaterial),
        ("sensing.servo", sim.ServoPolling),
        ("sensing.ir", sim.InfraredModel),
        ("sensing.sonar", sim.SonarModel),
        ("sensing.accelerometer", sim.AccelerometerModel),
        ("sensing.compass", sim.CompassModel),
    ],
)
def test_the_tables_have_all_keys_and_their_defaults(table, kind):
    rows = PAGE.split(f"| key of `[{table}]` |")[1].split("\n\n")[0].splitlines()[2:]
    defaults = {}
    for row in rows:
        key, _, default, _ = (cell.strip() for cell in row.strip("|").split("|"))
        defaults[key.strip("`")] = default.strip("`")
    assert set(defaults) == {item.name for item in dataclasses.fields(kind)}
    for item in dataclasses.fields(kind):
        if item.default is dataclasses.MISSING:
            assert defaults[item.name] == ""
        elif item.default is None:
            assert defaults[item.name] == "the scenario's"
        elif isinstance(item.default, tuple):
            assert eval(defaults[item.name]) == list(item.default)
        else:
            assert float(defaults[item.name]) == item.default
