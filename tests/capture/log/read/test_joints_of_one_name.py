"""Several joints of one name in a message: each is read, and whoever reads is told."""

import numpy as np
import pytest

from support.analysed import analysed
from support.ros_bags import TRAJECTORY, filling, header, message, point, write_bag
from support.written_sessions import EPOCH_NS, joint_state, write_foreign
from undulog.capture import Session
from undulog.capture.exchange.formats.rosbag.importing import import_bag
from undulog.capture.log.columns.names import (
    distinct_names,
    one_name_sentences,
    several_of_one_name,
)
from undulog.capture.log.health.contract import check_contract
from undulog.capture.log.health.session_check import check_session

NAMES = ("yaw1", "yaw2", "yaw3", "yaw3", "yaw5", "yaw6")
READ = ("yaw1", "yaw2", "yaw3", "yaw3 (2)", "yaw5", "yaw6")
ALL_APART = (*READ[:3], "yaw4", *READ[4:])
SENTENCE = "2 joints are named yaw3: the second is read as yaw3 (2)"
GAINS = np.array([0.9, 0.9, 0.9, 0.7, 0.9, 0.9])


def write(path, names=NAMES, commanded=NAMES, count=600):
    """Six joints in a wave, the fourth weaker, at 50 Hz."""
    messages = []
    rng = np.random.default_rng(6)
    for k in range(count):
        t_ns, turn = EPOCH_NS + k * 20_000_000, 0.1 * k - 0.6 * np.arange(6)
        states = GAINS * 0.4 * np.sin(turn - 0.2) + 1e-3 * rng.normal(size=6)
        for topic, joint_names, values in (
            ("/joint_commands", commanded, 0.4 * np.sin(turn)),
            ("/joint_states", names, states),
        ):
            content = joint_state(t_ns, list(joint_names), position=values.tolist())
            messages.append((topic, t_ns, content))
    write_foreign(path, messages)
    return path


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        ((), ()),
        (("a", "b"), ("a", "b")),
        (("a", "a", "b", "a"), ("a", "a (2)", "b", "a (3)")),
        (("a", "a", "a (2)"), ("a", "a (3)", "a (2)")),
        (("a (2)", "a", "a", "a (2)"), ("a (2)", "a", "a (3)", "a (2) (2)")),
        (("", ""), ("", " (2)")),
    ],
)
def test_no_two_names_are_alike_and_the_first_of_each_stays(names, expected):
    assert distinct_names(names) == expected


def test_ten_thousand_joints_of_one_name_have_ten_thousand_names():
    names = distinct_names(["a"] * 10_000)
    assert len(set(names)) == 10_000
    assert names[-1] == "a (10000)"


def test_only_numbered_names_are_further_joints():
    assert several_of_one_name(("a", "a (2)", "a (3)", "b (2)", "a (x)")) == {
        "a": ["a (2)", "a (3)"]
    }
    assert one_name_sentences([("a", "b")]) == []
    assert one_name_sentences([READ, READ]) == [SENTENCE]
    assert one_name_sentences([("a", "a (2)", "a (3)")]) == [
        "3 joints are named a: the others are read as a (2), a (3)"
    ]


def test_the_values_of_each_joint_are_read_and_the_session_warns(tmp_path):
    with Session.open(write(tmp_path / "run.mcap")) as session:
        signals = session.joints("/joint_commands")
        assert signals.names == READ
        turn = 0.1 * np.arange(600)
        for k, values in enumerate(signals.values):
            assert values == pytest.approx(0.4 * np.sin(turn - 0.6 * k))
        assert f"/joint_commands: {SENTENCE}" in session.warnings


def test_the_weak_joint_of_the_two_is_named(tmp_path):
    result = analysed(write(tmp_path / "run.mcap"))
    gains = {joint.name: joint.gain.value for joint in result.joints}
    assert gains == pytest.approx(dict(zip(READ, GAINS, strict=True)), abs=2e-3)
    assert f"/joint_states: {SENTENCE}" in result.warnings
    assert result.answer.sentence.startswith("yaw3 (2) ")


@pytest.mark.parametrize(
    ("names", "commanded", "topics"),
    [
        (NAMES, NAMES, "/joint_commands and /joint_states, each"),
        (NAMES, ALL_APART, "/joint_states"),
    ],
)
def test_the_check_and_the_contract_find_it(tmp_path, names, commanded, topics):
    path = write(tmp_path / "run.mcap", names, commanded)
    health = check_session(path)
    assert health.verdict == "degraded"
    (finding,) = [finding for finding in health.findings if "are named" in finding.sentence]
    assert finding.sentence == f"{topics}: {SENTENCE}; give each its name"
    named = [v for v in check_contract(path) if v.found == "yaw3 more than once"]
    assert [v.where for v in named] == [
        f"{topic}: name" for topic in ("/joint_commands", "/joint_states") if topic in topics
    ]


def test_a_log_of_distinct_names_is_good(tmp_path):
    health = check_session(write(tmp_path / "run.mcap", ALL_APART, ALL_APART))
    assert not [finding for finding in health.findings if "are named" in finding.sentence]


def test_the_points_of_a_trajectory_keep_both_joints(tmp_path):
    def fill(bag):
        sample = message(
            bag.store,
            TRAJECTORY,
            header=header(bag.store, EPOCH_NS),
            joint_names=["a", "a"],
            points=[point(bag.store, np.array([0.1, 0.2]), 10**8)],
        )
        bag.write("/goal", EPOCH_NS, sample)

    with Session.open(write_bag(tmp_path / "bag", fill)) as session:
        signals = session.joints("/goal")
        assert signals.names == ("a", "a (2)")
        assert [values.tolist() for values in signals.values] == [[0.1], [0.2]]


def test_an_import_keeps_both_joints_and_reports_them(tmp_path):
    def fill(log, t_ns, t_s):
        for topic in ("/joint_states", "/joint_commands"):
            log.state(t_ns, t_s, topic, [0.1, 0.2, 0.3], ("a", "b", "b"))

    bag = write_bag(tmp_path / "bag", filling(fill, 0.2))
    report = import_bag(bag, tmp_path / "run.mcap")
    sentence = "2 joints are named b: the second is read as b (2)"
    assert f"/joint_states: {sentence}" in report.problems
    with Session.open(tmp_path / "run.mcap") as session:
        signals = session.joints("/joint_states")
        assert signals.names == ("a", "b", "b (2)")
        assert [values[0] for values in signals.values] == [0.1, 0.2, 0.3]
