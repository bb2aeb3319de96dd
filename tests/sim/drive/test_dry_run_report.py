"""What a dry run says, from demands that are given: for people, and for JSON."""

import math
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from undulog.sim.drive.dry_run import DryRun, DryRunVerdict, joint_table, reported, summary_lines
from undulog.sim.drive.dry_run_gait import JointDemand
from undulog.sim.drive.outcome import FaultKind, GateEvent, GateFault

WIDE = 10_000
NAN = math.nan


def demand(name="joint01", **more):
    values = {
        "lower": -0.5, "upper": 0.7, "least": -0.2, "greatest": 0.3, "rate": 1.0, "max_rate": 4.0,
        "acceleration": 20.0, "torque_peak": 0.6, "torque_rms": 0.25, "stall_torque": 1.5,
        "current_peak": 0.35, "max_current": 1.4, "tracking_error": 0.05,
        "max_tracking_error": 0.25, "energy_net_j": 0.5, "energy_abs_j": 0.75, "energy_el_j": 2.0,
        "clamped": 0.0,
    }  # fmt: skip
    return JointDemand(name=name, **(values | more))


SECOND = demand("joint02", least=-0.45, greatest=0.1, energy_net_j=-0.125, clamped=0.25)
FAULT = GateFault(FaultKind.TRACKING, "joint02: too far", "joint02", 0.3, 0.25, 1.0)


def dry(**more):
    driven = SimpleNamespace(name="wave.mcap", kind="commands")
    scenario = SimpleNamespace(robot=SimpleNamespace(name="short"), name="nominal", duration_s=8.0)
    values = {
        "driven": driven, "scenario": scenario, "duration_s": 4.0, "joints": (demand(), SECOND),
        "first_pose": np.array([0.1, -0.4]), "approach_s": 1.25, "cut": (), "missing": (),
        "fault": None, "started": True, "complete": True, "remarks": (),
    }  # fmt: skip
    return DryRun(**(values | more))


def test_shares_are_of_the_limits():
    joint = demand()
    assert joint.margin == pytest.approx(0.3)  # -0.2 above -0.5
    shares = {limit.name: limit.share for limit in joint.demands}
    assert shares == pytest.approx(
        {"range": 0.3 / 0.6, "rate": 0.25, "tracking error": 0.2, "current": 0.25, "torque": 0.4}
    )
    assert demand(greatest=0.6).margin == pytest.approx(0.1)
    beyond = demand(greatest=0.8)
    assert (beyond.margin, beyond.demands[0].share) == pytest.approx((-0.1, 0.7 / 0.6))


@pytest.mark.parametrize(
    ("more", "verdict", "fits"),
    [
        ({"joints": (demand(),)}, DryRunVerdict.RUNS, True),
        ({}, DryRunVerdict.CLAMPED, True),
        ({"joints": (demand(),), "cut": ("joint01",)}, DryRunVerdict.CLAMPED, True),
        ({"complete": False}, DryRunVerdict.UNFINISHED, False),
        ({"complete": False, "fault": FAULT}, DryRunVerdict.STOPS, False),
        (
            {"complete": False, "fault": FAULT, "missing": ("max_rate",)},
            DryRunVerdict.REFUSED,
            False,
        ),
    ],
)
def test_the_verdict_is_the_worst_that_is_true(more, verdict, fits):
    run = dry(**more)
    assert (run.verdict, run.verdict.fit) == (verdict, fits)
    assert (reported(run)["verdict"], reported(run)["would_run"]) == (str(verdict), fits)


def test_the_closest_limit_is_of_all_joints_and_of_those_that_are_known():
    joint, limit = dry().closest
    assert (joint, limit.name, limit.share) == ("joint02", "range", pytest.approx(0.55 / 0.6))
    unknown = demand("joint03", tracking_error=NAN, current_peak=9.0, max_current=NAN)
    joint, limit = dry(joints=(demand(), unknown)).closest
    assert (joint, limit.name) == ("joint01", "range")
    assert dry(joints=()).closest is None


