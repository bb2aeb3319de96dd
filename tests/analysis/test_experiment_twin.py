"""The reversal test on recorded twins: a short chain on the ground, six runs each way."""

import pytest

from analysis import analyse_experiment
from capture import Session
from sim import load_scenario
from sim.record import record

pytestmark = pytest.mark.slow

ROBOT = """name = "chain7"
description = "Seven joints, yaw at both ends: four yaw joints in two mirror pairs."
clock = "simulated"
assumed = ["links", "servo"]
[chain]
joints = 7
planes = ["horizontal", "vertical"]
[defaults.link]
length = 0.06
radius = 0.025
mass = 0.1
inertia = [4e-5, 5e-5, 5e-5]
[defaults.joint]
lower = -0.52
upper = 0.52
max_velocity = 10.0
[defaults.servo]
supply_v = 6.0
stall_torque = 0.25
torque_constant = 1.0
proportional_gain = 8.0
rotor_inertia = 1.5e-3
viscous_friction = 0.005
coulomb_friction = 0.03
gear_stiffness = 40.0
gear_damping = 0.05
"""

SCENARIO = """description = "A wave in identical modules."
robot = "chain7.toml"
duration_s = 8.0
settle_s = 4.0
[gait]
ramp_s = 1.0
[gait.horizontal]
amplitude = 0.4
frequency_hz = 1.0
lag = 1.0471975511965976
wave = "{wave}"
[noise]
position = 0.005
"""

WEAK = """[servo_of.joint03]
stall_torque = 0.2
"""


@pytest.fixture(scope="module")
def answered(tmp_path_factory):
    """The experiment of six runs each way, with identical modules or with a weak one."""

    def make(more):
        folder = tmp_path_factory.mktemp("twin")
        (folder / "chain7.toml").write_text(ROBOT)
        paths = []
        for way, wave in enumerate(("head-to-tail", "tail-to-head")):
            (folder / "wave.toml").write_text(SCENARIO.format(wave=wave) + more)
            scenario = load_scenario(folder / "wave.toml")
            for k in range(6):
                paths.append(folder / f"{wave}-{k}.mcap")
                record(scenario.changed(seed=20 * way + k + 1), paths[-1])

        def opened():
            for path in paths:
                with Session.open(path) as session:
                    yield session

        return analyse_experiment(opened())

    return make


def test_identical_modules_are_not_called_different(answered):
    result = answered("")
    reversal = result.reversal
    assert (reversal.forward_runs, reversal.reverse_runs) == (6, 6)
    assert reversal.p > 0.05
    assert reversal.weak == ()
    assert reversal.boundary_share.ci95[0] > 0.95
    assert ": the pattern is boundary (share" in result.answer
    # The pattern itself is there beyond doubt.
    assert result.heterogeneity["common_response"].p < 1e-9


def test_the_weak_servo_is_named(answered):
    result = answered(WEAK)
    assert result.reversal.p == pytest.approx(2 / 924)
    assert result.answer.startswith("the modules differ: joint03 is weak (p = 0.002)")
    weak = result.reversal.weak[0]
    assert (weak.name, weak.mirror) == ("joint03", "joint05")
    assert weak.lag_contrast_rad.ci95[0] > 0
    assert result.reversal.boundary_share.value > result.reversal.module_share.value
