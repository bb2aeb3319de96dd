"""Bars and words against the analysis they show."""

import dataclasses
import math

import pytest

from undulog.analysis.results.estimate import Estimate
from undulog.replay.draw.cycles.steps import charts


def test_bars_show_gain_lag_and_energy_of_the_joints_that_have_them(analysis):
    gain, lag, energy = charts(analysis)
    assert [bar.place for bar in gain.bars] == list(range(1, 26, 2))
    assert [bar.joint for bar in lag.bars] == [f"joint{i:02d}" for i in range(1, 26, 2)]
    assert gain.bars[1].value == pytest.approx(100 * (0.95 + 0.008 - 1))
    assert lag.bars[1].value == pytest.approx(7.6)
    assert lag.bars[1].far == pytest.approx(7.6 + math.degrees(0.02))
    assert len(energy.bars) == 25
    assert energy.bars[3].value == pytest.approx(0.01)
    assert energy.bars[3].far is None


def test_the_interval_is_shown_on_the_far_side_of_the_baseline(analysis):
    gain = charts(analysis)[0]
    assert gain.bars[0].value == pytest.approx(-5.0)
    assert gain.bars[0].far == pytest.approx(-6.0)


def test_what_no_joint_has_gets_no_chart(analysis):
    bare = [
        dataclasses.replace(joint, gain=Estimate(), lag_rad=Estimate()) for joint in analysis.joints
    ]
    (energy,) = charts(dataclasses.replace(analysis, joints=tuple(bare)))
    assert energy.title == "Net energy [J]"
