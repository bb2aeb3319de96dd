"""Oscillators against closed forms and against SciPy's integrator at tight tolerance."""

import dataclasses
import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from undulog.capture.robot.model import Plane
from undulog.sim import PlaneGait, Readings, Serpentine, SerpentineGait, Wave
from undulog.sim.gait.contract import Modulation
from undulog.sim.gait.oscillators import (
    Approach,
    OscillatorChain,
    OscillatorChains,
    OscillatorGait,
    OscillatorKind,
)

OMEGA = math.pi
PSI = math.pi / 6
KINDS = list(OscillatorKind)
UNCOUPLED = {"forward": 0.0, "backward": 0.0}


def nothing(joint_count):
    return Readings(np.full(joint_count, np.nan), np.full(joint_count, np.nan))


def run(robot, seconds, *, rate_hz=100, answer=None, **fields):
    """Phases minus omega t, commands and amplitudes of one horizontal chain, per tick."""
    fields = {"amplitude": 0.4, "frequency_hz": 0.5, "lag": PSI} | fields
    gait = OscillatorGait(OscillatorChains({Plane.HORIZONTAL: OscillatorChain(**fields)}), robot)
    n = len(robot.joint_indices(Plane.HORIZONTAL))
    readings = nothing(len(robot.joints))
    theta, commands, amplitudes = [], [], []
    for k in range(round(seconds * rate_hz) + 1):
        tick = gait.step(k / rate_hz, readings)
        theta.append(tick.values[5 + 2 * n :] - OMEGA * k / rate_hz)
        amplitudes.append(tick.values[5 : 5 + n])
        commands.append(tick.command[robot.joint_indices(Plane.HORIZONTAL)])
        if answer is not None:
            readings = dataclasses.replace(readings, angle=answer(k / rate_hz, tick.command))
    return np.array(theta), np.array(commands), np.array(amplitudes)


def chain(forward, backward, detuning, start):
    fields = {"forward": forward, "backward": backward, "detuning": detuning, "start_phase": start}
    return {name: tuple(values) for name, values in fields.items()}


def scattered(n, size=0.8):
    return tuple(np.random.default_rng(4).uniform(-size, size, n).tolist())


# ---- the locked pattern --------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("sign", [-1, 1])
def test_a_bidirectional_chain_locks_at_the_lag_it_asks_for(make_robot, kind, sign):
    wave = Wave.TAIL_TO_HEAD if sign > 0 else Wave.HEAD_TO_TAIL
    robot, start = make_robot(7, planar=True), scattered(6)
    theta, _, _ = run(robot, 30.0, oscillator=kind, start_phase=start, wave=wave)
    np.testing.assert_allclose(np.diff(theta[-1]), sign * PSI, atol=1e-6)
    assert np.abs(np.diff(theta[0]) - sign * PSI).max() > 0.3


@pytest.mark.parametrize("kind", KINDS)
def test_a_locked_chain_is_the_serpentine_gait(make_robot, kind):
    robot = make_robot()
    _, commands, amplitudes = run(robot, 6.0, oscillator=kind)
    wave = Serpentine({Plane.HORIZONTAL: PlaneGait(0.4, 0.5, PSI)}, 0.0)
    serpentine = SerpentineGait(wave, robot)
    t = np.arange(601) / 100
    expected = [serpentine.step(x, nothing(25)).command[0::2] for x in t]
    np.testing.assert_allclose(commands[500:], expected[500:], atol=1e-6)
    assert not commands[0].any()  # it starts straight
    # r' from rest towards A: A (1 - (1 + g t) exp(-g t)), g = 4 by default.
    rise = 0.4 * (1.0 - (1.0 + 4.0 * t) * np.exp(-4.0 * t))
    np.testing.assert_allclose(amplitudes, np.tile(rise[:, None], 13), atol=1e-9)


