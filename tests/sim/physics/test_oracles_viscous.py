"""The viscous chain: twin, an overdamped chain of the textbook's, and slender-body theory.

In the limit of no inertia a planar chain with prescribed joint angles moves so that the drag on it
adds up to no force and no moment: three linear equations for the head's velocity. That program is
written down here on its own. The slender body's formula is for an endless smooth one; the ratio of
the two is what a chain loses by its ends and by its being made of links.
"""

import dataclasses
import math

import numpy as np
import pytest
from scipy.special import j0

from support.twin_runs import energies, simulate
from undulog.sim import FrictionLaw, Ground, World

ANISOTROPY = 10.0  # K = c_n / c_t
LENGTH, MASS = 0.06, 0.1
CASES = {
    # links, lag, amplitude of the links' direction: ratio of speeds
    (61, 2 * math.pi / 15, 0.3): 0.971,
    (61, 2 * math.pi / 15, 0.7): 0.975,
    (13, math.radians(30), 0.7): 0.876,
    (13, math.radians(60), 0.5): 0.871,
    (13, math.radians(90), 0.37): 0.760,
}


def joint_amplitude(a, lag):
    """Of the joints, for links that swing by a: A = 2 a sin(lag / 2), the serpenoid's."""
    return 2 * a * math.sin(lag / 2)


def slender_body(lag, a):
    """Speed and power per length, in units of link length, cycle and c_t per length.

    With theta = a sin(.) travelling at c: U = c J0(a) (K-1) b / (1 + (K-1) b) and
    c_t c^2 (1 - J0(a)^2 / (1 + (K-1) b)), b = (1 - J0(2a))/2 (after Gray & Hancock 1955).
    """
    c = 2 * math.pi / lag
    excess = (ANISOTROPY - 1) * (1 - j0(2 * a)) / 2
    return c * j0(a) * excess / (1 + excess), c**2 * (1 - j0(a) ** 2 / (1 + excess))


def overdamped_chain(links, lag, a, steps=200):
    """Speed and power per length of the overdamped chain over one cycle, in the same units."""
    order = np.arange(links - 1)

    def motion(t, heading):
        """Velocity of the head (x, y, turning) and power, by the balance of force and moment."""
        phase = 2 * np.pi * t - order * lag
        bend = joint_amplitude(a, lag) * np.sin(phase)
        rate = 2 * np.pi * joint_amplitude(a, lag) * np.cos(phase)
        turn = heading + np.append(0, np.cumsum(bend))
        spin = np.append(0, np.cumsum(rate))
        along = np.exp(1j * turn)  # the plane as complex numbers
        # Each link's centre lies half a link of either behind that of the one before it.
        arm = -np.append(0, np.cumsum(along[:-1] + along[1:])) / 2
        swing = 1j * along * spin
        carried = -np.append(0, np.cumsum(swing[:-1] + swing[1:])) / 2
        directions = [np.ones(links), 1j * np.ones(links), 1j * arm]

        def drag(velocity):
            local = velocity * along.conj()
            return (local.real + 1j * ANISOTROPY * local.imag) * along

        def work(first, other):
            return (first * drag(other).conj()).real.sum()

        matrix = [[work(p, q) for q in directions] for p in directions]
        head = np.linalg.solve(matrix, [-work(p, carried) for p in directions])
        velocity = carried + head @ np.array(directions)
        return head, work(velocity, velocity), arm.mean()

    state, power, dt = np.zeros(3), 0.0, 1 / steps
    start = motion(0.0, 0.0)[2]
    for k in range(steps):  # the midpoint rule
        half = state + dt / 2 * motion(k * dt, state[2])[0]
        rate, flow, _ = motion((k + 0.5) * dt, half[2])
        state, power = state + dt * rate, power + dt * flow
    end = motion(1.0, state[2])[2]
    return abs(complex(*state[:2]) + end - start), power / links


