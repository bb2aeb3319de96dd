"""Sessions of sweeps as one experiment: written to files, answered by a planted chain."""

import dataclasses

import numpy as np
import pytest

from support.analysed import experiment
from support.joint_runs import write_joints
from support.linear_chain import within
from undulog.analysis.experiment.sweep_coupling import servo_side
from undulog.analysis.plan.designs import tones
from undulog.analysis.present.text_experiment import render_experiment
from undulog.analysis.results.coupling import LinearCoupling, Route
from undulog.capture import load_robot
from undulog.capture.robot.model import Plane

pytestmark = pytest.mark.nightly

ROBOT = load_robot("snake25")
YAW = ROBOT.joint_indices(Plane.HORIZONTAL)[:4]
NAMES = tuple(ROBOT.joint_names[k] for k in YAW)
M = len(NAMES)
A, SIGMA, SIGMA_TORQUE = 0.02, 2e-4, 2e-4
F0, RATE, SECONDS = 0.5, 50, 20
HOLD_S = 0.5 / RATE
PLACE = np.arange(M)
BODY = np.exp(-np.abs(PLACE[:, None] - PLACE[None, :]) / 2) * 0.01
SERVO = dataclasses.replace(ROBOT.joints[0].servo, coulomb_friction=0.0)
KNOWN = ROBOT.toml.replace("coulomb_friction = 0.03", "coulomb_friction = 0.0").replace(
    'assumed = ["links", "servo", "bus"]', 'assumed = ["links"]'
)
FREE = '[world]\nsurface = "none"\n'


def impedance(omega):
    """Reciprocal, inertia and some loss."""
    return (-(omega**2) + 0.3j * omega) * BODY


def response(omega):
    D_r, D_q = servo_side([SERVO] * M, omega)
    late = np.exp(-1j * omega * HOLD_S)
    return np.linalg.solve(impedance(omega) + np.diag(D_q), np.diag(D_r)) * late


def robot_of(tmp, text):
    path = tmp / "robot.toml"
    path.write_text(text)
    (tmp / "snake25.dbc").write_text(dict(ROBOT.databases)["snake25.dbc"])
    return load_robot(path)


def write_run(
    path, omegas, commands, *, robot, scenario=None, effort=True, seed=0, drift=0.0, bend=0.0
):
    """One run: steady sines at each tone, no physics; scenario None = a real robot."""
    rng = np.random.default_rng(seed)
    t = np.arange(RATE * SECONDS)[:, None] / RATE
    shift = rng.uniform(-np.pi, np.pi)
    turn = [np.exp(1j * omega * (t + shift)) for omega in omegas]
    tones = zip(omegas, commands, turn, strict=True)
    moved = [response(w) @ c * x * (1 + drift * t) for w, c, x in tones]
    angle = np.real(sum(moved))
    speed = np.real(sum(1j * w * q for w, q in zip(omegas, moved, strict=True)))
    torque = sum(np.real(q @ impedance(w).T) for w, q in zip(omegas, moved, strict=True))
    noise = rng.normal(size=(len(t), 2 if effort else 1, M))
    seen = [angle + SIGMA * noise[:, 0] + bend * angle**3, speed]
    if effort:
        seen.append(torque + SIGMA_TORQUE * noise[:, 1])
    asked = sum(np.real(c * x) for c, x in zip(commands, turn, strict=True))
    return write_joints(path, NAMES, asked, seen, rate_hz=RATE, robot=robot, scenario=scenario)


def dft():
    return A * np.exp(2j * np.pi / M * np.outer(PLACE, PLACE))


def sweep(tmp, *, omegas=(2 * np.pi * F0,), **how):
    strength = [(omegas[0] / w) ** 2 * np.exp(0.7j * k) for k, w in enumerate(omegas)]
    return [
        write_run(tmp / f"run{k}.mcap", omegas, [s * column for s in strength], seed=k, **how)
        for k, column in enumerate(dft())
    ]