@pytest.mark.parametrize("n", [5, 9, 13])
def test_the_slowest_mode_decays_as_the_path_graph_says(make_robot, n):
    # Small deviations obey theta' = -K L theta, L the path graph's Laplacian with eigenvalues
    # 4 sin^2(k pi / 2n) and, for k = 1, the eigenvector cos((i - 1/2) pi / n).
    mode = np.cos((np.arange(n) + 0.5) * math.pi / n)
    K = 5.0
    expected = 4.0 * K * math.sin(math.pi / (2 * n)) ** 2
    robot, start = make_robot(n + 1, planar=True), tuple((1e-3 * mode).tolist())
    theta, _, _ = run(robot, 3.0 / expected, forward=K, backward=K, start_phase=start)
    share = (theta + PSI * np.arange(n)) @ mode
    slope = np.polyfit(np.arange(len(share)) / 100, np.log(share), 1)[0]
    assert slope == pytest.approx(-expected, rel=1e-4)


def test_a_one_way_chain_settles_in_sequence(make_robot):
    # Without anything from behind, joint i is done when all before it are: the head never moves.
    robot, start = make_robot(9, planar=True), scattered(8)
    theta, _, _ = run(robot, 20.0, forward=2.0, backward=0.0, start_phase=start)
    error = np.abs(theta + PSI * np.arange(8) - theta[:, :1])
    assert np.ptp(theta[:, 0]) < 1e-11
    last = [np.flatnonzero(error[:, i] > 0.01)[-1] for i in range(1, 8)]
    assert last == sorted(last)
    # The second sees a constant neighbour: tan(d/2) decays at K exactly.
    t = np.arange(len(theta)) / 100
    start = theta[0, 1] + PSI - theta[0, 0]
    expected = 2.0 * np.arctan(np.tan(start / 2.0) * np.exp(-2.0 * t))
    np.testing.assert_allclose(theta[:, 1] + PSI - theta[:, 0], expected, atol=1e-8)


@pytest.mark.nightly
@pytest.mark.parametrize("ratio", [0.5, 0.99, 1.01, 2.0])
def test_a_detuned_pair_locks_up_to_twice_the_coupling(make_robot, ratio):
    # d = phi_2 - phi_1 - psi: d' = dw - 2 K sin d. Locked: d = asin(dw / 2K); else it drifts with
    # the mean rate sqrt(dw^2 - (2K)^2) (Adler 1946).
    K = 1.0
    detuned = 2.0 * K * ratio
    robot = make_robot(3, planar=True)
    theta, _, _ = run(robot, 60.0, forward=K, backward=K, detuning=(0.0, detuned))
    d = theta[:, 1] - theta[:, 0] + PSI
    if ratio < 1.0:
        assert d[-1] == pytest.approx(math.asin(ratio), abs=1e-6)
    else:
        drift = math.sqrt(detuned**2 - (2.0 * K) ** 2)
        # Over whole turns of d the mean rate is exact.
        turns = math.floor((d[-1] - math.pi) / (2 * math.pi))
        assert turns >= 1
        times = np.interp([math.pi, math.pi + 2 * math.pi * turns], d, np.arange(len(d)) / 100)
        assert 2 * math.pi * turns / np.diff(times)[0] == pytest.approx(drift, rel=2e-3)


# ---- the integration -----------------------------------------------------------------------


def foreign_phases(start, forward, backward, detuning, *, times, drive=None):
    def rate(t, x):
        out = detuning.copy()
        for i in range(len(x)):  # Eq. 1 as it stands, oscillator by oscillator
            if i > 0:
                out[i] += forward[i - 1] * math.sin(x[i - 1] - x[i] - PSI)
            if i < len(x) - 1:
                out[i] += backward[i] * math.sin(x[i + 1] - x[i] + PSI)
            if drive is not None:
                out[i] += drive(t, i, x[i])
        return out

    ivp = solve_ivp(rate, (0, times[-1]), start, "DOP853", t_eval=times, rtol=1e-11, atol=1e-12)
    return ivp.y.T


