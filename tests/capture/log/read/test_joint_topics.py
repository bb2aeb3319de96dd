"""Which topics of a log are taken, for each combination of names and types."""

from contextlib import suppress

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from support.analysed import analysed
from support.ros_bags import ARRAY, EPOCH_NS, NAMES, commanded, filling, message, ticks, write_bag
from undulog.capture import Session
from undulog.capture.common.errors import DataError, MissingChannelError
from undulog.capture.log.read.joint_messages import JointTrajectory, joint_source, points_in_force


def opened(tmp_path, fill):
    return Session.open(write_bag(tmp_path / "bag", filling(fill, 0.2)))


def test_the_names_of_the_contract_come_first(tmp_path):
    def fill(log, *tick):
        log.state(*tick)
        log.state(*tick, "/joint_commands")
        log.controller(*tick)

    with opened(tmp_path, fill) as session:
        topics = session.joint_topics()
        assert (topics.command, topics.response) == ("/joint_commands", "/joint_states")
        assert topics.notes == ()
        assert session.with_joints() is session
        # By the option, the controller; the responses stay.
        topics = session.joint_topics("/arm/controller_state")
        assert topics.command == "/arm/controller_state.reference"
        assert topics.response == "/joint_states"


def test_commands_are_those_of_the_same_joints(tmp_path):
    """A gripper's controller has more messages than that of the arm, and none of its joints."""

    def fill(log, *tick):
        log.state(*tick)
        log.controller(*tick, "/arm/controller_state")
        for step in (0, 1):
            log.state(tick[0] + step, 0.0, "/gripper/joint_commands", [0.0], ["finger"])

    with opened(tmp_path, fill) as session:
        topics = session.joint_topics()
        assert topics.command == "/arm/controller_state.reference"
        assert topics.response == "/joint_states"


def test_states_of_other_joints_give_way_to_those_of_the_controller(tmp_path):
    def fill(log, *tick):
        log.controller(*tick)
        log.state(*tick, positions=[0.0], names=["finger"])

    with opened(tmp_path, fill) as session:
        assert session.joint_topics().response == "/arm/controller_state.feedback"
        assert session.with_joints().joints("/joint_states").names == NAMES


def test_states_that_could_be_either_are_not_taken(tmp_path):
    def fill(log, *tick):
        log.state(*tick, "/left")
        log.state(*tick, "/right")

    with opened(tmp_path, fill) as session:
        topics = session.joint_topics()
        assert (topics.command, topics.response) == ("/joint_commands", "/joint_states")
        assert topics.others == ("/left", "/right")
        with pytest.raises(MissingChannelError, match="choose with --command-topic"):
            session.joint_topics(response="/none")


LACKING = (
    "/forward/commands, std_msgs/msg/Float64MultiArray, has 4 values without names: name its "
    "joints in their order, --command-topic /forward/commands:JOINT,JOINT,..."
)


def arrays(kind=ARRAY, width=3, topic="/forward/commands", names=NAMES):
    """States of three joints, and commands without names."""

    def fill(log, t_ns, t_s):
        log.state(t_ns, t_s, names=names)
        data = np.resize(commanded(t_s), width).astype("f4" if "32" in kind else "f8")
        log.bag.write(topic, t_ns, message(log.bag.store, kind, data=data))

    return fill


@pytest.mark.parametrize("kind", [ARRAY, "std_msgs/msg/Float32MultiArray"])
def test_an_array_has_the_joints_of_the_states_if_they_are_as_many(tmp_path, kind):
    with opened(tmp_path, arrays(kind)) as session:
        topics = session.joint_topics()
        name = f"/forward/commands:{','.join(NAMES)}"
        assert (topics.command, topics.response) == (name, "/joint_states")
        assert topics.notes[1] == (
            "/forward/commands names no joints: those of /joint_states are taken in their order "
            "(others: --command-topic /forward/commands:JOINT,JOINT,...)"
        )
        assert session.joint_topics("/forward/commands").command == name
        assert topics.notes[1] in session.joint_topics("/forward/commands").notes
        signals = session.with_joints().joints("/joint_commands")
        assert signals.names == NAMES
        expected = [commanded(t_s) for _, t_s in ticks(0.2)]
        assert np.stack(signals.values, axis=1) == pytest.approx(np.array(expected), abs=1e-7)
        other = session.joint_topics("/forward/commands:c,b,a")
        assert (other.command, other.notes) == ("/forward/commands:c,b,a", ())


def test_an_array_has_the_joints_of_the_robot_before_those_of_the_states(tmp_path):
    with opened(tmp_path, arrays(names=NAMES[::-1])) as session:
        path = session.path
    from undulog import run

    robot = tmp_path / "robot.toml"
    assert run(["robot", "new", "-o", str(robot), "--from", str(path)]) == 0
    with Session.open(path, robot=robot) as session:
        topics = session.joint_topics()
        joints = session.robot.joint_names
        assert set(joints) == set(NAMES)
        assert topics.command == f"/forward/commands:{','.join(joints)}"
        assert not [note for note in topics.notes if "names no joints" in note]


