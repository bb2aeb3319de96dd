"""A batch against runs of the twin on MuJoCo, one by one, and against mechanics."""

import dataclasses
import math
import os
import pickle
import re
from contextlib import closing

import numpy as np
import pytest

from support.processes import python
from support.twin_runs import simulate
from undulog.capture.common.errors import SimulationError
from undulog.capture.robot.model import Plane
from undulog.sim import FrictionLaw, Ground, PlaneGait, Serpentine, World, load_scenario, run_batch
from undulog.sim.gait.contract import Readings
from undulog.sim.gait.wave import SerpentineGait
from undulog.sim.scenario.obstacles import Cylinder
from undulog.sim.scenario.scenario import EngineKind, Kernels
from undulog.sim.scenario.scenario_file import scenario_names
from undulog.sim.scenario.world import Push
from undulog.sim.twin.twin import Plant

pytestmark = pytest.mark.slow  # the first of them waits for its compiler, half a minute

LAWS = [FrictionLaw.TRANSETH, FrictionLaw.ELLIPSE, FrictionLaw.BOX, FrictionLaw.VISCOUS, None]


def on_mujoco(scenario):
    """Return the samples of the twin on MuJoCo, under the compiled laws."""
    single = dataclasses.replace(scenario, engine=EngineKind.MUJOCO)
    return simulate(single, kernels=Kernels.NUMBA)


def angles(samples):
    return np.array([sample.step.body.angle for sample in samples])


def response(angle, command, frequency_hz, cycles):
    """Gain and lag [rad] of each column over the last whole cycles, by projection."""
    count = round(100 * cycles / frequency_hz)
    wave = np.exp(-2j * np.pi * frequency_hz * np.arange(count) / 100)
    ratio = (wave @ angle[-count:]) / (wave @ command[-count:])
    return np.abs(ratio), -np.angle(ratio)


def with_law(scenario, law):
    ground = None if law is None else Ground(law=law, drag_tangential=0.2, drag_normal=2.0)
    return dataclasses.replace(scenario, world=dataclasses.replace(scenario.world, ground=ground))


@pytest.fixture(scope="module")
def weak():
    return load_scenario("weak-servo-pi3").changed(duration_s=1.0)


@pytest.fixture
def uneven(make_uneven, make_scenario):
    """A scenario whose links, servos and limits differ, driven in both planes."""
    planes = {
        Plane.HORIZONTAL: PlaneGait(0.4, 0.7, 1.0, offset=0.05),
        Plane.VERTICAL: PlaneGait(0.1, 1.0, 0.5, phase=0.3),
    }
    return make_scenario(
        make_uneven(6),
        gait=Serpentine(planes, ramp_s=0.5),
        world=World(gravity=(0.4, -0.2, -9.6), heading=0.7, velocity=(0.1, -0.05, 0.02)),
    )


def short(scenario, joints):
    """The same run of the first joints of its robot."""
    robot = scenario.robot
    robot = dataclasses.replace(
        robot, links=robot.links[: joints + 1], joints=robot.joints[:joints], sensors=()
    )
    return dataclasses.replace(scenario, robot=robot)


@pytest.mark.nightly
def test_angles_are_those_of_the_twin_on_mujoco_under_every_law(weak):
    scenarios = [
        with_law(short(weak, joints), law) for law in LAWS for joints in (5, len(weak.robot.joints))
    ]
    for scenario, run in zip(scenarios, run_batch(scenarios), strict=True):
        expected = angles(on_mujoco(scenario))
        assert run.error is None
        # The bar is 1e-6 of the amplitude, 0.4 rad.
        np.testing.assert_allclose(run.angle, expected, atol=1e-12)


@pytest.mark.nightly
def test_gain_and_lag_over_5_s_are_those_of_the_twin_on_mujoco(weak):
    scenario = weak.changed(duration_s=5.0)
    (run,) = run_batch([scenario])
    yaw = scenario.robot.joint_indices(Plane.HORIZONTAL)
    expected = response(angles(on_mujoco(scenario))[:, yaw], run.command[:, yaw], 0.5, 1)
    measured = response(run.angle[:, yaw], run.command[:, yaw], 0.5, 1)
    np.testing.assert_allclose(measured, expected, atol=1e-11)  # the bar is 1e-5


