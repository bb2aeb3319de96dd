"""How a drive went: lateness of its ticks, faults and outcomes, for people and for JSON."""

import itertools

import numpy as np
import pytest

from undulog.sim.drive.outcome import (
    MUTE,
    DriveEnding,
    FaultKind,
    GateFault,
    GateInput,
    Jitter,
    Outcome,
    jitter,
)

FAULT = GateFault(FaultKind.CURRENT, "joint01: current 3 A", "joint01", 3.0, 1.4, 2.5)
EDGES_MS = (0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100)


def test_lateness_by_numpy():
    assert jitter([]) is None
    late_s = np.array([0.0, 1e-4, 1.1e-4, 2e-3, 0.02, 0.0201, 0.1, 0.2, 9.0])
    lateness = jitter(late_s.tolist())
    assert (lateness.ticks, lateness.worst_s) == (9, 9.0)
    assert lateness.median_s == np.median(late_s)
    assert lateness.p99_s == np.quantile(late_s, 0.99)
    edges = np.array([0, 0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100, np.inf]) * 1e-3
    inside = [
        int(np.sum((late_s <= high) & ((late_s > low) | ((low == 0) & (late_s == 0)))))
        for low, high in itertools.pairwise(edges)
    ]
    assert list(lateness.counts) == inside
    assert list(lateness.to_dict()["counts"])[::10] == ["<= 0.1 ms", "> 100 ms"]


@pytest.mark.parametrize("above_ms", [0.0, 1e-9])
def test_a_tick_at_an_edge_counts_below_it(above_ms):
    lateness = jitter([(edge + above_ms) * 1e-3 for edge in EDGES_MS])
    assert lateness.counts == ((0, *[1] * 10) if above_ms else (*[1] * 10, 0))
    assert (lateness.ticks, len(lateness.counts)) == (10, 11)
    for number, edge in enumerate(EDGES_MS):
        (place,) = np.flatnonzero(jitter([edge * 0.99e-3]).counts)
        assert place == number
    names = [*(f"<= {edge:g} ms" for edge in EDGES_MS), "> 100 ms"]
    assert list(lateness.to_dict()["counts"].items()) == list(
        zip(names, lateness.counts, strict=True)
    )


def test_lateness_in_a_line_and_for_json():
    lateness = Jitter(200, 0.15678, 1.25678, 2.34567, (200, *[0] * 10))
    assert str(lateness) == (
        "ticks were late by 156.78 ms (median), 1256.78 ms (99 %), 2345.67 ms at worst"
    )
    values = lateness.to_dict()
    del values["counts"]
    assert values == {"ticks": 200, "median_s": 0.15678, "p99_s": 1.25678, "worst_s": 2.34567}


def test_faults_and_outcomes_for_json():
    fault = {"kind": "current", "joint": "joint01", "value": 3.0, "limit": 1.4}
    assert FAULT.to_dict() == fault
    bare = GateFault(FaultKind.BUS, "gone")
    assert bare.to_dict() == {"kind": "bus", "joint": None, "value": None, "limit": None}
    assert bare.since_s is None
    assert Outcome(DriveEnding.FAULT, "why", "held", FAULT).to_dict() == {
        "outcome": "fault", "why": "why", "ended": "held", "fault": fault | {"since_s": 2.5},
    }  # fmt: skip
    assert Outcome(DriveEnding.COMPLETE, "", "held").to_dict() == {
        "outcome": "complete", "why": None, "ended": "held", "fault": None,
    }  # fmt: skip


def test_where_nobody_may_listen_or_another_commands_nothing_more_is_sent():
    assert {FaultKind.BUS_OFF, FaultKind.BUS, FaultKind.STRANGER} == MUTE


def test_a_tick_is_well_unless_it_says_otherwise():
    gate_input = GateInput(None, None)
    assert (gate_input.trouble, gate_input.another_robot, gate_input.late_s, gate_input.bounds) == (
        None,
        None,
        0.0,
        None,
    )
    assert (gate_input.received, gate_input.expected) == (True, True)
