"""The whole gate against anything: readings, wishes, stops, trouble and lateness drawn at random.

Under any command and in any phase, what it sends, decoded by cantools, is within the limits;
once it is done it sends nothing; and an ending ends.
"""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from support.decoded_commands import ROBOT, on_the_bus
from undulog.capture.common.errors import SourceError, UsageError
from undulog.capture.robot.model import OnFault
from undulog.sim.drive.gate import Gate
from undulog.sim.drive.limits import gate_limits
from undulog.sim.drive.outcome import FaultKind, GateFault, GateInput, GatePhase, JointStatus
from undulog.sim.gait.contract import GaitTick, Readings

COUNT, RATE_HZ = len(ROBOT.joints), 100
STEP = math.radians(0.01)  # of a command on the bus
LIMIT, MAX_RATE = math.radians(30.0), 4.0  # as snake25.toml has them

anything = st.floats(allow_nan=True, allow_infinity=True, width=64)
angles = arrays(np.float64, COUNT, elements=st.floats(-0.6, 0.6) | anything, fill=st.just(0.1))
wishes = arrays(np.float64, COUNT, elements=st.floats(-1.0, 1.0) | anything, fill=st.just(0.3))
troubles = st.none() | st.builds(GateFault, st.sampled_from(FaultKind), st.just("trouble"))
moments = st.fixed_dictionaries(
    {
        "angle": angles,
        "current": angles,
        "wish": wishes,
        "skip": st.sampled_from([0, 0, 0, 0, 1, 7, 200]),
        "received": st.sampled_from([True, True, True, False]),
        "late_s": st.sampled_from([0.0, 0.0, 0.0, 0.1, 3.0]),
        "trouble": st.none() | st.none() | troubles,
        "stop": st.sampled_from(["", "", "", "", "asked to stop"]),
        "at_once": st.sampled_from([False, False, False, False, True]),
    }
)


class Drawn:
    """A gait that wants what was drawn."""

    names = ()

    def __init__(self):
        self.wish = np.zeros(COUNT)

    def step(self, time_s, readings):
        del time_s, readings
        return GaitTick(self.wish, np.empty(0), "drawn", ())


@pytest.mark.slow
@settings(max_examples=50, deadline=None)
@given(
    arrays(np.float64, COUNT, elements=st.floats(-0.7, 0.7), fill=st.just(0.0)),
    st.lists(moments, min_size=1, max_size=12),
    st.sampled_from(OnFault),
)
def test_nothing_that_happens_makes_it_send_a_command_beyond_a_limit(pose, drawn, how):
    gait = Drawn()
    limits = dataclasses.replace(gate_limits(ROBOT), on_fault=how)
    gate = Gate(gait, limits, duration_s=0.3, place="can:test")
    sent, tick = [], 0
    unknown = np.full(COUNT, np.nan)

    def step(angle, current, wish, *, stop="", at_once=False, **more):
        nonlocal tick
        gait.wish = wish
        status = JointStatus(angle, current, unknown, unknown, np.zeros(COUNT))
        received = GateInput(Readings(angle, unknown), status, **more)
        step = gate.step(tick, received, stop, at_once=at_once)
        tick += 1
        if step.command is not None:
            sent.append(on_the_bus(step.command))

    gate.silence.interval = 1
    try:
        step(pose, np.zeros(COUNT), np.full(COUNT, 0.2))
        for moment in drawn:
            tick += moment.pop("skip")
            step(**moment)
        wave = np.full(COUNT, 0.3)
        for _ in range(1200):  # it comes to its end: an ending, or the planned one
            if gate.phase is GatePhase.DONE:
                break
            step(pose, np.zeros(COUNT), wave)
    except (SourceError, UsageError):
        assert not sent  # refused: before the first command, or never
        return
    assert gate.phase is GatePhase.DONE
    assert gate.outcome is not None
    count = len(sent)
    step(pose, np.zeros(COUNT), np.zeros(COUNT))
    assert len(sent) == count
    if sent:
        shown = np.array(sent)
        assert np.abs(shown).max() <= LIMIT + STEP / 2
        steps = np.abs(np.diff(shown, axis=0, prepend=np.clip(pose, -LIMIT, LIMIT)[None]))
        assert steps.max() <= MAX_RATE / RATE_HZ + STEP * (1 + 1e-6)