@pytest.mark.nightly
def test_single_precision_keeps_gain_and_lag_within_a_thousandth(weak):
    scenario = weak.changed(duration_s=5.0)
    yaw = scenario.robot.joint_indices(Plane.HORIZONTAL)
    double, single = (
        response(run.angle[:, yaw], run.command[:, yaw], 0.5, 1)
        for dtype in (np.float64, np.float32)
        for run in run_batch([scenario], dtype=dtype)
    )
    error = np.abs(np.array(single) - np.array(double)).max(axis=1)
    print(f"float32: gain within {error[0]:.1e}, lag within {error[1]:.1e} rad")
    assert (error > 0).all()
    assert error.max() < 1e-3


@pytest.mark.nightly
@pytest.mark.parametrize("law", LAWS)
def test_everything_of_an_uneven_robot_in_both_planes_is_the_twins(uneven, law):
    scenario = with_law(uneven, law)
    (run,) = run_batch([scenario])
    samples = on_mujoco(scenario)
    body = [sample.step.body for sample in samples]
    assert run.command == pytest.approx(
        np.array([sample.gait.command for sample in samples]), abs=1e-15
    )
    assert run.angle == pytest.approx(np.array([state.angle for state in body]), abs=1e-11)
    assert run.rate == pytest.approx(np.array([state.rate for state in body]), abs=1e-9)
    assert run.head == pytest.approx(np.array([state.position[:, 0] for state in body]), abs=1e-11)
    velocity = np.array([state.velocity[:, 0] for state in body])
    assert run.head_velocity == pytest.approx(velocity, abs=1e-9)
    turned = (run.head_quaternion * np.array([state.quaternion[:, 0] for state in body])).sum(
        axis=1
    )
    assert np.abs(turned) == pytest.approx(np.ones(len(body)), abs=1e-12)
    mass = np.array([link.mass for link in scenario.robot.links])
    centre = np.array([state.position @ mass / mass.sum() for state in body])
    assert run.centre_of_mass == pytest.approx(centre, abs=1e-11)
    work = np.array([sample.joint_energy[[0, 2, 3, 4]] for sample in samples]).swapaxes(0, 1)
    assert run.work == pytest.approx(work, abs=1e-9)
    polled = [joint for sample in samples for joint in sample.sensed]  # means around each tick
    for name in ("effort", "current", "voltage"):
        expected = np.array([getattr(sample, name) for sample in polled])
        assert getattr(run, name)[: len(expected)] == pytest.approx(expected, abs=1e-9)


@pytest.mark.nightly
def test_every_open_loop_scenario_without_a_lateral_instability_is_the_twins():
    # Those in the vertical plane alone are unstable sideways: rounding decides when they leave it.
    names = [
        name
        for name in scenario_names()
        if set(load_scenario(name).gait.planes) != {Plane.VERTICAL}
        and load_scenario(name).controller is None
        and name != "oscillators-feedback"
    ]
    scenarios = [load_scenario(name).changed(duration_s=0.3) for name in names]
    for scenario, run in zip(scenarios, run_batch(scenarios), strict=True):
        np.testing.assert_allclose(run.angle, angles(on_mujoco(scenario)), atol=1e-12)


def test_a_run_does_not_depend_on_those_beside_it(weak, uneven):
    short_weak = short(weak.changed(duration_s=0.2), 5)
    others = [
        with_law(
            dataclasses.replace(
                uneven,
                duration_s=0.2,
                world=dataclasses.replace(uneven.world, heading=0.1 * i),
                gait=Serpentine({Plane.HORIZONTAL: PlaneGait(0.01 * i, 0.5, 1.0)}),
            ),
            LAWS[i % 2],
        )
        for i in range(40)
    ]
    many = run_batch([*others[:17], short_weak, *others[17:]])
    for scenario, run in ((short_weak, many[17]), (others[0], many[0]), (others[39], many[40])):
        assert run.scenario is scenario
        (alone,) = run_batch([scenario])
        for field in dataclasses.fields(alone)[2:]:
            assert np.array_equal(getattr(alone, field.name), getattr(run, field.name)), field.name