def close(matrix, truth):
    """All elements within 5 standard errors, and nine in ten within their interval."""
    off = np.array(matrix.real) + 1j * np.array(matrix.imag) - truth
    assert np.abs(off).max() < 5 * np.max(matrix.standard_error)
    half = np.array(matrix.ci95_half)
    assert np.concatenate([np.abs(off.real) <= half, np.abs(off.imag) <= half]).mean() > 0.85


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("sweeps")


@pytest.fixture(scope="module")
def lag_sweep(folder):
    (folder / "torque").mkdir()
    return sweep(folder / "torque", robot=robot_of(folder, KNOWN), scenario=None)


@pytest.fixture(scope="module")
def result(lag_sweep):
    return experiment(lag_sweep)


def true_h(omega):
    return response(omega) * np.exp(1j * omega * HOLD_S)


def test_h_and_z_are_those_planted(result):
    coupling = result.coupling
    assert isinstance(coupling, LinearCoupling)
    assert (coupling.plan, coupling.runs, coupling.joints) == ("lag-sweep", M, NAMES)
    assert coupling.hold_s == pytest.approx(HOLD_S)
    (tone,) = coupling.tones
    omega = 2 * np.pi * F0
    assert tone.frequency_hz == pytest.approx(F0)
    assert tone.command_condition == pytest.approx(1.0, abs=1e-6)
    assert tone.condition_number == pytest.approx(np.linalg.cond(true_h(omega)), rel=0.01)
    close(tone.H, true_h(omega))
    close(tone.Z, impedance(omega))
    assert tone.route is Route.TORQUE
    assert tone.servo_difference < 0.2
    low, high = tone.asymmetry.ci95
    assert low == 0.0 < high
    low, high = tone.within_1.ci95
    assert low <= within(BODY, 1) <= high
    assert coupling.drift_per_cycle == 0.0
    assert tone.distortion < 0.01
    assert coupling.sideband_energy.ci95[0] == 0.0


def test_contact_that_is_not_known_is_reported(result):
    assert result.coupling.contact is None
    assert "which its sessions don't record" in result.coupling.validity
    assert [
        warning for warning in result.warnings if "whether the robot touched anything" in warning
    ]
    assert len(result.warnings) == 1


def test_the_text_and_the_object(result, lag_sweep, report_of):
    text = render_experiment(result)
    lines = text.splitlines()
    assert lines[0].startswith("4 sessions: coupling at 0.5 Hz: ")
    assert "of it is between neighbours" in lines[0]
    assert lines[0].endswith(" (Z from torques).")
    assert "condition numbers C 1, H 1" in text
    assert any("Method: lag-sweep, 4 runs of 4 joints" in line for line in lines)
    assert text.count(" sweep\n") == M
    assert "reversal" not in text
    coupling = report_of("analyse", *lag_sweep)["coupling"]
    assert coupling["identifiable"] is True
    (tone,) = coupling["tones"]
    assert (tone["route"], np.shape(tone["Z"]["real"])) == ("torque", (M, M))
    H = np.array(tone["H"]["real"]) + 1j * np.array(tone["H"]["imag"])
    np.testing.assert_allclose(coupling["matrix"], np.abs(H))


def test_without_torques_a_known_servo_is_taken_off(folder):
    (folder / "servo").mkdir()
    paths = sweep(folder / "servo", robot=robot_of(folder, KNOWN), effort=False)
    (tone,) = experiment(paths).coupling.tones
    assert tone.route is Route.SERVO
    close(tone.Z, impedance(2 * np.pi * F0))
    assert tone.servo_difference is None


@pytest.mark.parametrize(
    ("text", "why"),
    [
        (ROBOT.toml, "the servo of snake25 is assumed"),
        (KNOWN.replace("coulomb_friction = 0.0", "coulomb_friction = 0.03"), "Coulomb friction"),
    ],
)
def test_with_an_unknown_servo_it_is_known_up_to_rows(tmp_path, text, why):
    coupling = experiment(sweep(tmp_path, robot=robot_of(tmp_path, text), effort=False)).coupling
    (tone,) = coupling.tones
    assert (tone.route, tone.Z) == (Route.ROW_SCALED, None)
    assert why in coupling.route_why
    # All servos are alike here, so off the diagonal H^-1 is Z but for one factor.
    low, high = tone.asymmetry.ci95
    assert low == 0.0 < high