@pytest.mark.parametrize(
    ("fill", "unnamed"),
    [
        (
            arrays(width=4),
            (LACKING,),
        ),
        (arrays(names=("a", "b,c", "d")), None),
        (arrays(topic="/velocity_controller/commands"), ()),
        (arrays(topic="/forward/values"), ()),
    ],
)
def test_an_array_whose_joints_are_unknown_is_not_guessed(tmp_path, fill, unnamed):
    with opened(tmp_path, fill) as session:
        topics = session.joint_topics()
        assert topics.command == "/joint_commands"
        assert len(topics.unnamed) == 1 if unnamed is None else topics.unnamed == unnamed


def test_an_array_that_was_chosen_without_its_joints_is_refused_with_the_option(tmp_path):
    with (
        opened(tmp_path, arrays(width=4)) as session,
        pytest.raises(DataError, match=r"has 4 values without names: name its joints in their or"),
    ):
        session.joint_topics("/forward/commands")


def test_the_answer_names_the_array_and_the_option(tmp_path):
    named = analysed(write_bag(tmp_path / "named", filling(arrays())))
    gains = [joint.gain.value for joint in named.joints]
    assert gains == pytest.approx([0.95, 0.9, 0.85], abs=2e-3)
    result = analysed(write_bag(tmp_path / "bag", filling(arrays(width=4))))
    assert result.answer.sentence == f"No commands of named joints: {LACKING}"


def test_names_without_joints_are_refused(tmp_path):
    def fill(log, *tick):
        log.state(*tick)
        log.bag.write("/word", tick[0], message(log.bag.store, "std_msgs/msg/String", data="x"))

    with opened(tmp_path, fill) as session:
        with pytest.raises(DataError, match="/word is std_msgs/msg/String, not of joints"):
            session.joints("/word")
        with pytest.raises(DataError, match="names its joints itself"):
            session.joints("/joint_states:a,b,c")
        with pytest.raises(DataError, match="no part 'position'"):
            session.joints("/joint_states.position")
        assert session.joint_channel("/none.reference") is None


@given(st.text(max_size=12), st.sampled_from(["", ".", ":", ".a:b", ":a,b", "..", "::"]))
def test_any_name_is_read_or_refused(text, end):
    channels = {"/a": 0, "/a.b": 0, text: 0}
    with suppress(DataError):  # names of joints that are empty, or twice there
        source = joint_source("/a" + text + end, channels)
        assert source is None or source.topic in channels


@given(
    st.lists(
        st.tuples(
            st.integers(0, 100), st.lists(st.integers(0, 30), min_size=1, max_size=5).map(sorted)
        ),
        min_size=1,
        max_size=8,
    )
)
def test_a_later_trajectory_replaces_what_is_not_yet_due(drawn):
    every = [
        JointTrajectory(
            t, 0, ("a",), np.array(after), {"position": np.full((len(after), 1), float(k))}
        )
        for k, (t, after) in enumerate(sorted(drawn, key=lambda pair: pair[0]))
    ]
    (column,), replaced = points_in_force(every, "position", 0)
    _, t_ns, values = column
    assert len(t_ns) + replaced == sum(len(trajectory.after_ns) for trajectory in every)
    # Point by point: it is in force if every later trajectory begins after it.
    expected = [
        (trajectory.log_ns + after, float(k))
        for k, trajectory in enumerate(every)
        for after in trajectory.after_ns.tolist()
        if all(
            later.log_ns + later.after_ns[0] > trajectory.log_ns + after for later in every[k + 1 :]
        )
    ]
    assert sorted(zip(t_ns.tolist(), values[:, 0].tolist(), strict=True)) == sorted(expected)


def test_stamps_of_trajectories_are_on_the_clock_of_the_log(tmp_path):
    def fill(log, *tick):
        log.state(*tick)
        log.trajectory(*tick, "/stamped")
        log.trajectory(*tick, "/unstamped", stamped=False)

    with opened(tmp_path, fill) as session:
        for topic in ("/stamped", "/unstamped"):
            assert session.joints(topic).t_ns[0][0] == EPOCH_NS + 10**8
        window = session.joints("/stamped", start_ns=EPOCH_NS + 2 * 10**8)
        assert len(window.t_ns[0]) == 10


def two_snakes(log, *tick):
    """Two robots of the same joints; the commands of b and the states of a have most messages."""
    for space, commands, states in (("/a", 1, 2), ("/b", 2, 1)):
        for step in range(commands):
            log.state(tick[0] + step, tick[1], f"{space}/joint_commands")
        for step in range(states):
            log.state(tick[0] + step, tick[1], f"{space}/joint_states")


def test_the_commands_of_one_robot_are_never_paired_with_the_states_of_another(tmp_path):
    with opened(tmp_path, two_snakes) as session:
        topics = session.joint_topics()
        pairs = {(f"/{x}/joint_commands", f"/{x}/joint_states") for x in "ab"}
        assert {*topics.robots} == pairs
        assert not topics.renamed
        for command, response in pairs:
            assert session.joint_topics(command).response == response
            assert session.joint_topics(response=response).command == command


def test_an_analysis_of_two_robots_asks_which_one(tmp_path, command):
    with opened(tmp_path, two_snakes) as session:
        path = session.path
    err = command("analyse", path, code=1).err
    assert "2 robots with joints of the same names" in err
    assert "--command-topic /a/joint_commands --response-topic /a/joint_states" in err
    assert "--command-topic /b/joint_commands --response-topic /b/joint_states" in err
