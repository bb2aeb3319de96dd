"""Faults as text and as TOML: strict both ways, and the same fault either way."""

import dataclasses
import math
import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from support.twin_runs import SNAKE25, check_keys, faults_of
from undulog.capture import load_robot
from undulog.capture.common.errors import UsageError
from undulog.sim import load_scenario, parse_scenario, record
from undulog.sim.scenario.bus_faults import BusFault, BusFaultKind, parse_faults

ROBOT = load_robot("snake25")
BASE = SNAKE25.replace("2.0", "0.1")


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("lost:joint07:0.1", BusFault(BusFaultKind.LOST, "joint07", 0.1)),
        ("lost:1", BusFault(BusFaultKind.LOST, "", 1.0)),
        ("lost:0.5@2", BusFault(BusFaultKind.LOST, "", 0.5, 2.0)),
        ("stuck:joint01@5", BusFault(BusFaultKind.STUCK, "joint01", 0.0, 5.0)),
        ("frozen:joint25@5+2.5", BusFault(BusFaultKind.FROZEN, "joint25", 0.0, 5.0, 2.5)),
        ("over-current:joint07:1.5@5", BusFault(BusFaultKind.OVER_CURRENT, "joint07", 1.5, 5.0)),
        ("bus-off@5+2", BusFault(BusFaultKind.BUS_OFF, "", 0.0, 5.0, 2.0)),
        ("noise:1e-3", BusFault(BusFaultKind.NOISE, "", 0.001)),
        ("delay:0.02", BusFault(BusFaultKind.DELAY, "", 0.02)),
    ],
)
def test_faults_on_the_command_line(text, fault):
    assert parse_faults([text], ROBOT) == (fault,)


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("lsot:0.1", "did you mean lost?"),
        ("", "no fault ''"),
        ("lost", "'' is not a probability up to 1"),
        ("lost:2", "2 is not a probability, above 0 and up to 1"),
        ("lost:0", "0 is not a probability"),
        ("lost:nan", "'nan' is not a probability"),
        ("lost:jiont07:0.1", "did you mean joint07?"),
        ("lost:joint07:0.1:3", "3 is too much for lost"),
        ("stuck", "expected a joint"),
        ("over-current:1.5", "expected a joint"),
        ("over-current:joint07", "'' is not a current in A up to 100"),
        ("stuck:joint07:0.1", "0.1 is too much for stuck"),
        ("bus-off:joint07", "joint07 is too much for bus-off"),
        ("noise:0.95", "above 0 and up to 0.9"),
        ("delay:x", "'x' is not a time in s up to 10"),
        ("bus-off@x", "'x' is not a time in s"),
        ("bus-off@-1", "-1 is not a time in s after the start"),
        ("bus-off@1+2+3", "expected KIND[:JOINT][:NUMBER][@FROM[+FOR]]"),
        ("bus-off@1@2", "expected KIND"),
        ("bus-off@", "'' is not a time in s"),
    ],
)
def test_what_is_no_fault_is_refused_with_what_would_be(text, why):
    with pytest.raises(UsageError, match=re.escape(why)):
        parse_faults([text], ROBOT)


numbers = st.floats(1e-3, 0.9)


@pytest.mark.slow
@given(
    st.lists(
        st.builds(
            lambda kind, joint, value, from_s, for_s: BusFault(
                kind,
                joint if kind in ("stuck", "frozen", "over-current") else "",
                value if kind in ("lost", "over-current", "noise", "delay") else 0.0,
                from_s,
                for_s,
            ),
            st.sampled_from(BusFaultKind),
            st.sampled_from(ROBOT.joint_names),
            numbers,
            st.one_of(st.just(0.0), numbers),
            st.one_of(st.just(math.inf), numbers),
        ),
        max_size=4,
    )
)
def test_a_scenario_with_faults_is_read_as_it_is_written(faults):
    scenario = dataclasses.replace(parse_scenario(BASE, "x.toml"), faults=tuple(faults))
    again = parse_scenario(scenario.toml(), "x.toml")
    assert (again.faults, again.session_id) == (scenario.faults, scenario.session_id)


def test_all_faults_of_a_scenarios_faults_are_reported_at_once():
    text = """
[[faults]]
kind = "lost"
joint = "jiont07"
value = 1.5
[[faults]]
kind = "bus-off"
joint = "joint07"
for_s = 0
[[faults]]
kind = "stuck"
value = 1
from_s = -1
[[faults]]
kind = "lsot"
[[faults]]
kind = "noise"
value = 0.1
until_s = 3
"""
    faults = faults_of(BASE + text)
    check_keys(
        faults,
        "faults[0].joint faults[0].value faults[1].joint faults[1].for_s faults[2].joint "
        "faults[2].value faults[2].from_s faults[3].kind faults[4].until_s",
    )
    assert "did you mean joint07?" in faults["faults[0].joint"]
    assert "leave it out: bus-off is of the whole bus" in faults["faults[1].joint"]
    assert "leave it out: stuck has no number" in faults["faults[2].value"]


def test_a_run_without_a_bus_says_that_it_has_no_faults_of_one(tmp_path, opened):
    scenario = parse_scenario(BASE + '[[faults]]\nkind = "noise"\nvalue = 0.1\n', "noisy.toml")
    plain = load_scenario("flat").changed(duration_s=0.05)
    logs = {}
    for variant in (scenario, plain):
        path = tmp_path / f"{variant.name}.mcap"
        record(variant, path)
        logs[variant.name] = [message.msg for _, message in opened(path).messages("/rosout")]
    assert "the scenario's faults are those of a bus, which this run does not have" in logs["noisy"]
    assert not any("fault" in text for text in logs["flat"])