@pytest.fixture
def run_twin(make_robot, make_scenario):
    """The same chain in the twin, with omega m / c_t = 0.01: speed, power, tracking."""
    frequency_hz, settle_s = 0.05, 5.0
    c_t = 2 * math.pi * frequency_hz * MASS / 0.01
    ground = Ground(law=FrictionLaw.VISCOUS, drag_tangential=c_t, drag_normal=ANISOTROPY * c_t)
    # Strong servos that follow their commands, and links that don't yield to the gear's springs.
    servo = {"stall_torque": 1e3, "rotor_inertia": 1.0, "gear_stiffness": 100.0}
    servo |= {"viscous_friction": 0.0, "coulomb_friction": 0.0}

    def run(links, lag, a, *, rate_hz=400):
        robot = make_robot(links, planar=True, limit=math.pi, **servo)
        below = {"radius": 1e-9, "inertia": (1e-3, 1e-3, 1e-3)}  # touches below its centres
        chain = tuple(dataclasses.replace(link, **below) for link in robot.links)
        scenario = make_scenario(
            dataclasses.replace(robot, links=chain),
            amplitude=joint_amplitude(a, lag),
            frequency_hz=frequency_hz,
            lag=lag,
            duration_s=settle_s + 1 / frequency_hz,
            world=World(ground=ground),
            physics_rate_hz=rate_hz,
        )
        samples = simulate(scenario)[round(100 * settle_s) :]
        first, last = samples[0], samples[-1]
        way = (last.step.body.position - first.step.body.position).mean(axis=1)
        energy = energies(last, first)
        lost = energy["friction_tangential"] + energy["friction_normal"]
        command = np.array([sample.gait.command for sample in samples[:-1]])
        angle = np.array([sample.step.body.angle for sample in samples[:-1]])
        turn = np.exp(-2j * np.pi * frequency_hz * 0.01 * np.arange(len(angle)))
        # Per cycle and in units of link length; c_t per length is c_t / LENGTH.
        speed = np.linalg.norm(way) / LENGTH
        power = lost / (c_t * LENGTH**2 * frequency_hz * links)
        return speed, power, (turn @ angle) / (turn @ command)

    return run


@pytest.mark.parametrize(("case", "ratio"), CASES.items())
def test_the_overdamped_chain_has_the_known_share_of_the_slender_body_s_speed(case, ratio):
    speed, _ = overdamped_chain(*case)
    assert speed / slender_body(*case[1:])[0] == pytest.approx(ratio, abs=2e-3)


@pytest.mark.parametrize("a", [0.3, 0.7])
def test_a_long_and_finely_divided_chain_is_a_slender_body(a):
    lag = 2 * math.pi / 60
    chain = overdamped_chain(481, lag, a, steps=60)
    np.testing.assert_allclose(chain, slender_body(lag, a), rtol=6e-3)


@pytest.mark.nightly
@pytest.mark.parametrize(("case", "ratio"), CASES.items())
def test_the_twin_swims_as_the_overdamped_chain(run_twin, case, ratio):
    speed, power, tracking = run_twin(*case)
    # The joints follow: alike in amplitude, and all with the same delay.
    np.testing.assert_allclose(np.abs(tracking), 1.0, atol=1e-3)
    assert np.ptp(np.angle(tracking)) < 1e-3
    assert speed / slender_body(*case[1:])[0] == pytest.approx(ratio, rel=1e-2)
    chain = overdamped_chain(*case)
    assert speed == pytest.approx(chain[0], rel=3e-3)
    assert power == pytest.approx(chain[1], rel=1e-2)


@pytest.mark.nightly
def test_what_is_left_over_goes_with_the_step(run_twin):
    case = (13, math.radians(90), 0.37)
    chain = overdamped_chain(*case, steps=1000)[0]
    whole, half = (run_twin(*case, rate_hz=rate)[0] - chain for rate in (400, 800))
    assert whole == pytest.approx(2 * half, rel=0.1)
    assert abs(2 * half - whole) < 1e-5 * chain  # what would be left without a step


@pytest.mark.nightly
def test_at_small_amplitude_speed_goes_with_its_square(run_twin):
    # Liljebäck et al., IROS 2010, of viscous ground: twice the amplitude, four times the speed.
    links, lag, a = 13, math.radians(30), 0.03
    small, large = (run_twin(links, lag, amplitude)[0] for amplitude in (a, 2 * a))
    chain, larger = (overdamped_chain(links, lag, amplitude)[0] for amplitude in (a, 2 * a))
    assert large / small == pytest.approx(larger / chain, rel=5e-3)
    assert large / small == pytest.approx(4.0, rel=0.03)
