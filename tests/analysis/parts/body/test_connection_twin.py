"""The connection of runs of the twin: viscous in closed form, Coulomb friction held out."""

import dataclasses
import math

import numpy as np
import pytest

from support import twin_chains
from support.viscous_swimmer import Swimmer
from undulog.analysis.estimators.series import Series
from undulog.analysis.parts.body.connection import fit_connection, turned
from undulog.analysis.parts.body.null import one_cycle, viscous_chain
from undulog.analysis.parts.body.travel import chassis_path, gait_cycle, wave_at
from undulog.capture.robot.model import Plane
from undulog.sim import FrictionLaw, Ground, PlaneGait, Serpentine, load_scenario, run_batch
from undulog.sim.gait.oscillators import OscillatorChain, OscillatorChains

pytestmark = pytest.mark.nightly

SETTLE, MEASURED = 6, 6
"""Cycles."""


SLOW = 0.05
"""Gait frequency at which inertia is small beside drag [Hz]: omega m / c_t = 0.005."""


def scenario(base, gait, ground=None, cycles=SETTLE + MEASURED):
    amplitude, frequency, lag, offset = gait
    wave = Serpentine(
        {Plane.HORIZONTAL: PlaneGait(amplitude, frequency, lag, offset=offset)}, ramp_s=1.0
    )
    world = base.world if ground is None else dataclasses.replace(base.world, ground=ground)
    seconds = cycles / frequency
    return dataclasses.replace(base, gait=wave, world=world, duration_s=round(seconds, 2))


def limited(original, amplitudes):
    """Limit the yaw joints to amplitudes about the gait's offset."""
    offset, limits = original.gait.planes[Plane.HORIZONTAL].offset, iter(amplitudes)
    joints = [
        joint
        if joint.plane is Plane.VERTICAL
        else dataclasses.replace(joint, lower=offset - a, upper=offset + a)
        for joint in original.robot.joints
        for a in ([0.0] if joint.plane is Plane.VERTICAL else [float(next(limits))])
    ]
    return dataclasses.replace(
        original, robot=dataclasses.replace(original.robot, joints=tuple(joints))
    )


def cycle_of(run, frequency, cycles=MEASURED):
    assert run.error is None
    count = round(100 * cycles / frequency) + 1
    t, robot = run.time_s[-count:], run.scenario.robot
    angles = {
        joint.name: Series(joint.name, t, np.ascontiguousarray(run.angle[-count:, k]))
        for k, joint in enumerate(robot.joints)
    }
    path = chassis_path(robot, (t, run.head[-count:], run.head_quaternion[-count:]), angles)
    return gait_cycle(robot, path, angles, 2 * np.pi * frequency, t[0])


def cycles_of(base, gaits, ground=None):
    runs = run_batch([scenario(base, gait, ground) for gait in gaits])
    return [cycle_of(run, gait[1]) for run, gait in zip(runs, gaits, strict=True)]


def drawn(random, count, frequency, share=1.0):
    off = share * random.uniform(-1, 1, (count, 3))
    return [
        (0.35 * (1 + 0.15 * a), frequency, math.pi / 3 * (1 + 0.04 * b), 0.08 * c)
        for a, b, c in off.tolist()
    ]


def perfect_tracking(robot, gait, ratio):
    """Return the step of a cycle if every joint were on its command and no link slipped much."""
    amplitude, frequency, lag, offset = gait
    yaw = [k for k, joint in enumerate(robot.joints) if joint.plane is Plane.HORIZONTAL]
    commands = np.zeros((len(robot.joints), 1), dtype=np.complex128)
    commands[yaw, 0] = amplitude * np.exp(-1j * lag * np.arange(len(yaw)))
    offsets = np.zeros(len(robot.joints))
    offsets[yaw] = offset
    motion = one_cycle(viscous_chain(robot, ratio), commands, offsets, 2 * np.pi * frequency)
    return abs(motion.displacement), motion.turn


def nearest(model, cycles, cycle):
    """Return the step of the nearest gait, scaled by amplitude squared; a cycle knows no speed."""
    shape = turned(cycle.shape, model.base.phase(cycle.shape))
    off = [np.linalg.norm(turned(c.shape, model.base.phase(c.shape)) - shape) for c in cycles]
    neighbour = cycles[int(np.argmin(off))]
    size = [np.linalg.norm(c.shape[:, 1]) for c in (cycle, neighbour)]
    step = neighbour.steps.mean(axis=0) * (size[0] / size[1]) ** 2
    return np.hypot(*step[:2]), step[2]


