"""The twin fitted to sessions of twins whose parameters are hidden, and to a real servo."""

import math
import signal
from contextlib import contextmanager
from types import SimpleNamespace

import numpy as np
import pytest

from support.paths import TRACE
from support.twin_fits import colored, fitted, rewritten, room_for
from undulog.capture import load_robot
from undulog.capture.common.process import StopRequest
from undulog.replay.calibrate.identifiability import ridges
from undulog.replay.calibrate.lack_of_fit import misfit
from undulog.replay.calibrate.least_squares import LeastSquares, LinearFit, memory
from undulog.replay.calibrate.parameters import Unknown
from undulog.replay.calibrate.solve import solve
from undulog.replay.commands import fit as cli
from undulog.sim.scenario.scenario_file import load_scenario

AIR = """description = "One joint in the air."
robot = "arcsnake-joint"
duration_s = 9.0
[gait.horizontal]
amplitude = 0.1
frequency_hz = 0.5
lag = 0.0
[world]
gravity = [0.0, 0.0, 0.0]
surface = "none"
"""


def assert_true_or_open(parameters, truth):
    """Within 3 % or undetermined, and in the interval."""
    for key, value in truth.items():
        parameter = parameters[key]
        low, high = parameter["ci95"]
        assert low <= value <= high, parameter
        assert not parameter["determined"] or parameter["value"] == pytest.approx(
            value, rel=0.03
        ), parameter


def assert_narrow(parameter, within=0.03):
    """The noise leaves it within this share; the physics step widens the other end."""
    value, (low, high) = parameter["value"], parameter["ci95"]
    assert min(value - low, high - value) <= within * value, parameter


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    hidden = "[servo]\nstall_torque = 0.33\ncoulomb_friction = 0.025\n"
    return room_for(tmp_path_factory.mktemp("small"), 3, 4.5, hidden, noise=0.001)


TWO = ("--only", "stall_torque", "--only", "coulomb_friction", "--within", "0.03")


@pytest.mark.nightly
def test_hidden_parameters_of_three_joints_come_out(small, tmp_path, report_of):
    output, world = tmp_path / "fitted.toml", tmp_path / "world.toml"
    report, parameters = fitted(small, report_of, *TWO, "-o", str(output), "--scenario", str(world))
    assert_true_or_open(
        parameters, {("stall_torque", None): 0.33, ("coulomb_friction", None): 0.025}
    )
    assert_narrow(parameters["stall_torque", None])
    assert report["converged"]
    assert report["rms_rad"]["after"] == pytest.approx(0.001, rel=0.05)  # the encoders' noise
    assert report["rms_rad"]["before"] > report["rms_rad"]["after"]
    assert report["residual_memory_samples"] < 2.0
    servo = load_robot(output).joints[1].servo
    assert servo.stall_torque == parameters["stall_torque", None]["value"]
    assert servo.gear_stiffness == 12.0  # what wasn't fitted stays
    assert "[defaults.servo]  # of the data sheet\n" in output.read_text()
    again = load_scenario(str(world))
    assert (again.robot.joints[0].servo, again.duration_s) == (servo, pytest.approx(4.5))


@pytest.mark.nightly
def test_a_dead_time_is_reported_and_not_written(small, tmp_path, report_of):
    late_s = 0.012
    late_ns = round(late_s * 1e9)
    rewritten(small / "run.mcap", tmp_path / "late.mcap", lambda t, rows: (t + late_ns, rows))
    for name in ("robot.toml", "nominal.toml"):
        (tmp_path / name).write_text((small / name).read_text())
    words = (*TWO, "--delay", "--settle", "1.5", "-o", str(tmp_path / "fitted.toml"))
    _, parameters = fitted(tmp_path, report_of, *words, source="late.mcap")
    low, high = parameters["delay", None]["ci95"]
    assert low <= late_s <= high
    assert high - low < 0.004


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("-o a.json", "end its name in .toml"),
        ("-o a.toml --scenario a.toml", "that is the robot's file"),
        ("-o a.toml --only stal_torque", "expected one of stall_torque"),
        ("-o a.toml --module joint9", "joint01, joint02, joint03"),
        ("-o a.toml --module joint01 --modules", "give one of them"),
        ("-o a.toml --on can:x", "expected twin or twin:SCENARIO"),
        ("-o a.toml --spread 3", "--spread 3"),
        ("-o a.toml --within 0", "--within 0"),
        ("-o a.toml --settle 60", "is --settle too long?"),
        ("-o a.mine.toml", "--force"),
    ],
)
def test_wrong_usage_says_what_would_be_right(small, tmp_path, words, message, command):
    mine = tmp_path / "a.mine.toml"
    mine.write_text("mine")
    words = words.replace("a.", f"{tmp_path}/a.").split()
    code = 1 if "--settle" in words else 2
    assert message in command("sim", "fit", small / "run.mcap", *words, code=code).err
    assert (list(tmp_path.iterdir()), mine.read_text()) == ([mine], "mine")