def test_a_lag_sweep_in_contact_is_refused(tmp_path):
    result = experiment(sweep(tmp_path, robot=ROBOT, scenario='[world]\nsurface = "flat"\n'))
    assert not result.coupling.identifiable
    assert "every gait is its own operating point" in result.coupling.why
    assert "phase-kicks" in result.coupling.record
    assert result.answer.startswith("coupling not identifiable from these runs: in contact")


def test_a_sweep_with_a_run_missing(lag_sweep):
    coupling = experiment(lag_sweep[:-1]).coupling
    assert not coupling.identifiable
    assert coupling.why.startswith("3 of 4 runs of a lag-sweep")
    assert coupling.matrix is None


def test_responses_that_drift_are_reported(tmp_path):
    result = experiment(sweep(tmp_path, robot=ROBOT, scenario=FREE, drift=2e-3))
    # 0.2 % a second is 0.4 % a cycle.
    assert result.coupling.drift_per_cycle == pytest.approx(4e-3, rel=0.1)
    assert any("not settled" in warning for warning in result.warnings)
    assert result.coupling.contact is False


@pytest.mark.nightly
def test_a_multisine_shows_every_tone(tmp_path):
    omegas = tuple(tones(2 * np.pi * F0, 3))
    scenario = f"physics_rate_hz = 1000000000\n[servo]\ncoulomb_friction = 0.0\n{FREE}"
    result = experiment(sweep(tmp_path, omegas=omegas, robot=ROBOT, scenario=scenario))
    coupling = result.coupling
    assert coupling.plan == "multisine"
    assert [tone.frequency_hz for tone in coupling.tones] == pytest.approx([0.5, 1.1, 1.7])
    for tone, omega in zip(coupling.tones, omegas, strict=True):
        assert tone.command_condition == pytest.approx(1.0, abs=1e-6)
        close(tone.H, true_h(omega))
        close(tone.Z, impedance(omega))
        assert tone.distortion < 0.02
    assert coupling.sideband_energy.value < 1e-4
    assert coupling.drift_per_cycle == 0.0
    assert [run.role for run in result.runs] == ["sweep"] * M


@pytest.mark.nightly
def test_a_multisine_in_contact_reports_what_is_mixed(tmp_path, opened):
    omegas = tuple(tones(2 * np.pi * F0, 3))
    scenario = 'physics_rate_hz = 1000\n[world]\nsurface = "flat"\n'
    how = {"omegas": omegas, "scenario": scenario, "effort": False, "bend": 400.0}
    paths = sweep(tmp_path, robot=ROBOT, **how)
    result = experiment(paths)
    coupling = result.coupling
    assert (coupling.identifiable, coupling.contact) == (True, True)
    assert coupling.validity.startswith("in contact")
    assert any(warning.startswith("not linear") for warning in result.warnings)
    # A record holds two periods of the grid: line k of 0.1 Hz is bin 2 k of its transform.
    lines = np.arange(1, 28)  # to the highest tone and twice the gait's beyond it
    excited = np.isin(lines, [5, 11, 17])
    beside = at_tones = 0.0
    for path in paths:
        signals = opened(path).joints("/joint_states")
        values = np.stack([signals.signal(name).values for name in NAMES])
        power = np.sum(np.abs(np.fft.rfft(values, axis=1)[:, 2 * lines]) ** 2, axis=0)
        beside, at_tones = beside + power[~excited].sum(), at_tones + power[excited].sum()
    assert coupling.sideband_energy.value == pytest.approx(beside / at_tones, rel=0.05)
    low, high = coupling.sideband_energy.ci95
    assert 0 < low < beside / at_tones < high