def momenta(run):
    """Momentum, angular momentum and kinetic energy of a chain in its plane, by k ticks."""
    links = run.scenario.robot.links
    half = np.array([link.length / 2 for link in links])
    mass = np.array([link.mass for link in links])
    about_z = np.array([link.inertia[2] for link in links])
    yaw = 2 * np.arctan2(run.head_quaternion[:, 2], run.head_quaternion[:, 3])
    heading = yaw[:, None] + np.cumsum(np.pad(run.angle, ((0, 0), (1, 0))), axis=1)
    turning = run.head_spin[:, 2:] + np.cumsum(np.pad(run.rate, ((0, 0), (1, 0))), axis=1)
    along = np.exp(1j * heading)  # the plane's vectors as complex numbers
    steps = -(half[:-1] * along[:, :-1] + half[1:] * along[:, 1:])
    moves = -1j * (half[:-1] * (along * turning)[:, :-1] + half[1:] * (along * turning)[:, 1:])
    head = run.head[:, :2] @ [1, 1j], run.head_velocity[:, :2] @ [1, 1j]
    place, velocity = (
        start[:, None] + np.cumsum(np.pad(part, ((0, 0), (1, 0))), axis=1)
        for start, part in zip(head, (steps, moves), strict=True)
    )
    angular = (mass * (place.conj() * velocity).imag + about_z * turning).sum(axis=1)
    energy = (mass * np.abs(velocity) ** 2 + about_z * turning**2).sum(axis=1) / 2
    return velocity @ mass, angular, energy


def test_a_free_planar_chain_keeps_its_momenta_and_its_energy_is_the_joints_work(
    make_robot, make_scenario
):
    robot = make_robot(6, planar=True)
    world = World(gravity=(0.0, 0.0, 0.0), ground=None, heading=0.3, velocity=(0.2, -0.1, 0.0))
    drift = []
    for rate_hz in (4000, 16000):
        scenario = make_scenario(
            robot, frequency_hz=2.0, ramp_s=0.2, world=world, physics_rate_hz=rate_hz
        )
        (run,) = run_batch([scenario])
        assert run.error is None
        momentum, angular, energy = momenta(run)
        assert np.ptp(energy) > 1e-3
        assert np.abs(run.angle).max() > 0.1
        gained = energy - energy[0] - run.work[0].sum(axis=1)
        drift.append(
            [
                np.abs(momentum - momentum[0]).max() / np.abs(momentum[0]),
                np.abs(angular - angular[0]).max() / (robot.total_mass * 0.36 * 0.2),
                np.abs(gained).max() / np.ptp(energy),
            ]
        )
    # The integrator's own error, of first order in the step.
    assert max(drift[1]) < 2e-3
    np.testing.assert_allclose(np.array(drift[0]) / drift[1], 4.0, rtol=0.2)


def test_a_run_that_fails_ends_alone_with_its_time_and_place(weak, make_scenario):
    robot = weak.robot
    stiff = [
        dataclasses.replace(joint, servo=dataclasses.replace(joint.servo, gear_stiffness=4e4))
        for joint in robot.joints
    ]
    broken = dataclasses.replace(weak, robot=dataclasses.replace(robot, joints=tuple(stiff)))
    flying = dataclasses.replace(
        weak, world=World(ground=None, velocity=(9.5, 0.0, 0.0), gravity=(0.0, 0.0, -9.81))
    )
    fine, first, second = run_batch([weak, broken, flying])
    assert fine.error is None
    np.testing.assert_array_equal(fine.angle, run_batch([weak])[0].angle)
    with pytest.raises(SimulationError) as single:
        on_mujoco(broken)
    when = [
        float(re.search(r"at ([0-9.]+) s", str(error))[1]) for error in (first.error, single.value)
    ]
    assert when[0] == pytest.approx(when[1], abs=1.1e-3)  # the twin looks at each axis by itself
    assert re.search(r"link\d+ moves at|the servo of joint\d+ turns at", str(first.error))
    assert "gear_stiffness is too stiff" in str(first.error)
    assert len(first.angle) == len(first.head) < 20
    assert np.isfinite(first.angle).all()
    # sqrt(9.5^2 + (9.81 t)^2) = 10 at t = 0.318 s.
    at_s = math.sqrt(10**2 - 9.5**2) / 9.81
    assert f"failed at {math.ceil(1e3 * at_s) / 1e3:.3f} s" in str(second.error)
    assert "link" in str(second.error)
    assert len(second.angle) == math.ceil(100 * at_s)


def test_given_commands_run_as_the_gait_that_gives_them(weak):
    """Also those of a scenario whose own gait a batch can't run."""
    (by_gait,) = run_batch([weak])
    adaptive = load_scenario("oscillators-feedback")
    driven = dataclasses.replace(weak, gait=adaptive.gait)
    (run,) = run_batch([driven], commands=[by_gait.command])
    for name in ("angle", "effort", "work", "head"):
        np.testing.assert_array_equal(getattr(run, name), getattr(by_gait, name))
    with pytest.raises(ValueError, match=r"expected \d+ ticks of"):
        run_batch([weak], commands=[by_gait.command[:-1]])


