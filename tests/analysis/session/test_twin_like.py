"""Sessions to the whole contract: gait log, settling, head pose, motor power, two planes."""

import json

import numpy as np
import pytest

from support.analysed import analysed
from undulog.analysis.parts.body.null import SAMPLES, one_cycle, places, viscous_chain
from undulog.analysis.signals.stretch import Options
from undulog.capture import SessionWriter, load_robot
from undulog.capture.robot.model import Plane

pytestmark = pytest.mark.nightly

EPOCH_NS = 1_735_689_600_000_000_000
TICK_NS = 10_000_000
OMEGA = np.pi  # 0.5 Hz: 200 ticks a cycle
SCENARIO = b"""settle_s = 2.0
[world.ground]
mu_tangential = 0.1
mu_normal = 0.6
"""


def write_twin(
    path,
    *,
    duration=14.0,
    settle_s=2.0,
    planes=(Plane.HORIZONTAL,),
    gain=1.0,
    lag=0.0,
    change=None,
    odometry=True,
    ledger=None,
    powers=None,
):
    """A robot with perfect servos (by default) that moves as the viscous null says, K = 6."""
    robot = load_robot("snake25")
    names = robot.joint_names
    amplitudes = np.zeros((25, 1), dtype=complex)
    for plane in planes:
        joints = robot.joint_indices(plane)
        amplitudes[joints, 0] = 0.3 * np.exp(-1j * np.pi / 3 * np.arange(joints.size))
    chain = viscous_chain(robot, 6.0)
    planar = amplitudes.copy()
    planar[robot.joint_indices(Plane.VERTICAL)] = 0
    motion = one_cycle(chain, planar, np.zeros(25), OMEGA)
    head = places(chain, motion, (0,), int(duration / 2) + 1)[:, 0]
    phase = np.arange(head.size) * 200 / SAMPLES
    ticks = np.arange(round(duration * 100) + 1)
    x, y = np.interp(ticks, phase, head.real), np.interp(ticks, phase, head.imag)
    one_turn = np.arange(SAMPLES + 1) * 200 / SAMPLES
    yaw = np.interp(ticks % 200, one_turn, np.append(motion.heading, motion.heading[0]))
    facts = {"metadata": {"settle_s": repr(settle_s), "scenario": "test"}, "robot": robot}
    with SessionWriter(path, session_id="twin-like", epoch_ns=EPOCH_NS, **facts) as w:
        w.attach("scenario.toml", "application/toml", SCENARIO)
        commands = w.joint_state("/joint_commands", names, unit="rad")
        states = w.joint_state("/joint_states", names, unit="rad", velocity=True, effort=True)
        current = w.joint_state("/joint_current", names, unit="A")
        voltage = w.joint_state("/joint_voltage", names, unit="V")
        parts = [f"{p}.{v}" for p in planes for v in ("A", "omega", "lag", "offset", "phase")]
        gait = w.joint_state("/gait", parts, unit="1")
        odometry = w.odometry("/odom", frame="world", child="link01") if odometry else None
        terms = ("mechanical_net", "electrical_net")
        booked = w.joint_state("/energy_ledger", terms, unit="J") if ledger else None
        accumulated = {
            name: w.joint_state(f"/joint_power/{name}", names, unit="W") for name in powers or ()
        }
        rng = np.random.default_rng(1)
        for k in ticks:
            t_ns = EPOCH_NS + int(k) * TICK_NS
            turn = np.exp(1j * OMEGA * k / 100)
            ramp = min(1.0, (k + 1) / 100) * (1.0 if change is None or k < change else 0.8)
            angle = np.real(amplitudes[:, 0] * turn) * ramp
            seen = np.real(gain * np.exp(-1j * lag) * amplitudes[:, 0] * turn) * ramp
            commands.write(t_ns, angle)
            rate = np.real(1j * OMEGA * amplitudes[:, 0] * turn)
            states.write(t_ns, seen + rng.normal(0, 1e-4, 25), rate, 0.5 * rate)
            current.write(t_ns, np.full(25, 0.5))
            voltage.write(t_ns, np.full(25, 2.0))
            wave = [0.3 * ramp, OMEGA, -np.pi / 3, 0.0, OMEGA * k / 100]
            gait.write(t_ns, np.tile(wave, len(planes)))
            for name, channel in accumulated.items():
                channel.write(t_ns + TICK_NS // 2, np.full(25, powers[name]))
            if booked is not None:
                booked.write(t_ns, np.array(ledger) * k / 100)
            if odometry is not None:
                quaternion = np.array([0, 0, np.sin(yaw[k] / 2), np.cos(yaw[k] / 2)])
                position = np.array([x[k], y[k], 0.02])
                odometry.write(t_ns, position, quaternion, np.zeros(3), np.zeros(3))
        w.set_verdict("good")
    return path


@pytest.fixture(scope="module")
def twin(tmp_path_factory):
    return write_twin(tmp_path_factory.mktemp("twin") / "twin.mcap")


@pytest.fixture(scope="module")
def result(twin):
    return analysed(twin)


def test_the_settled_whole_cycles_are_analysed(result):
    (window,) = result.gait.windows
    assert (window.start_s, window.stop_s, window.cycles) == pytest.approx((2.0, 14.0, 6))
    assert result.gait.fitted.start_s == pytest.approx(2.0)
    assert result.gait.frequency_hz.value == pytest.approx(0.5, abs=1e-9)
    assert result.gait.wave == "head-to-tail"
    assert result.gait.lag_per_joint_rad == {"horizontal": pytest.approx(-np.pi / 3)}
    assert {joint.samples for joint in result.joints} == {1200}  # 12 s at 100 Hz, half-open
    assert (result.session.verdict, result.session.robot) == ("good", "snake25")


def test_energies_and_their_units(result):
    for joint in result.joints:
        assert joint.energy_el_j == pytest.approx(12.0)  # 0.5 A at 2 V over 12 s
        assert joint.energy_el_clipped_j == pytest.approx(12.0)
        # torque = 0.5 q', so the net energy is the absolute one: 0.5 (A omega)^2 / 2 a second.
        net = 0.25 * (0.3 * OMEGA) ** 2 * 12.0 if joint.plane == "horizontal" else 0.0
        assert joint.energy_net_j == pytest.approx(net, rel=1e-5)
        assert joint.energy_abs_j == pytest.approx(net, rel=1e-5)
        assert joint.coverage == pytest.approx(1.0)


def test_the_body_moves_as_its_null(result):
    """Perfect servos in viscous drag: the measured motion is the viscous null."""
    assert result.body.plane == "horizontal"
    assert result.provenance.options["drag_ratio"] == pytest.approx(6.0)
    for seen, null in zip(result.body.observed, result.body.null["viscous"], strict=True):
        assert seen.link == null.link
        assert seen.amplitude_m.value == pytest.approx(null.amplitude_m.value, rel=0.003)
        assert seen.phase_rad.value == pytest.approx(null.phase_rad.value, abs=0.003)
        low, high = seen.amplitude_m.ci95
        assert low <= seen.amplitude_m.value <= high
    free = result.body.null["free"][2].phase_rad.value
    assert abs(free - result.body.observed[2].phase_rad.value) > 0.05


def test_perfect_joints_show_no_heterogeneity(result):
    indices = result.heterogeneity
    assert indices["common_response"].p > 0.01
    assert indices["gain_cv"].value < 1e-4
    assert indices["lag_sd"].value < 1e-4
    assert indices["equivalence_gain"].p < 1e-6
    assert indices["module_share"].value is None
    assert any("record the reverse" in text for text in result.notes)
    assert result.coupling.identifiable is False


def test_weaker_middle_joints_show(tmp_path):
    robot = load_robot("snake25")
    place = np.abs(np.arange(25) - 12) / 12
    result = analysed(write_twin(tmp_path / "weak.mcap", lag=0.25 - 0.1 * place, odometry=False))
    contrast = result.heterogeneity["boundary_contrast_lag"]
    # The first and last joint lag by 0.15; the middle five yaw joints are 0, 2 and 4 from joint 13.
    middle = 0.25 - 0.1 * np.mean([4, 2, 0, 2, 4]) / 12
    assert contrast.value == pytest.approx(0.15 - middle, abs=1e-4)
    assert contrast.ci95[1] < 0
    assert result.heterogeneity["common_response"].p < 1e-6
    assert len(robot.joints) == len(result.joints)
    assert result.body is None
    assert any("no head pose on /odom" in text for text in result.notes)


def test_the_twins_own_ledger_is_the_judge(tmp_path):
    # 13 joints of 0.25 (A omega)^2 W each, and 25 W electrical, which the ledger books as 20 W.
    mechanical = 13 * 0.25 * (0.3 * OMEGA) ** 2
    path = write_twin(tmp_path / "booked.mcap", ledger=(mechanical, 20.0), odometry=False)
    (warning,) = [text for text in analysed(path).warnings if "ledger" in text]
    assert warning.startswith("electrical energy is 300 J from the samples but 240 J")


def test_accumulated_powers_are_preferred_and_their_absence_is_stated_once(tmp_path, result):
    assert result.energy.unknown == (
        "mechanical energies are products of sampled torque and velocity and electrical energies "
        "are products of sampled voltage and current: what these do within a sampling interval is "
        "not in the log, so the error is unknown"
    )
    assert not any("interval is not in the log" in text for text in result.warnings)
    mechanical = {"mechanical": -0.5, "mechanical_plus": 0.25}
    result = analysed(write_twin(tmp_path / "m.mcap", powers=mechanical, odometry=False))
    assert "mechanical energies" not in result.energy.unknown
    for joint in result.joints:
        energies = joint.energy_net_j, joint.energy_plus_j, joint.energy_abs_j, joint.energy_el_j
        assert energies == pytest.approx((-6.0, 3.0, 12.0, 12.0))  # 0.5 A at 2 V
    both = mechanical | {"electrical": 1.5, "electrical_plus": 1.75}
    result = analysed(write_twin(tmp_path / "b.mcap", powers=both, odometry=False))
    assert result.energy.unknown is None
    assert [joint.energy_el_j for joint in result.joints] == pytest.approx([18.0] * 25)
    assert [joint.energy_el_clipped_j for joint in result.joints] == pytest.approx([21.0] * 25)


def test_a_change_of_gait_splits_the_session(tmp_path):
    path = write_twin(tmp_path / "two.mcap", duration=22.0, change=1000, odometry=False)
    result = analysed(path)
    # 2 to 10 s are four cycles; from 10 s on it settles for 2 s and leaves five.
    assert result.gait.fitted.start_s == pytest.approx(12.0)
    assert any("the gait changes: of 2 windows" in text for text in result.warnings)
    assert [round(gait.start_s) for gait in result.gaits] == [2, 12]
    assert result.joints[0].command_amplitude_rad == pytest.approx(0.24)
    first = analysed(path, Options(stop_s=10.0))
    assert first.joints[0].command_amplitude_rad == pytest.approx(0.3)
    early = analysed(path, Options(start_s=1.0, stop_s=10.0))
    assert early.gait.fitted.start_s == pytest.approx(1.0)


def test_two_driven_planes(tmp_path):
    result = analysed(write_twin(tmp_path / "both.mcap", planes=(Plane.HORIZONTAL, Plane.VERTICAL)))
    assert all(joint.gain.value == pytest.approx(1.0, abs=1e-3) for joint in result.joints)
    assert {"gain_cv_horizontal", "gain_cv_vertical"} <= set(result.heterogeneity)
    assert set(result.gait.lag_per_joint_rad) == {"horizontal", "vertical"}
    assert result.body is None
    assert any("both planes are driven" in text for text in result.notes)


def test_the_json_object(twin, report_of):
    printed = report_of("analyse", twin)
    parts = {"session", "gait", "joints", "body", "heterogeneity", "coupling", "warnings"}
    assert parts <= set(printed)
    assert {"id", "robot", "duration_s", "verdict"} <= set(printed["session"])
    assert {"frequency_hz", "windows"} <= set(printed["gait"])
    assert [joint["name"] for joint in printed["joints"]] == [f"joint{i:02d}" for i in range(1, 26)]
    keys = {"name", "plane", "gain", "gain_ci95", "lag_rad", "lag_ci95", "coverage", "flags"}
    keys |= {"energy_net_j", "energy_plus_j", "energy_abs_j", "energy_el_j"}
    assert all(keys <= set(joint) for joint in printed["joints"])
    driven = printed["joints"][0]
    assert driven["gain_ci95"][0] < driven["gain"] < driven["gain_ci95"][1]
    assert driven["lag_ci95"][0] < driven["lag_rad"] < driven["lag_ci95"][1]
    assert (printed["joints"][1]["gain"], printed["joints"][1]["gain_ci95"]) == (None, None)
    assert {"value", "ci95", "p"} <= set(printed["heterogeneity"]["gain_cv"])
    assert printed["coupling"]["identifiable"] is False
    assert len(printed["provenance"]["inputs"][str(twin)]) == 64


def test_the_first_line_is_the_answer_and_the_last_the_method(twin, command):
    lines = command("analyse", twin).out.splitlines()
    assert lines[0].startswith("twin.mcap: The segments move alike: all 13 joints are within 2 %")
    assert lines[1].startswith("13 of 25 joints respond to a gait of 0.5")
    assert any(line.startswith("joint25  horizontal") for line in lines)
    assert "Method: harmonic least squares" in "\n".join(lines[-4:])


def test_files_and_options_of_the_verb(twin, tmp_path, command):
    out = tmp_path / "result.json"
    assert f"Result: {out}" in command("analyse", twin, twin, "-o", out).out
    assert len(json.loads(out.read_text())["sessions"]) == 2
    assert "exists already" in command("analyse", twin, "-o", out, code=2).err
    command("analyse", twin, "-o", out, "--force", "--stop", "9")
    assert json.loads(out.read_text())["gait"]["fitted"]["stop_s"] == pytest.approx(9.0)
    assert list(tmp_path.iterdir()) == [out]
    for wrong, why in (
        ((), "needs at least one session"),
        ((twin, "-o", tmp_path / "x.txt"), "end its name in .json"),
        ((twin, "--start", "400"), "nothing between --start and --stop"),
    ):
        assert why in command("analyse", *wrong, code=2).err
    topics = ("--command-topic", "/a", "--response-topic", "/b")
    assert (
        "has no /a; it has /joint_commands, /joint_states (choose with --command-topic"
        in command("analyse", twin, *topics, code=1).err
    )


def test_a_session_cut_before_it_settled_is_answered_with_a_warning(
    twin, tmp_path, report_of, opened
):
    stop = float(opened(twin).metadata["undulog"]["settle_s"]) + 5.5  # 2.75 cycles, of 3.75 in all
    result = report_of("analyse", twin, "--stop", stop)
    assert result["gait"]["frequency_hz"] == pytest.approx(0.5, abs=1e-3)
    assert any("before it has settled" in warning for warning in result["warnings"])
