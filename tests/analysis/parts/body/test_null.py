"""The perfect-tracking null against slender-body theory, momentum, and a two-link chain."""

import numpy as np
import pytest
from scipy.special import j0

from undulog.analysis.estimators.series import Series
from undulog.analysis.parts.body.motion import observed, perfect_tracking, place_links, track
from undulog.analysis.parts.body.null import (
    SAMPLES,
    RigidChain,
    free_chain,
    one_cycle,
    places,
    viscous_chain,
)
from undulog.capture import load_robot
from undulog.capture.robot.kinematics import quaternion_from_rotation
from undulog.capture.robot.model import ClockDomain, Joint, Link, Plane, Robot


def planar_robot(links=13, plane=Plane.HORIZONTAL):
    return Robot(
        name="planar",
        description="A planar chain.",
        clock=ClockDomain.SIMULATED,
        links=tuple(
            Link(f"link{i + 1:02d}", 0.06, 0.025, 0.1, (4e-5, 5e-5, 5e-5)) for i in range(links)
        ),
        joints=tuple(Joint(f"joint{i + 1:02d}", plane) for i in range(links - 1)),
    )


def wave(joints, lag, amplitude):
    return (amplitude * np.exp(-1j * lag * np.arange(joints)))[:, None]


@pytest.mark.parametrize(
    ("links", "lag", "a", "stated"),
    [
        (61, 2 * np.pi / 15, 0.3, 0.971),
        (61, 2 * np.pi / 15, 0.7, 0.975),
        (13, np.pi / 6, 0.7, 0.876),
        (13, np.pi / 3, 0.5, 0.871),
        (13, np.pi / 2, 0.37, 0.760),
    ],
)
def test_speed_of_the_viscous_slender_body(links, lag, a, stated):
    """Serpenoid theta = a sin(.), K = 10; formula of the slender body after Gray & Hancock 1955."""
    omega, ratio = 2.0, 10.0
    joint_amplitude = 2 * a * np.sin(lag / 2)
    ones = np.ones(links)
    chain = RigidChain(ones, ones, ratio * ones, ratio * ones / 12)
    motion = one_cycle(chain, wave(links - 1, lag, joint_amplitude), np.zeros(links - 1), omega)
    speed = abs(motion.displacement) * omega / (2 * np.pi)
    beta = (1 - j0(2 * a)) / 2
    formula = omega / lag * j0(a) * (ratio - 1) * beta / (1 + (ratio - 1) * beta)
    assert speed / formula == pytest.approx(stated, abs=0.004)
    assert abs(motion.turn) < 1e-9


def test_lateral_undulation_runs_against_its_wave():
    # The wave runs from head to tail, so the chain moves along its head, +x.
    chain = viscous_chain(planar_robot())
    motion = one_cycle(chain, wave(12, np.pi / 3, 0.4), np.zeros(12), 3.0)
    tail = places(chain, motion, (0, 12), 1)[0, 1]
    heading = -tail / abs(tail)
    assert (motion.displacement * np.conj(heading)).real > 0.01
    back = one_cycle(chain, wave(12, -np.pi / 3, 0.4), np.zeros(12), 3.0)
    assert (back.displacement * np.conj(heading)).real < -0.01


def test_isotropic_drag_moves_nothing_forward():
    robot = planar_robot()
    motion = one_cycle(viscous_chain(robot, 1.0), wave(12, np.pi / 3, 0.4), np.zeros(12), 3.0)
    # Purcell: no net motion without anisotropy; what is left is the ends' rounding.
    assert abs(motion.displacement) < 0.02 * 0.06