def test_commands_within_control_periods_are_those_of_the_twins_plant(weak):
    """Ten parts of a period: as the plant steps them, and held ones bit for bit as from ticks."""
    weak = dataclasses.replace(weak.changed(duration_s=0.3), engine=EngineKind.MUJOCO)
    (whole,) = run_batch([weak])
    held = np.repeat(whole.command, 10, axis=0)
    ramp = held + 0.02 * np.sin(np.arange(len(held)))[:, None]
    same, driven = run_batch([weak, weak], commands=[held, ramp])
    np.testing.assert_array_equal(same.angle, whole.angle)
    np.testing.assert_array_equal(driven.command, ramp[::10])
    angles = [np.zeros(ramp.shape[1])]
    with closing(Plant(weak, Kernels.NUMBA)) as plant:
        for tick in range(weak.tick_count - 1):
            plant.command(ramp[10 * tick])
            steps = plant.advance(ramp[10 * tick : 10 * tick + 10])
            angles.append(steps.motion[-1, 0])
    assert np.abs(driven.angle - whole.angle).max() > 1e-4
    np.testing.assert_allclose(driven.angle, angles, atol=1e-12)
    with pytest.raises(ValueError, match="equal parts of them that divide 10 steps"):
        run_batch([weak], commands=[held[: len(held) // 10 * 3]])


def test_what_a_batch_cannot_run_is_refused_by_name(weak):
    pushed = dataclasses.replace(
        weak,
        disturbances=(Push(weak.robot.links[3].name, (1.0, 0.0, 0.0), 0.1, 0.1),),
        world=dataclasses.replace(weak.world, obstacles=(Cylinder((1.0, 0.0), 0.1, 0.2),)),
    )
    with pytest.raises(ValueError, match=r"it has world\.obstacles, disturbances"):
        run_batch([weak, pushed])
    with pytest.raises(ValueError, match="controller"):
        run_batch([load_scenario("avoidance")])
    with pytest.raises(ValueError, match=r"gait\.horizontal\.feedback"):
        run_batch([load_scenario("oscillators-feedback")])
    with pytest.raises(ValueError, match="int64: use float64 or float32"):
        run_batch([weak], dtype=np.int64)
    assert run_batch([]) == ()


def test_commands_of_many_ticks_are_those_of_one_after_the_other(uneven):
    times_s = np.arange(400) / 100
    gait = SerpentineGait(uneven.gait, uneven.robot)
    unknown = Readings.nothing(uneven.robot)
    expected = [gait.step(time_s, unknown).command for time_s in times_s.tolist()]
    np.testing.assert_allclose(gait.commands(times_s), expected, rtol=0, atol=1e-15)


GPU = """
import pickle, sys
import numpy as np
from undulog.sim import run_batch

runs = pickle.load(open(sys.argv[1], "rb"))
done = run_batch(runs, device="cuda", dtype=sys.argv[3])
np.savez(sys.argv[2], *[part for one in done for part in (one.angle, one.work, one.head)])
"""


@pytest.mark.nightly
@pytest.mark.parametrize("law", [FrictionLaw.ELLIPSE, None])
def test_threads_of_a_gpu_step_as_a_core_does(uneven, law, tmp_path):
    """By numba's simulator of a GPU, which runs the kernel and its copies thread by thread.

    Contact begins and ends within a step, and magnifies rounding.
    """
    scenario = with_law(uneven, law).changed(duration_s=0.12)
    runs = [
        scenario,
        dataclasses.replace(scenario, world=dataclasses.replace(scenario.world, heading=1.2)),
    ]
    (tmp_path / "runs").write_bytes(pickle.dumps(runs))
    environment = os.environ | {"NUMBA_ENABLE_CUDASIM": "1", "NUMBA_DISABLE_JIT": "1"}
    python(GPU, tmp_path / "runs", tmp_path / "done.npz", "float64", env=environment, code=0)
    expected = [part for run in run_batch(runs) for part in (run.angle, run.work, run.head)]
    assert abs(expected[0][-1]).max() > 1e-3
    with np.load(tmp_path / "done.npz") as outputs:
        for name, part in zip(outputs.files, expected, strict=True):
            np.testing.assert_allclose(
                outputs[name], part, rtol=0, atol=1e-13 if law is None else 1e-7
            )


def test_a_machine_without_gpu_says_so(weak):
    with pytest.raises(ValueError, match="device cuda: no NVIDIA GPU"):
        run_batch([weak], device="cuda")
    with pytest.raises(ValueError, match="device tpu: use cpu or cuda"):
        run_batch([weak], device="tpu")