def test_held_out_gaits_under_coulomb_friction_at_two_speeds():
    base = load_scenario("flat")
    random = np.random.default_rng(21)
    fitted = drawn(random, 16, 0.5)
    held = [gait for f in (0.5, 1.0) for gait in drawn(random, 12, f, 0.8)]
    far = [(0.2, 0.5, math.pi / 3, 0.0), (0.35, 0.5, math.pi / 3, 0.15), (0.35, 0.5, 0.8, 0.0)]
    cycles = cycles_of(base, [*fitted, *held, *far])
    fitted_cycles, rest, beyond = cycles[:16], cycles[16:40], cycles[40:]
    model = fit_connection(fitted_cycles)
    for cycle in beyond:
        assert model.outside(cycle.shape) is not None
    for frequency in (0.5, 1.0):
        errors, covered = [], []
        for gait, cycle in zip(held, rest, strict=True):
            if gait[1] != frequency or model.outside(cycle.shape) is not None:
                continue
            step = cycle.steps.mean(axis=0)
            value, half = model.predict(cycle.shape)
            covered.append(np.abs(value - step) <= half)
            guesses = [
                (np.hypot(*value[:2]), value[2]),
                *(perfect_tracking(base.robot, gait, ratio) for ratio in (10.0, 1e4)),
                nearest(model, fitted_cycles, cycle),
            ]
            gone = np.hypot(*step[:2])
            errors.append([(abs(d - gone), abs(turn - step[2])) for d, turn in guesses])
        medians = np.median(errors, axis=0)
        shown = np.round(1000 * medians, 2).tolist()
        print(f"{frequency} Hz, {len(errors)} gaits, model, K 10, K 1e4, nearest: {shown}")
        assert len(errors) >= 6
        assert np.all(medians[0] <= 0.5 * medians[1:].min(axis=0))
        if frequency == fitted[0][1]:
            assert np.mean(covered) > 0.91


def test_the_connection_of_a_viscous_chain_is_that_of_force_and_moment_balance(tmp_path):
    """Three yaw joints, drag far above inertia: links of the twin feel drag at their centres."""
    (tmp_path / "chain.toml").write_text(twin_chains.chain(5, stall_torque=6.0))
    (tmp_path / "wave.toml").write_text(twin_chains.wave(duration_s=8.0, settle_s=4.0))
    base = load_scenario(tmp_path / "wave.toml")
    random = np.random.default_rng(1)
    ground = Ground(law=FrictionLaw.VISCOUS, drag_tangential=6.0, drag_normal=60.0)
    runs = []
    for _ in range(16):
        off = random.uniform(-1, 1, 7)
        chain = OscillatorChain(
            amplitude=1.0,
            frequency_hz=SLOW,
            lag=1.0,
            offset=0.03 * off[6],
            forward=0.0,
            backward=0.0,
            start_phase=tuple((0.06 * off[3:6]).tolist()),
        )
        variant = scenario(base, (1.0, SLOW, 1.0, 0.03 * off[6]), ground, cycles=3)
        # A command of 1 rad is cut to what each joint's limits leave: amplitudes of their own.
        variant = limited(variant, 0.35 * (1 + 0.06 * off[:3]))
        runs.append(dataclasses.replace(variant, gait=OscillatorChains({Plane.HORIZONTAL: chain})))
    cycles = [cycle_of(run, SLOW, cycles=2) for run in run_batch(runs)]
    model = fit_connection(cycles)
    swimmer = Swimmer(0.06, 1.0, 10.0, turning=0.0)
    phases = 2 * np.pi * np.arange(24) / 24
    value, half = model.matrices(phases)
    angles = model.base.mean[:, None] + model.base.modes @ wave_at(model.base.cycle, phases)
    expected = np.stack(
        [
            swimmer.connection(np.insert(yaw, [1, 2], 0.0))[:, ::2] @ model.base.modes
            for yaw in angles.T
        ]
    )
    for cycle in cycles[:6]:
        step = swimmer.cycle(np.insert(cycle.shape, [1, 2], 0.0, axis=0)).steps[0]
        np.testing.assert_allclose(cycle.steps.mean(axis=0), step, rtol=2e-3, atol=3e-5)
    assert model.identified
    # Inertia, and links that pitch under their drag, are not in the closed form.
    assert np.mean(np.abs(value - expected) <= half) > 0.91
    error, size = (np.sqrt(np.mean(steps**2, axis=0)) for steps in (value - expected, expected))
    assert error[0, 0] < 0.02 * size[0, 0]
    assert error[2, 0] < 0.05 * size[2, 0]