def test_lines_of_a_run_that_is_clamped():
    lines = list(summary_lines(dry(cut=("horizontal.A",)), WIDE))
    assert lines[0] == (
        "wave.mcap on short would run, clamped: joint02 25% of the time; cut to the joint limits: "
        "horizontal.A; closest to a limit: joint02, range 31.5 of 34.4 ° (92%)"
    )
    assert lines[1] == (
        "commands in the twin of short in nominal, 4 s; nothing was sent, and no bus opened"
    )
    assert lines[2] == (
        "first pose: joint02 farthest, at -22.9°; a ramp of 1.25 s from straight joints"
    )
    assert lines[3] == (
        "energy: mechanical 0.375 J net and 1.5 J absolute, electrical 4 J; mean power 0.0938 W "
        "and 1 W"
    )
    assert lines[4] == ""
    lines = list(summary_lines(dry(path=Path("dry.mcap")), WIDE))
    assert lines[4:6] == ["session of the twin: dry.mcap", ""]
    many = tuple(demand(f"joint{k}", clamped=0.5) for k in range(5))
    first = next(summary_lines(dry(joints=many), WIDE))
    shown = ", ".join(f"joint{k} 50% of the time" for k in range(3))
    assert f"clamped: {shown} and 2 more; closest" in first


@pytest.mark.parametrize(
    ("more", "first"),
    [
        ({"joints": (demand(),)}, "would run as it is; closest to a limit: joint01, range "),
        ({"fault": FAULT}, "would stop at 4.00 s: joint02: too far"),
        ({"fault": FAULT, "started": False}, "would stop on the way to the first pose: joint02: "),
        ({"complete": False}, ": not known, the dry run was stopped at 4 s of 8 s; closest to "),
        ({"missing": ("max_rate", "max_current")}, "not start: short lacks the limits max_rate, m"),
    ],
)
def test_the_first_line_is_the_answer(more, first):
    lines = list(summary_lines(dry(**more), WIDE))
    assert lines[0].startswith("wave.mcap on short")
    assert first in lines[0]
    if "missing" in more:
        assert lines[1].startswith("Its description needs this")
        assert lines[2] == "  [safety]"
        assert [line.split()[0] for line in lines[3:5]] == ["max_rate", "max_current"]
        assert lines[5].startswith("commands in the twin")


def test_without_limits_there_is_no_closest_one():
    none = dict.fromkeys(("max_rate", "max_current", "max_tracking_error", "stall_torque"), NAN)
    free = demand(lower=-math.inf, upper=math.inf, **none)
    assert next(summary_lines(dry(joints=(free, free)), WIDE)) == (
        "wave.mcap on short would run as it is; it has no limits to come close to"
    )


@pytest.mark.parametrize(
    ("unit", "more", "shown"),
    [
        ("rate", {"rate": 3.8}, "rate 218 of 229 °/s (95%)"),
        ("tracking error", {"tracking_error": 0.24}, "tracking error 13.8 of 14.3 ° (96%)"),
        ("current", {"current_peak": 1.4}, "current 1.4 of 1.4 A (100%)"),
        ("torque", {"torque_peak": 1.8}, "torque 1.8 of 1.5 N m (120%)"),
    ],
)
def test_the_closest_limit_has_the_units_of_people(unit, more, shown):
    first = next(summary_lines(dry(joints=(demand(**more),)), WIDE))
    assert f"closest to a limit: joint01, {shown}" in first
    assert unit in shown


def test_some_of_many_remarks_are_shown():
    def lines_of(count):
        remarks = [GateEvent("warn", f"gate: {k}") for k in range(count)]
        remarks.insert(1, GateEvent("info", "gate: run"))
        return [line for line in summary_lines(dry(remarks=tuple(remarks)), WIDE) if "  " in line]

    assert lines_of(6)[:6] == [f"  gate: {k}" for k in range(6)]
    assert "more of this kind" not in lines_of(6)[6]
    assert lines_of(8)[:7] == [
        *(f"  gate: {k}" for k in range(6)), "  and 2 more of this kind; --json has all",
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("more", "line"),
    [
        ({"first_pose": np.array([NAN, NAN])}, "first pose: not known"),
        ({"first_pose": np.array([0.1, NAN])}, "first pose: not known"),
        ({"approach_s": 0.0}, "first pose: straight joints"),
        (
            {"first_pose": np.array([0.2, 0.1]), "approach_s": NAN},
            "first pose: joint01 farthest, at 11.5°; no ramp_rate gives the speed of the way there",
        ),
        (
            {"first_pose": np.array([0.0, 0.01]), "approach_s": 0.5},
            "first pose: joint02 farthest, at 0.6°; a ramp of 0.50 s from straight joints",
        ),
    ],
)
def test_the_way_to_the_first_pose_in_a_line(more, line):
    assert line in list(summary_lines(dry(**more), WIDE))