def test_a_free_chain_keeps_its_momentum_at_zero():
    """From positions and headings alone, by central differences."""
    chain = free_chain(planar_robot(), Plane.HORIZONTAL)
    omega = 3.0
    motion = one_cycle(chain, wave(12, np.pi / 3, 0.3), np.full(12, 0.02), omega)
    path = places(chain, motion, tuple(range(13)), 1)
    centre = path @ chain.along / chain.along.sum()
    np.testing.assert_allclose(centre, centre[0], atol=1e-13)
    bent = np.concatenate([np.zeros((SAMPLES, 1)), np.cumsum(motion.angles, axis=1)], axis=1)
    heading = motion.heading[:, None] + bent
    step = 2 * 2 * np.pi / omega / SAMPLES
    spin = (heading[2:] - heading[:-2]) / step @ chain.turning
    arm = (path - centre[:, None])[1:-1]
    orbit = np.imag(np.conj(arm) * (path[2:] - path[:-2]) / step) @ chain.along
    assert np.max(np.abs(spin + orbit)) < 1e-3 * np.max(np.abs(orbit))


def test_two_free_links_share_the_turn_by_symmetry():
    ones = np.ones(2)
    motion = one_cycle(
        RigidChain(ones, ones, ones, ones / 12), np.array([[0.5 + 0j]]), np.zeros(1), 2.0
    )
    # Equal links turn by equal and opposite amounts: the head by minus half of the joint angle.
    swing = motion.heading - motion.heading[0]
    np.testing.assert_allclose(swing, -(motion.angles[:, 0] - motion.angles[0, 0]) / 2, atol=1e-12)


def test_a_bent_chain_drives_in_a_circle():
    chain = viscous_chain(planar_robot())
    motion = one_cycle(chain, wave(12, np.pi / 3, 0.3), np.full(12, 0.05), 3.0)
    assert abs(motion.turn) > 0.01
    # Cycle after cycle the same rigid motion: distances between cycles are all alike.
    head = places(chain, motion, (0,), 5)[::SAMPLES, 0]
    np.testing.assert_allclose(np.abs(np.diff(head)), abs(motion.displacement), rtol=1e-9)


@pytest.mark.parametrize(("lag", "degrees"), [(np.pi / 2, 22.8), (np.pi / 3, 39.5)])
def test_a_free_chain_differs_from_a_plain_wave_by_kinematics_alone(lag, degrees):
    """Tail against head, beyond the wave's own phase over twelve joints, at small amplitude."""
    robot = planar_robot()
    commands = {i: (c, 0.0) for i, c in enumerate(wave(12, lag, 0.2))}
    free = perfect_tracking(robot, Plane.HORIZONTAL, commands, omega=3.0, cycles=4)["free"]
    excess = free[2].phase_rad.value + 12 * lag
    excess = np.degrees(np.angle(np.exp(1j * excess)))
    assert abs(excess) == pytest.approx(degrees, abs=0.8)
    # A symmetric chain: the ends are alike, the middle is not.
    assert free[0].amplitude_m.value == pytest.approx(free[2].amplitude_m.value, rel=1e-6)
    assert abs(free[1].amplitude_m.value / free[0].amplitude_m.value - 1) > 0.04


def test_amplitude_and_phase_of_the_null_under_viscous_drag():
    """4 to 8 % in amplitude and up to 20 degrees in phase, at the twin's amplitude of 0.4 rad."""
    robot = planar_robot()
    spread, phase = [], []
    for lag in (np.pi / 2, np.pi / 3, np.pi / 6):
        commands = {i: (c, 0.0) for i, c in enumerate(wave(12, lag, 0.4))}
        points = perfect_tracking(robot, Plane.HORIZONTAL, commands, omega=3.0, cycles=4)["viscous"]
        size = [point.amplitude_m.value for point in points]
        spread.append(max(size) / min(size) - 1)
        phase.append(abs(np.degrees(np.angle(np.exp(1j * (points[1].phase_rad.value + 6 * lag))))))
    assert 0.02 < min(spread) < max(spread) < 0.11
    assert 8 < min(phase) < max(phase) < 20


