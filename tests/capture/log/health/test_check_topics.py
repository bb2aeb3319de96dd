"""`undulog log check` of joints on other topics than those of the log contract."""

import pytest

from support.ros_bags import Filler, answered, commanded, ticks, write_bag

pytestmark = pytest.mark.slow

CHOSEN = ("--command-topic", "/arm/goal", "--response-topic", "/arm/encoders")


@pytest.fixture
def bag(tmp_path):
    """An arm whose middle joint freezes from 4 to 8 s, beside joint states that follow."""

    def fill(bag):
        fill = Filler(bag)
        for t_ns, t_s in ticks(12.0):
            fill.state(t_ns, t_s, "/arm/goal", commanded(t_s))
            angles = answered(t_s)
            if 4.0 <= t_s < 8.0:
                angles[1] = 0.1
            fill.state(t_ns, t_s, "/arm/encoders", angles)
            fill.state(t_ns, t_s)

    return write_bag(tmp_path / "arm", fill)


def frozen(report, topic):
    return {
        joint["name"]: joint["frozen_s"] for joint in report["joints"] if joint["topic"] == topic
    }


def test_the_chosen_topics_are_those_that_are_judged(bag, report_of):
    report = report_of("log", "check", bag, *CHOSEN)
    assert frozen(report, "/arm/encoders") == {"front_yaw": 0, "mid_yaw": 4, "rear_yaw": 0}
    following, still = report["reasons"]
    assert following.startswith("mid_yaw from 4 s to 8 s stands still while its command moves")
    assert still == "/arm/encoders, mid_yaw: frozen for 4 s while its command moved, at 4.000 s"


def test_by_default_the_topics_of_the_contract_are(bag, report_of):
    report = report_of("log", "check", bag)
    assert not any("mid_yaw" in reason for reason in report["reasons"])
    assert set(frozen(report, "/arm/encoders").values()) == {None}


def test_the_one_that_is_not_chosen_is_found_by_type(bag, report_of):
    report = report_of("log", "check", bag, "--response-topic", "/arm/encoders")
    assert frozen(report, "/arm/encoders")["mid_yaw"] == 4


def test_several_bags_are_judged_by_the_chosen_topics(bag, command):
    lines = command("log", "check", bag, bag.parent / "none.mcap", *CHOSEN, code=1).out.splitlines()
    assert "degraded" in lines[1]
    assert "mid_yaw" in lines[1]


def test_a_topic_that_is_not_there_is_refused(bag, command):
    err = command("log", "check", bag, "--response-topic", "/none", code=1).err
    assert "/none" in err
    assert "choose with --command-topic and --response-topic" in err
    err = command("log", "check", bag, "--contract", *CHOSEN, code=2).err
    assert "--contract checks all topics" in err