@pytest.mark.slow
def test_an_interrupted_fit_leaves_nothing(small, tmp_path, monkeypatch, command):
    @contextmanager
    def interrupted():
        request = StopRequest()
        request.signal = signal.SIGINT
        yield request

    monkeypatch.setattr(cli, "interruptible", interrupted)
    words = ("sim", "fit", small / "run.mcap", "-o", tmp_path / "a.toml")
    assert "nothing is written" in command(*words, code=1).err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.nightly
def test_a_weak_module_is_found_among_hidden_parameters(tmp_path, report_of):
    hidden = """[servo]
stall_torque = 0.345
proportional_gain = 6.8
coulomb_friction = 0.024
[servo_of.joint04]
stall_torque = 0.276
[world.ground]
mu_tangential = 0.06
mu_normal = 0.42
"""
    room = room_for(tmp_path, 5, 8.0, hidden)
    world = tmp_path / "fitted-world.toml"
    words = ["--modules", "--within", "0.03", "--scenario", str(world)]
    report, parameters = fitted(room, report_of, *words, "-o", str(tmp_path / "fitted.toml"))
    assert (report["search"]["named"], report["search"]["module"]) == (True, "joint04")
    truth = {"stall_torque": 0.345, "proportional_gain": 6.8, "coulomb_friction": 0.024}
    truth |= {"viscous_friction": 0.005, "gear_stiffness": 12.0, "gear_damping": 0.008}
    truth |= {"mu_tangential": 0.06, "mu_normal": 0.42}
    assert_true_or_open(parameters, {(name, None): value for name, value in truth.items()})
    assert_true_or_open(parameters, {("stall_torque", "joint04"): 0.8})
    # Short of full voltage a servo's viscous friction acts as its back EMF does.
    ridge = next(
        ridge["factors"] for ridge in report["ridges"] if "stall torque" in ridge["factors"]
    )
    assert "viscous friction" in ridge
    assert {"viscous friction", "gear damping"} <= set(report["undetermined"])
    again = load_scenario(str(world))
    weak, sound = again.robot.joints[3].servo, again.robot.joints[0].servo
    factor = parameters["stall_torque", "joint04"]["value"]
    assert weak.stall_torque == pytest.approx(factor * sound.stall_torque)
    assert again.world.ground.mu_normal == parameters["mu_normal", None]["value"]


@pytest.mark.nightly
def test_full_voltage_parts_stall_torque_gain_and_friction(tmp_path, report_of):
    """What the slow wave above leaves open, as it says itself."""
    hidden = "[servo]\nstall_torque = 0.345\nproportional_gain = 6.8\nviscous_friction = 0.006\n"
    room = room_for(tmp_path, 5, 8.0, hidden, gait=(0.5, 2.5))
    words = ["--within", "0.03", "-o", str(tmp_path / "fitted.toml")]
    report, parameters = fitted(room, report_of, *words)
    names = ("stall_torque", "proportional_gain", "viscous_friction")
    truth = dict(zip(names, (0.345, 6.8, 0.006), strict=True))
    assert_true_or_open(parameters, {(name, None): value for name, value in truth.items()})
    assert_narrow(parameters["stall_torque", None])
    assert not any("stall torque" in ridge["factors"] for ridge in report["ridges"])