def test_phases_against_scipy(make_robot):
    # Heterogeneous, strong and of either sign: psi of the pair (i, i + 1) is -PSI, head to tail.
    random = np.random.default_rng(8)
    forward, backward = random.uniform(-2.0, 8.0, (2, 7))
    detuning, start = random.uniform(-3.0, 3.0, (2, 8))
    theta, _, _ = run(make_robot(9, planar=True), 5.0, **chain(forward, backward, detuning, start))
    times = np.arange(501) / 100
    pattern = -PSI * np.arange(8)
    foreign = foreign_phases(pattern + start, forward, backward, detuning, times=times)
    np.testing.assert_allclose(theta, foreign, atol=1e-7)


def test_hopf_oscillators_against_scipy_and_the_paper_s_form(make_robot):
    # Righetti & Ijspeert's x, y with mu = A^2 and alpha' = alpha / A^2, in the frame at rest; the
    # generator computes in units of A and in a turning frame.
    A, alpha, n = 0.3, 4.0, 6
    random = np.random.default_rng(3)
    forward, backward = random.uniform(0.0, 3.0, (2, n - 1))
    detuning, start = random.uniform(-1.0, 1.0, (2, n))

    def rate(t, xy):
        x, y = xy[:n], xy[n:]
        omega = OMEGA + detuning
        well = alpha / A**2 * (A**2 - x**2 - y**2)
        dx, dy = well * x - omega * y, well * y + omega * x
        c, s = math.cos(PSI), math.sin(PSI)
        for i in range(n - 1):  # i + 1 is drawn to i turned by -psi, and i to i + 1 turned by +psi
            dx[i + 1] += forward[i] * (c * x[i] + s * y[i] - x[i + 1])
            dy[i + 1] += forward[i] * (c * y[i] - s * x[i] - y[i + 1])
            dx[i] += backward[i] * (c * x[i + 1] - s * y[i + 1] - x[i])
            dy[i] += backward[i] * (c * y[i + 1] + s * x[i + 1] - y[i])
        return np.concatenate([dx, dy])

    phase = -PSI * np.arange(n) + start
    first = np.concatenate([A * np.cos(phase), A * np.sin(phase)])
    times = np.arange(801) / 100
    foreign = solve_ivp(rate, (0, 8.0), first, "DOP853", t_eval=times, rtol=1e-11, atol=1e-12).y.T
    fields = chain(forward, backward, detuning, start) | {"oscillator": OscillatorKind.HOPF}
    fields |= {"amplitude": A, "attraction": alpha, "approach_rate": 100.0}
    _, commands, _ = run(make_robot(n + 1, planar=True), 8.0, **fields)
    np.testing.assert_allclose(commands[100:], foreign[100:, n:], atol=1e-7)


def test_the_limit_cycle_has_its_radius_and_its_frequency(make_robot):
    fields = {"oscillator": OscillatorKind.HOPF, "detuning": (0.0, 0.5, -0.5)} | UNCOUPLED
    theta, _, amplitudes = run(make_robot(4, planar=True), 8.0, **fields)
    np.testing.assert_allclose(amplitudes[-1], 0.4, atol=1e-9)
    np.testing.assert_allclose((theta[-1] - theta[0]) / 8.0, [0.0, 0.5, -0.5], atol=1e-6)


# ---- approach, modulation, feedback --------------------------------------------------------


def test_the_approach_against_scipy_under_moving_targets():
    random = np.random.default_rng(1)
    approach = Approach(np.zeros(3), 4.0)
    state = np.zeros(6)
    for _ in range(50):
        target, span = random.uniform(-1.0, 1.0, 3), random.uniform(0.0, 0.3)

        def rate(_, x, target=target):
            r, v = x[:3], x[3:]
            return np.concatenate([v, 4.0 * (4.0 * (target - r) - 2.0 * v)])

        approach.aim(target)
        state = solve_ivp(rate, (0, span), state, "DOP853", rtol=1e-11, atol=1e-13).y[:, -1]
        np.testing.assert_allclose(approach.advance(span), state[:3], atol=1e-9)