def world_of(robot, motion, chain, cycles, angle):
    """Head pose of a planar motion, turned by an angle, as an external tracker would give it."""
    head = places(chain, motion, (0,), cycles)[:, 0] * np.exp(1j * angle)
    heading = np.concatenate([motion.heading + k * motion.turn for k in range(cycles)]) + angle
    c, s, o, e = np.cos(heading), np.sin(heading), np.zeros(head.size), np.ones(head.size)
    rotation = np.stack(
        [np.stack([c, -s, o], -1), np.stack([s, c, o], -1), np.stack([o, o, e], -1)], -2
    )
    return np.stack([head.real, head.imag, o], axis=-1), quaternion_from_rotation(rotation)


@pytest.mark.parametrize("name", ["viscous", "free"])
def test_what_is_seen_of_a_perfect_chain_is_its_null(name):
    """The null's motion, seen through head pose and joint angles of the 25-joint robot."""
    robot = load_robot("snake25")
    chain = viscous_chain(robot) if name == "viscous" else free_chain(robot, Plane.HORIZONTAL)
    omega, cycles = 2 * np.pi * 0.5, 5
    amplitudes = np.zeros((25, 1), dtype=complex)
    yaw = robot.joint_indices(Plane.HORIZONTAL)
    amplitudes[yaw] = wave(13, np.pi / 3, 0.4)
    motion = one_cycle(chain, amplitudes, np.zeros(25), omega)
    position, quaternion = world_of(robot, motion, chain, cycles, 0.7)
    t = 2 * np.pi / omega * np.arange(cycles * SAMPLES) / SAMPLES
    angles = np.tile(motion.angles, (cycles, 1))
    joints = [Series(j.name, t, angles[:, i]) for i, j in enumerate(robot.joints)]
    points = observed(
        robot, Plane.HORIZONTAL, track(robot, (t, position, quaternion), joints), omega
    )
    commands = {int(i): (amplitudes[i], 0.0) for i in yaw}
    null = perfect_tracking(robot, Plane.HORIZONTAL, commands, omega=omega, cycles=cycles)[name]
    for point, expected in zip(points, null, strict=True):
        assert point.link == expected.link
        assert point.amplitude_m.value == pytest.approx(expected.amplitude_m.value, rel=1e-6)
        assert point.phase_rad.value == pytest.approx(expected.phase_rad.value, abs=1e-6)
    assert points[0].phase_rad.value == 0.0


def test_a_vertical_gait_is_seen_upwards_and_has_no_viscous_null():
    robot = planar_robot(plane=Plane.VERTICAL)
    chain = free_chain(robot, Plane.VERTICAL)
    omega, cycles = 3.0, 4
    amplitudes = wave(12, np.pi / 3, 0.3)
    motion = one_cycle(chain, -amplitudes, np.zeros(12), omega)  # pitch: nose down is positive
    ends = places(chain, motion, (0, 12), cycles)
    level = -np.angle(np.sum(ends[:, 0] - ends[:, 1]))  # as gravity keeps it on average
    head = ends[:, 0] * np.exp(1j * level)
    pitch = -np.tile(motion.heading, cycles) - level
    zero = np.zeros(head.size)
    position = np.stack([head.real, zero, head.imag], axis=-1)
    quaternion = np.stack([zero, np.sin(pitch / 2), zero, np.cos(pitch / 2)], axis=-1)
    t = 2 * np.pi / omega * np.arange(head.size) / SAMPLES
    angles = -np.tile(motion.angles, (cycles, 1))
    joints = [Series(j.name, t, angles[:, i]) for i, j in enumerate(robot.joints)]
    points = observed(robot, Plane.VERTICAL, track(robot, (t, position, quaternion), joints), omega)
    commands = {i: (c, 0.0) for i, c in enumerate(amplitudes)}
    null = perfect_tracking(robot, Plane.VERTICAL, commands, omega=omega, cycles=cycles)
    assert set(null) == {"free"}
    for point, expected in zip(points, null["free"], strict=True):
        assert point.amplitude_m.value == pytest.approx(expected.amplitude_m.value, rel=1e-6)
        assert point.phase_rad.value == pytest.approx(expected.phase_rad.value, abs=1e-6)


def test_places():
    assert (place_links(26), place_links(13)) == ((0, 12, 25), (0, 6, 12))
