"""The twin with one weakened joint against itself: named first, with what was changed."""

import numpy as np
import pytest

from support import twin_chains
from undulog.analysis import compare_sessions
from undulog.capture import Session
from undulog.sim import load_scenario, record
from undulog.sim.scenario.scenario import Kernels

pytestmark = pytest.mark.nightly


WEAK = {"servo_of": {"joint03": {"stall_torque": 0.2}}}


WAVE = {"duration_s": 7.0, "settle_s": 3.0, "gait": {"ramp_s": 0.5}, "noise": {"position": 0.002}}


@pytest.fixture(scope="module")
def twins(tmp_path_factory):
    """A session as it is, one with other noise, one with a weak servo; and the first one's path."""
    folder = tmp_path_factory.mktemp("twins")
    (folder / "chain.toml").write_text(twin_chains.chain(5, stall_torque=0.25))
    path = []

    def follow(sample):
        path.append(sample.step.body.position.mean(axis=1))

    files = []
    for seed, more in enumerate(({}, {}, WEAK), start=1):
        (folder / "wave.toml").write_text(twin_chains.wave(**WAVE, **more))
        files.append(folder / f"run{seed}.mcap")
        scenario = load_scenario(folder / "wave.toml").changed(seed=seed)
        on_sample = follow if seed == 1 else None
        record(scenario, files[-1], on_sample=on_sample, kernels=Kernels.NUMBA)
    return files, np.array(path)


def compared(a, b):
    with Session.open(a) as first, Session.open(b) as second:
        return compare_sessions(first, second)


def test_the_weak_servo_is_named_first_with_what_was_changed(twins):
    (base, _, weak), _ = twins
    result = compared(base, weak)
    assert result.answer.startswith("B differs from A: joint03 most")
    assert result.named[0].name == "joint03"
    assert result.named[0].size > 2 * max((joint.size for joint in result.named[1:]), default=0.0)
    (change,) = result.changed
    assert change.name == "scenario.toml: servo_of.joint03.stall_torque"
    assert (change.a, change.b) == (None, "0.2")


def test_other_noise_makes_no_difference(twins):
    (base, again, _), _ = twins
    result = compared(base, again)
    assert (result.verdict, result.changed) == ("same", ())


def test_speed_is_that_of_the_centre_of_mass_in_the_physics(twins):
    """All links weigh the same; over the last four whole cycles, samples 100 a second."""
    (base, again, _), path = twins
    speed = next(
        difference
        for difference in compared(base, again).differences
        if difference.quantity == "speed"
    )
    truth = float(np.linalg.norm((path[-1] - path[-401])[:2])) / 4.0
    assert speed.a == pytest.approx(truth, rel=0.005)