@pytest.mark.parametrize(
    ("seconds", "power"), [(0.5, "0.75 W and 8 W"), (0.0, "3.75e+08 W and 4e+09 W")]
)
def test_the_mean_power_is_that_of_any_length(seconds, power):
    run = dry(duration_s=seconds)
    (line,) = (line for line in summary_lines(run, WIDE) if line.startswith("energy"))
    assert line.endswith(f"; mean power {power}")
    report = reported(run)
    powers = [report[key] * max(seconds, 1e-9) for key in ("power_net_w", "power_el_w")]
    assert powers == pytest.approx([0.375, 4.0])


def test_a_row_of_the_table():
    negative = demand("joint02", energy_net_j=-0.0001, clamped=0.125, current_peak=NAN)
    heading, titles, *rows = joint_table((demand(), negative), WIDE)
    assert heading == (
        "% of the limit: half the range, [safety]'s rate, tracking error and current, the servo's "
        "stall torque"
    )
    assert " ".join(titles.split()) == (
        "joint from ° to ° % °/s % °/s² error ° % N m % rms A % net J abs J el. J clamped"
    )
    first = "joint01 -11.5 17.2 50 57 25 1146 2.9 20 0.600 40 0.250 0.35 25 0.500 0.750 2.000 -"
    assert [" ".join(row.split()) for row in rows] == [
        first,
        "joint02 -11.5 17.2 50 57 25 1146 2.9 20 0.600 40 0.250 - - 0.000 0.750 2.000 12%",
    ]
    _, *lines = joint_table((demand("a"), negative), WIDE)  # words begin, numbers end alike
    assert [line[:9] for line in lines] == ["joint    ", "a        ", "joint02  "]
    assert len({len(line) for line in lines}) == 1
    narrow = list(joint_table((demand(),), 60))
    assert narrow[0] == f"{heading}; the terminal is too narrow for all of it, --json has it"


def test_json_of_a_run():
    run = dry(
        fault=FAULT, missing=("max_rate",), cut=("a",), approach_s=NAN, path=Path("dry.mcap"),
        remarks=(GateEvent("warn", "gate: so"),), joints=(demand(current_peak=NAN), SECOND),
    )  # fmt: skip
    report = reported(run)
    expected = {
        "driven": "wave.mcap", "kind": "commands", "robot": "short", "world": "nominal",
        "armed": False, "duration_s": 4.0, "planned_duration_s": 8.0, "approach_s": None,
        "missing_limits": ["max_rate"], "first_pose": [0.1, -0.4], "energy_net_j": 0.375,
        "energy_abs_j": 1.5, "energy_el_j": 4.0, "power_net_w": 0.09375, "power_el_w": 1.0,
        "cut": ["a"], "remarks": [{"level": "warn", "text": "gate: so"}], "path": "dry.mcap",
    }  # fmt: skip
    assert {key: report[key] for key in expected} == expected
    assert report["stop"] == {
        "time_s": 4.0, "why": "joint02: too far", "kind": "tracking", "joint": "joint02",
        "value": 0.3, "limit": 0.25,
    }  # fmt: skip
    closest = {"joint": "joint02", "quantity": "range", "limit": 0.6}
    assert {key: report["closest"][key] for key in closest} == closest
    assert report["closest"]["value"] == pytest.approx(0.55)
    assert report["closest"]["share"] == pytest.approx(0.55 / 0.6)
    first, second = report["joints"]
    assert (first["current_peak"], first["share"]["current"]) == (None, None)
    assert first["share"]["tracking_error"] == pytest.approx(0.2)
    assert (first["margin"], second["margin"]) == pytest.approx((0.3, 0.05))
    assert second["clamped"] == 0.25
    early = reported(dry(fault=FAULT, started=False, duration_s=0.0, joints=()))
    assert (early["stop"]["time_s"], early["closest"], early["path"]) == (None, None, None)
    assert (early["power_net_w"], early["approach_s"]) == (0.0, 1.25)
    assert reported(dry(duration_s=0.0))["power_el_w"] == pytest.approx(4.0e9)
    assert reported(dry())["stop"] is None
