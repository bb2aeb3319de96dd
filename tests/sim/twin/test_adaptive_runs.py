"""The paper's controllers in the twin: what its figures show, measured from the log."""

import dataclasses
import importlib
import math

import numpy as np
import pytest

from support.paths import ROOT
from undulog.capture import Session
from undulog.sim import Target, Twin, load_scenario, record
from undulog.sim.scenario.scenario import Kernels

PERIOD = 200
"""Ticks of a gait period at 0.5 Hz."""


class Log:
    """Columns of a session, by name."""

    def __init__(self, path):
        with Session.open(path) as session:
            self.gait = self._columns(session, "/gait")
            self.angle = self._columns(session, "/joint_states")
            self.energy = self._columns(session, "/energy_ledger")
            self.modes = [message.data for _, message in session.messages("/gait/mode")]
            odometry = session.table("/odom")
            self.x = odometry["pose.pose.position.x"].to_numpy()
            self.y = odometry["pose.pose.position.y"].to_numpy()

    @staticmethod
    def _columns(session, topic):
        signals = session.joints(topic, "position")
        return dict(zip(signals.names, signals.values, strict=True))

    def swing(self, joint, second):
        """Half the range of a joint's measured angle over the period that ends at some time."""
        window = self.angle[joint][100 * second - PERIOD : 100 * second]
        return (window.max() - window.min()) / 2


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    folder = tmp_path_factory.mktemp("control")

    def run(name, **controller):
        scenario = load_scenario(name)
        if controller:
            changed = dataclasses.replace(scenario.controller, **controller)
            scenario = dataclasses.replace(scenario, controller=changed)
        path = folder / f"{scenario.session_id}.mcap"
        if not path.exists():
            record(scenario, path, kernels=Kernels.NUMBA)
        return Log(path)

    return run


@pytest.mark.nightly
def test_joints_beside_a_wall_swing_less_and_recover(recorded):
    """The paper's figure of the side sensors: the shrinking passes down the body with the wall."""
    log = recorded("side-sensor-amplitude")
    beside = [f"joint{number:02d}" for number in range(3, 22, 2)]
    free = [log.swing(joint, 14) for joint in beside]
    np.testing.assert_allclose(free, 0.3, atol=0.03)
    assert (np.divide([log.swing(joint, 8) for joint in beside], free) < 0.85).all()
    for joint in ("joint01", "joint25"):  # no sensor is beside them
        assert log.swing(joint, 8) == pytest.approx(log.swing(joint, 14), rel=0.05)
    half = [np.flatnonzero(log.gait[f"shrink.{joint}"] < 0.85)[0] for joint in beside]
    assert np.all(np.diff(half) >= 0)
    assert 100 < half[-1] - half[0] < 400  # 1.1 m of body at about half a metre a second
    assert log.modes[-3:] == ["walk", "shrink", "walk"]
    assert log.energy["obstacle_friction"][-1] == 0.0


@pytest.mark.nightly
def test_avoidance_goes_through_its_modes_and_touches_nothing(recorded):
    """A gate shrinks the sides and hastens the tail in it; the cylinder behind is avoided."""
    log = recorded("avoidance")
    assert log.modes[0] == log.modes[-1] == "walk"
    behind_the_gate = log.modes[log.modes.index("shrink") :]
    assert {"hasten", "avoid"} < set(behind_the_gate)
    assert behind_the_gate.index("hasten") < behind_the_gate.index("avoid")
    assert log.energy["obstacle_friction"][-1] == 0.0
    omega = log.gait["horizontal.omega"]
    assert math.pi == pytest.approx(omega[:300].max())
    assert 1.2 * math.pi < omega.max() < 1.5 * math.pi
    assert (log.gait["haste.distance"][omega > 1.2 * math.pi] <= 0.4).all()
    factor = log.gait["shrink.joint03"]
    assert factor.min() < 0.65
    assert factor[-1] > 0.98
    # Past the cylinder at x = 4, and not through it.
    assert abs(log.y[np.argmax(log.x > 4.0)]) > 0.15 + 0.025


@pytest.mark.nightly
def test_adaptive_amplitude_touches_a_corridor_for_less_time():
    """The same corridor with and without shrinking: both get through, one scrapes less."""
    scenario = load_scenario("corridor")
    contact_s = {}
    for smallest in (0.3, 1.0):
        side = dataclasses.replace(scenario.controller.side, smallest=smallest)
        controller = dataclasses.replace(scenario.controller, side=side)
        changed = dataclasses.replace(scenario, controller=controller)
        with Twin(changed, kernels=Kernels.NUMBA) as twin:
            for sample in twin.samples():
                if sample.step.body.position[0, 0] > 5.0:
                    break
        assert sample.step.body.position[0, 0] > 5.0
        contact_s[smallest] = sample.contact_s.sum()
    assert contact_s[0.3] < 0.75 * contact_s[1.0]


@pytest.mark.nightly
def test_reckoning_and_course_lead_to_a_target_on_free_ground():
    """Truth from the body's dynamics: reckoned within 5 % of the way, compass errors and all."""
    scenario = load_scenario("target-following")
    world = dataclasses.replace(scenario.world, obstacles=(), target=Target((3.0, 1.5), 0.3))
    scenario = dataclasses.replace(scenario, world=world, duration_s=12.0)
    with Twin(scenario, kernels=Kernels.NUMBA) as twin:
        names = twin.gait.names
        samples = []
        for sample in twin.samples():
            samples.append(sample)
            if math.dist(sample.step.body.position[:2, 0], (3.0, 1.5)) < 0.3:
                break
    true = np.array([sample.step.body.position[:2, 0] for sample in samples])
    values = np.array([sample.gait.values for sample in samples])
    reckoned = values[:, [names.index("course.x"), names.index("course.y")]]
    way = np.hypot(*np.diff(true, axis=0).T).sum()
    assert samples[-1].time_s < 11.0
    assert np.nanmax(np.hypot(*(reckoned - true).T)) < 0.05 * way


@pytest.fixture
def study(monkeypatch):
    """The study's own script, where its worker processes find it too."""
    monkeypatch.syspath_prepend(str(ROOT / "bench"))
    return importlib.import_module("target_following")


def test_the_median_interval_covers_as_often_as_it_says(study):
    """Exact: the order statistics of 30 values cover their median in 1 - 2 P(X <= 9) of cases."""
    median_interval, random = study.median_interval, np.random.default_rng(4)
    hits = 0
    for _ in range(2000):
        median, low, high = median_interval(random.exponential(1.0, 30).tolist())
        assert low <= median <= high
        hits += low <= math.log(2) <= high
    exact = 1 - 2 * 0.021387
    assert hits / 2000 == pytest.approx(exact, abs=4 * math.sqrt(exact * (1 - exact) / 2000))
    assert median_interval([3.0, 1.0, 2.0]) == (2.0, 1.0, 3.0)


@pytest.mark.built("tables")
@pytest.mark.nightly
def test_following_beats_walking_at_random_on_fresh_seeds(study):
    """Two of the study's thirty seeds; walks are cut at 30 s, so the ratios are lower bounds."""
    limits_s = {"target-following": 90.0, "random-walk": 30.0}
    summary = study.summary(study.study(list(range(101, 103)), limits_s, 2, "numba", None))
    assert summary["target-following"]["met"] == 2
    assert summary["time_s_ratio"][0] > 3.0
    assert summary["electrical_j_ratio"][0] > 3.0