def test_a_change_of_amplitude_and_offset_does_not_jump(make_robot):
    robot = make_robot(7, planar=True)
    chains = OscillatorChains({Plane.HORIZONTAL: OscillatorChain(0.3, 0.5, PSI)})
    gait = OscillatorGait(chains, robot)
    commands = []
    for k in range(800):
        if k == 400:
            gait.modulate(Modulation(np.full(6, 0.2), np.full(6, 0.1)))
        commands.append(gait.step(k / 100, nothing(6)).command)
    rates = np.diff(commands, axis=0) * 100
    # A smooth start and change: the joints' accelerations stay within A omega^2 and g^2 (dA + dY).
    assert np.abs(np.diff(rates, axis=0)).max() * 100 < 0.3 * OMEGA**2 + 16 * (0.24 + 0.1) + 4.0
    np.testing.assert_allclose(np.abs(np.array(commands[-100:]) - 0.1).max(), 0.06, atol=1e-4)


def test_feedback_against_scipy(make_robot):
    # Servos that answer with their own gain and delay, as held between ticks.
    n, eps, A = 5, 1.5, 0.4
    gain, delta = np.linspace(0.8, 1.1, n), np.linspace(-0.1, -0.4, n)
    bias = gain * np.sin(delta)
    start = np.array(scattered(n, 0.3))

    def answer(t, command):
        return gain * A * np.sin(OMEGA * t + delta - PSI * np.arange(n))

    fields = {"forward": 0.5, "backward": 0.5, "feedback": eps, "feedback_bias": tuple(bias)}
    fields |= {"start_phase": tuple(start), "answer": answer}
    theta, _, _ = run(make_robot(n + 1, planar=True), 4.0, **fields)

    times = np.arange(401) / 100
    # Integrated tick by tick: what is reported at a tick is held until the next.
    state, states = -PSI * np.arange(n) + start, []
    for k, t0 in enumerate(times):
        states.append(state)
        if k == 400:
            break
        # Readings come with the tick after the command, as `run` hands them over.
        q = answer(times[k - 1], None) if k else None

        def drive(s, i, phi, q=q, t0=t0):
            if q is None:
                return 0.0
            return eps * (2.0 * q[i] / A * math.cos(OMEGA * (t0 + s) + phi) - bias[i])

        ends = np.array([0.0, 0.01])
        half = np.full(n - 1, 0.5)
        state = foreign_phases(state, half, half, np.zeros(n), times=ends, drive=drive)[-1]
    np.testing.assert_allclose(theta, states, atol=1e-7)


@pytest.mark.nightly
@pytest.mark.parametrize("bias", [0.0, 0.5, 1.0])
def test_feedback_settles_where_the_mean_response_equals_the_bias(make_robot, bias):
    # Of q = g A sin(phi + delta) a cycle of 2 (q/A) cos(phi) leaves g sin(delta). Here q keeps its
    # own phase, so the chain shifts by theta until g sin(delta - theta) = b. An angle is fed back
    # 10 to 20 ms late, 15 in the mean, which counts as part of delta. Averaging is of first order:
    # what it neglects is of the size of the ripple, eps g / 2 omega.
    eps, gain, delta = 0.2, 0.9, -0.4
    late = delta - 0.015 * OMEGA
    b = bias * gain * math.sin(late)

    def answer(t, command):
        return gain * 0.4 * np.sin(OMEGA * t - PSI * np.arange(3) + delta)

    robot = make_robot(4, planar=True)
    theta, _, _ = run(robot, 32.0, feedback=eps, feedback_bias=b, answer=answer)
    shift = (theta[-200:] + PSI * np.arange(3)).mean()
    assert shift == pytest.approx(late - math.asin(b / gain), abs=eps * gain / (2 * OMEGA))


