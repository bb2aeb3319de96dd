"""Ground contact from the torques of joints: loads that are known, and runs of the twin."""

import json

import contact_tables
import numpy as np
import pytest

from undulog.analysis.parts.body.travel import GRAVITY
from undulog.analysis.parts.ground_contact.measure import TOUCHES, link_loads, means_between
from undulog.analysis.parts.ground_contact.result import TWIN_ACCURACY
from undulog.capture.log.write.writer import SessionWriter
from undulog.capture.robot.description import load_robot
from undulog.capture.robot.model import Plane
from undulog.sim import run_batch

ROBOT = load_robot("snake13")
WEIGHT = GRAVITY * ROBOT.links[0].mass
LENGTH = ROBOT.links[0].length
UP = np.array([[0.0, 0.0, 1.0]])


def beam_torques(loads):
    """Torques of a straight level chain, by moments of the links behind each joint."""
    net = np.asarray(loads) - WEIGHT
    arms = LENGTH * (np.arange(13)[None] - np.arange(12)[:, None] - 0.5)
    # What is behind a joint is at -x; a force up there turns it about +y by arm times force.
    moments = np.where(arms > 0, arms * net, 0.0).sum(axis=1)
    pitch = np.array([joint.plane is Plane.VERTICAL for joint in ROBOT.joints])
    return np.where(pitch, -moments, 0.0)[None]


def test_a_straight_chain_at_rest_is_on_the_ground_everywhere():
    loads, misfit = link_loads(ROBOT, np.zeros((1, 12)), np.zeros((1, 12)), UP)
    assert loads[0] == pytest.approx(np.ones(13), abs=0.05)
    assert misfit < 0.1


@pytest.mark.parametrize("pair", [(1, 11), (3, 9), (5, 7)])
def test_a_bridge_rests_on_its_two_ends(pair):
    true = np.zeros(13)
    true[list(pair)] = 13 / 2
    loads, _ = link_loads(ROBOT, np.zeros((1, 12)), beam_torques(WEIGHT * true), UP)
    near = np.abs(np.arange(13)[:, None] - np.array(pair)).min(axis=1) <= 1
    assert loads[0, near].sum() > 0.9 * 13
    assert not np.any(loads[0, ~near] >= TOUCHES)


def test_the_answer_is_the_same_for_a_robot_that_is_rolled_over():
    """Head frame upside down: gravity along its z axis, torques of the other sign."""
    true = np.zeros(13)
    true[[3, 9]] = 13 / 2
    torques = beam_torques(WEIGHT * true)
    upright, _ = link_loads(ROBOT, np.zeros((1, 12)), torques, UP)
    rolled, _ = link_loads(ROBOT, np.zeros((1, 12)), -torques, -UP)
    np.testing.assert_allclose(upright, rolled, atol=1e-9)


def test_torques_that_no_weight_makes_do_not_fit():
    torques = 20 * WEIGHT * LENGTH * np.resize([1.0, -1.0], (1, 12))
    assert link_loads(ROBOT, np.zeros((1, 12)), torques, UP)[1] > 2


def test_means_are_those_of_straight_lines_between_samples():
    t = np.array([0.0, 0.3, 1.0, 2.5])
    edges = np.array([0.1, 0.6, 0.7, 2.0])
    means = means_between(t, 3 * t - 1, edges)
    np.testing.assert_allclose(means, 3 * (edges[1:] + edges[:-1]) / 2 - 1)


@pytest.mark.built("tables")
@pytest.mark.nightly
@pytest.mark.parametrize("name", contact_tables.LIFTING)
def test_contact_in_the_twin_is_right_as_often_as_stated(name):
    """Of runs that the scales were not chosen by."""
    _, effort, current = contact_tables.accuracy(name, [2], 1)
    low, high = TWIN_ACCURACY
    assert low - 0.03 < effort < high + 0.03
    assert current > low - 0.06


@pytest.mark.nightly
def test_a_session_of_the_twin_states_its_contact_and_how_often_that_is_right(tmp_path, command):
    path = tmp_path / "s.mcap"
    command("sim", "run", "snake13-vertical-pi2", "--duration", "16", "-o", path)
    contact = json.loads(command("analyse", path, "--json").out)["ground_contact"]
    assert contact["source"] == "effort"
    assert contact["twin_accuracy"] == list(TWIN_ACCURACY)
    assert len(contact["links"]) == 13
    shares = [link["share"] for link in contact["links"]]
    assert 0.2 < np.mean(shares) < 0.5
    assert all(link["share_ci95"][0] <= link["share"] for link in contact["links"])
    np.testing.assert_allclose([np.mean(link["by_phase"]) for link in contact["links"]], shares)
    assert "chance: 50 %" in " ".join(command("analyse", path).out.split())


@pytest.mark.nightly
def test_efforts_of_another_sign_or_unit_give_no_contact(tmp_path, command):
    random = np.random.default_rng(4)
    (run,) = run_batch([contact_tables.varied("snake13-vertical-pi2", random)[0]])

    def result(effort):
        path = tmp_path / "s.mcap"
        with SessionWriter(path, session_id="s", epoch_ns=0, robot=ROBOT, force=True) as writer:
            names = ROBOT.joint_names
            states = writer.joint_state("/joint_states", names, unit="rad", effort=True)
            head = writer.odometry("/odom", frame="world", child=ROBOT.links[0].name)
            for k in range(800, len(run.angle)):
                t_ns = k * 10_000_000
                states.write(t_ns, run.angle[k], effort=effort[k])
                pose = run.head[k], run.head_quaternion[k]
                head.write(t_ns, *pose, run.head_velocity[k], run.head_spin[k])
        return json.loads(command("analyse", path, "--json").out)

    assert result(run.effort)["ground_contact"]["source"] == "effort"
    for factor, why in ((-1.0, ["the other sign"]), (100.0, ["no loads of links"]), (0.0, [])):
        measured = result(factor * run.effort)
        assert measured["ground_contact"] is None
        notes = [note for note in measured["notes"] if "no ground contact" in note]
        assert len(notes) == len(why)
        assert all(part in note for part, note in zip(why, notes, strict=True))