@pytest.mark.nightly
def test_with_the_rest_known_servo_and_ground_are_within_three_percent(tmp_path, report_of):
    hidden = """[servo]
stall_torque = 0.27
proportional_gain = 9.0
coulomb_friction = 0.035
[world.ground]
mu_tangential = 0.045
mu_normal = 0.56
"""
    room = room_for(tmp_path, 5, 14.0, hidden, seed=0)
    names = ("stall_torque", "proportional_gain", "coulomb_friction", "mu_tangential", "mu_normal")
    words = [word for name in names for word in ("--only", name)]
    words += ["--modules", "--within", "0.03", "-o", str(tmp_path / "fitted.toml")]
    report, parameters = fitted(room, report_of, *words)
    assert not report["search"]["named"]  # no module differs
    truth = dict(zip(names, (0.27, 9.0, 0.035, 0.045, 0.56), strict=True))
    assert_true_or_open(parameters, {(name, None): value for name, value in truth.items()})
    assert_narrow(parameters["stall_torque", None])
    assert_narrow(parameters["proportional_gain", None])


@pytest.mark.nightly
def test_a_real_ramp_gives_a_lag_and_no_servo(tmp_path, report_of, command):
    """A motor at constant speed, in the air: one lag for six parameters."""
    if not TRACE.is_file():
        pytest.skip(f"the real recording {TRACE.name} is not beside this checkout")
    command("import", TRACE, "--robot", "arcsnake-joint", "-o", tmp_path / "arc.mcap")
    (tmp_path / "nominal.toml").write_text(AIR)
    words = ("--settle", "1", "-o", str(tmp_path / "f.toml"))
    report, parameters = fitted(tmp_path, report_of, *words, source="arc.mcap")
    assert not any(parameter["determined"] for parameter in parameters.values())
    assert report["rms_rad"]["after"] < report["rms_rad"]["before"]
    assert report["rms_rad"]["after"] < 0.002  # of a way of 17 rad; 0.0036 if held by the ticks
    assert not report["fits"]  # the twin isn't this servo
    assert load_robot(tmp_path / "f.toml").bus is not None  # its DBC files lie beside it


def test_the_memory_of_noise_is_that_of_its_closed_form():
    random = np.random.default_rng(3)
    assert memory([random.standard_normal(20000) for _ in range(3)]) == pytest.approx(1.0, abs=0.1)
    rho = 0.8
    noise = random.standard_normal((3, 40000))
    for k in range(1, noise.shape[1]):
        noise[:, k] += rho * noise[:, k - 1]
    assert memory(list(noise)) == pytest.approx((1 + rho) / (1 - rho), rel=0.1)


@pytest.mark.parametrize("rho", [0.0, 0.6, 0.9])
def test_scores_of_coloured_noise_vary_as_its_spectrum_says(rho):
    """J = cos(w t): the sum of n samples varies by n/2 times the spectrum at w."""
    n, w = 40000, 2 * np.pi * 0.01
    noise = colored(np.random.default_rng(4), rho, n)
    column = np.cos(w * np.arange(n))[:, None]
    got = LeastSquares([column], [noise], np.ones(1), np.ones(1)).scores()
    spectrum = (1 - rho**2) / abs(1 - rho * np.exp(-1j * w)) ** 2
    assert got[0, 0] == pytest.approx(n / 2 * spectrum, rel=0.1)


@pytest.mark.parametrize("shared", [False, True])
def test_scores_of_noise_that_joints_share_add_up(shared):
    """Of r equal columns: r times the variance where noise is each joint's, r^2 where shared."""
    random, n, joints = np.random.default_rng(6), 20000, 5
    column = np.cos(0.06 * np.arange(n))[:, None]
    noise = random.standard_normal((joints, n))
    noise[1:] = noise[0] if shared else noise[1:]
    rest = list(noise)
    got = LeastSquares([column] * joints, rest, np.ones(joints), np.ones(1)).scores()
    assert got[0, 0] == pytest.approx((joints**2 if shared else joints) * n / 2, rel=0.1)