def test_feedback_of_an_answer_that_follows_slows_the_rhythm_in_second_order(make_robot):
    # q = A sin(phi + delta): phi' = omega + eps (sin(2 phi + delta) + sin(delta) - b). With the
    # bias taken out, the ripple theta = -(eps/2 omega) cos(2 phi + delta) times the slope
    # 2 eps cos(2 phi + delta) leaves -eps^2/2 omega in the mean.
    eps = 0.2
    bias = math.sin(-0.015 * OMEGA)  # the answer is the command itself, 10 to 20 ms old
    fields = {"approach_rate": 100.0, "feedback": eps, "feedback_bias": bias} | UNCOUPLED
    fields["answer"] = lambda t, command: command
    theta, _, _ = run(make_robot(4, planar=True), 30.0, **fields)
    drift = (theta[-1] - theta[1000]).mean() / 20.0
    assert drift == pytest.approx(-(eps**2) / (2 * OMEGA), rel=0.05)


@pytest.mark.parametrize("kind", KINDS)
def test_kicks_turn_the_phases_at_their_times_only(make_robot, kind):
    # Uncoupled, nothing else moves a phase.
    fields = {"oscillator": kind, "kick_every_s": 0.7, "kick_size": 1.2} | UNCOUPLED
    theta, _, _ = run(make_robot(4, planar=True), 2.1, **fields)
    jumps = np.diff(theta, axis=0)
    moved = np.flatnonzero(np.abs(jumps).max(axis=1) > 1e-9)
    assert moved.tolist() == [69, 139, 209]
    assert np.abs(jumps[moved]).max() <= 1.2
    assert np.unique(jumps[moved].round(6)).size == 9
    assert np.abs(np.delete(jumps, moved, axis=0)).max() < 1e-9


def test_a_kicked_chain_comes_back(make_robot):
    fields = {"forward": 5.0, "backward": 5.0, "kick_every_s": 6.0, "kick_size": 1.0}
    theta, _, _ = run(make_robot(5, planar=True), 11.0, **fields)
    pattern = np.diff(theta, axis=1) + PSI
    assert np.abs(pattern[600]).max() > 0.3
    assert np.abs(pattern[-1]).max() < 1e-3
    again, _, _ = run(make_robot(5, planar=True), 11.0, **fields)
    np.testing.assert_array_equal(theta, again)
    other, _, _ = run(make_robot(5, planar=True), 11.0, **fields, kick_seed=2)
    assert np.abs(other[600] - theta[600]).max() > 0.3


def test_a_joint_that_has_reported_nothing_is_not_fed_back(make_robot):
    robot = make_robot(5, planar=True)
    plain, _, _ = run(robot, 3.0)
    deaf, _, _ = run(robot, 3.0, feedback=2.0, feedback_bias=0.7)
    np.testing.assert_array_equal(plain, deaf)

    def answer(t, command):
        return np.array([np.nan, 0.1, np.nan, np.nan])

    half, _, _ = run(robot, 3.0, answer=answer, feedback=2.0, **UNCOUPLED)
    assert (np.ptp(half, axis=0) > 1e-3).tolist() == [False, True, False, False]


def test_the_frequency_factor_turns_every_oscillator(make_robot):
    robot = make_robot(4, planar=True)
    oscillators = OscillatorChain(0.3, 0.5, PSI, detuning=(0.0, 0.5, -0.5), **UNCOUPLED)
    gait = OscillatorGait(OscillatorChains({Plane.HORIZONTAL: oscillators}), robot)
    gait.modulate(dataclasses.replace(Modulation.none(3), frequency_factor=2.0))
    first, last = (gait.step(t, nothing(3)).values[-3:] for t in (0.0, 3.0))
    rates = 2.0 * (OMEGA + np.array([0.0, 0.5, -0.5]))
    np.testing.assert_allclose(last - first, 3.0 * rates, atol=1e-9)