def test_one_more_parameter_is_that_of_least_squares():
    random = np.random.default_rng(7)
    columns, rest = random.standard_normal((2, 50, 3)), random.standard_normal((2, 50))
    problem = LeastSquares(list(columns[..., :2]), list(rest), np.full(2, 0.5), np.full(2, 1e-9))
    fitted = LinearFit(problem, np.zeros(2)).extended(list(columns[..., 2]), 1e5)
    expected = np.linalg.lstsq(columns.reshape(100, 3), rest.reshape(100))[0]
    np.testing.assert_allclose(fitted.x, expected, atol=1e-8)
    left = rest.reshape(100) - columns.reshape(100, 3) @ expected
    np.testing.assert_allclose(np.concatenate(fitted.problem.residuals), left, atol=1e-8)
    assert fitted.problem.squares == pytest.approx(float(left @ left) / 0.25)


@pytest.mark.nightly
@pytest.mark.parametrize(("n", "rho"), [(300, 0.0), (300, 0.8), (1000, 0.9)])
def test_intervals_of_a_linear_model_cover(n, rho):
    """Three joints, four parameters whose columns are two harmonics of three or ten cycles."""
    random = np.random.default_rng(5)
    t, joints, count, runs = np.arange(n) * 0.01, np.arange(3.0), 4, 600
    prior, inside = np.full(count, 4.0), 0
    for _ in range(runs):
        waves = [2 * np.pi * k * t[:, None] - k * joints for k in (1, 3)]
        base = np.stack([f(wave) for wave in waves for f in (np.cos, np.sin)], axis=-1)
        mixed = random.standard_normal((4, count)) * np.array([1.0, 1.0, 0.1, 0.1])[:, None]
        columns = list(np.moveaxis(0.02 * base @ mixed, 1, 0))
        columns = [column - column.mean(axis=0) for column in columns]
        truth = 0.5 * random.standard_normal(count)
        noise = 0.005 * colored(random, rho, 3, n)
        measured = [c @ truth + e - e.mean() for c, e in zip(columns, noise, strict=True)]
        solution = solve_linear(columns, measured, prior)
        half = 1.96 * np.sqrt(np.diag(solution[1]))
        inside += int((np.abs(solution[0] - truth) <= half).sum())
    assert inside / (runs * count) == pytest.approx(0.95, abs=0.02)


def solve_linear(columns, measured, prior):
    """The fit's own iteration, of a model whose derivatives never change."""

    class Model:
        def __init__(self):
            self.measured = SimpleNamespace(angles=tuple(measured))

        def at(self, _wanted, x):
            return tuple(column @ x for column in columns)

        def near(self, unknowns, points):
            return (self.at(unknowns, x) for x in points)

    unknowns = [Unknown(f"p{k}", "1", 1.0, p**-0.5) for k, p in enumerate(prior.tolist())]
    solution = solve(Model(), unknowns)
    assert solution.converged
    return solution.x, solution.covariance


def test_a_ridge_is_the_direction_that_keeps_the_outputs():
    """Only the product of two parameters is known."""
    pair = [Unknown(name, "1", 2.0, 0.5) for name in ("stall_torque", "proportional_gain")]
    (ridge,) = ridges(pair, np.linalg.inv(1e6 * np.ones((2, 2)) + np.eye(2) / 0.25))
    up, down = ridge.factors.values()
    assert up * down == pytest.approx(1.0)
    assert math.log(max(up, down)) == pytest.approx(0.5 / math.sqrt(2))
    assert ridge.left == pytest.approx(1.0)
    assert ridges(pair, np.linalg.inv(1e6 * np.eye(2))) == ()


def test_gain_and_lateness_of_a_sine():
    t = np.arange(0.0, 4.0, 0.01)
    twin = 0.3 * np.sin(2 * np.pi * t)
    difference = misfit(t, 1.05 * 0.3 * np.sin(2 * np.pi * (t - 0.004)), twin)
    assert difference.gain == pytest.approx(0.05, abs=1e-3)
    assert difference.late_s == pytest.approx(0.004, rel=1e-2)
    assert misfit(t, twin, 0.0 * t).gain is None
