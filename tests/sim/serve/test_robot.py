"""The virtual robot in one process with its controller: lockstep, the start, faults at work."""

import dataclasses
import math
import os
import threading
from contextlib import ExitStack, closing

import can
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from support.can_messages import can_message, frames_of
from support.processes import wait_for
from support.simulated_clock import SimulatedClock
from support.twin_runs import sensed, simulate
from undulog.capture import load_robot
from undulog.capture.bus.decoding import BusDecoder
from undulog.capture.bus.encoding import BusEncoder
from undulog.capture.common.process import StopRequest
from undulog.capture.log.messages.frames import ERROR_FLAG
from undulog.capture.robot.description import parse_robot
from undulog.capture.robot.model import Direction, Quantity
from undulog.sim.gait.contract import CONTROL_RATE_HZ, GaitTick
from undulog.sim.physics.sensing import JointSample
from undulog.sim.scenario.bus_faults import parse_faults
from undulog.sim.scenario.sensors import Noise, SensorModels, ServoPolling
from undulog.sim.serve.pacing import PATIENCE_NS, Pacer
from undulog.sim.serve.reply_frames import FaultLine, ReplyEncoder
from undulog.sim.serve.robot import PERIOD_NS, VirtualRobot
from undulog.sim.serve.socketcand_server import SocketcandServer, VirtualBus

JOINTS = 4
STEP = math.radians(0.01)


@pytest.fixture(scope="module")
def robot():
    """Five links with the frames of the shipped robot's first four joints."""
    whole = load_robot("snake25")
    joints = "".join(
        f'  {{ name = "joint0{i + 1}", plane = "{("horizontal", "vertical")[i % 2]}" }},\n'
        for i in range(JOINTS)
    )
    text = whole.toml
    chain = text[text.index("joints = [") : text.index("[defaults.link]")]
    text = text.replace(chain, f"joints = [\n{joints}]\n\n")
    sensors = text[text.index("# Sharp GP2Y0A02") : text.index("# The paper names no bus")]
    text = text.replace(sensors, "")
    lines = [line for line in text.splitlines() if '"ranges_' not in line]
    lines = [line for line in lines if "acceleration" not in line and "magnetic" not in line]
    return parse_robot("\n".join(lines), "short.toml", dict(whole.databases))


@pytest.fixture(scope="module")
def scenario(make_scenario, robot):
    sensing = SensorModels(servo=ServoPolling(0.0005, STEP, command_resolution=STEP))
    return make_scenario(robot, duration_s=0.5, noise=Noise(position=0.001), sensing=sensing)


class Running:
    """A virtual robot in a thread, and python-can's client of its bus."""

    def __init__(self, scenario, *, fast=True, **options):
        self.events = []
        self.server = SocketcandServer("127.0.0.1", 0, "can0", self.log_event)
        self.bus = VirtualBus(self.server, None, self.log_event)
        self.stop = StopRequest()
        self.pacer = Pacer(PERIOD_NS, fast=fast)
        self.robot = VirtualRobot(
            scenario, self.bus, self.pacer, log_event=self.log_event, stop=self.stop, **options
        )
        self.served = None
        self.ready = threading.Event()
        self.thread = threading.Thread(target=self.run)
        self.thread.start()
        assert self.ready.wait(60)
        self.client = can.Bus(
            interface="socketcand", host="127.0.0.1", port=self.server.address[1], channel="can0"
        )
        self.encoder = BusEncoder(scenario.robot, Direction.TX)

    def log_event(self, level, text):
        self.events.append(text)

    def run(self):
        try:
            self.served = self.robot.run(self.ready.set)
        finally:
            self.ready.set()

    def command(self, angles):
        values = {(f"joint0{i + 1}", Quantity.COMMAND, ""): angle for i, angle in enumerate(angles)}
        for frame in self.encoder.encode(values):
            self.client.send(can_message(frame))

    def replies(self, count):
        messages = [self.client.recv(60) for _ in range(count)]
        assert all(messages)
        return frames_of(messages)

    def ended(self):
        self.thread.join(60)
        assert not self.thread.is_alive()
        return self.served

    def close(self):
        self.stop.signal = 15
        self.thread.join(60)
        self.client.shutdown()
        self.bus.close()


@pytest.fixture
def running():
    with ExitStack() as made:
        yield lambda *args, **options: made.enter_context(closing(Running(*args, **options)))


def positions(robot, frames, quantity=Quantity.POSITION):
    """What frames of one cycle tell, by default angles, in the order of the joints."""
    samples, _ = BusDecoder(robot).decode(frames)
    (chosen,) = [sample for sample in samples if sample.signals[0].quantity is quantity]
    order = [robot.joint_names.index(chosen.signals[k].target) for k in chosen.member]
    angles = np.full(JOINTS, np.nan)
    angles[order] = chosen.values
    return angles


def answer(angle, tick):
    """A controller: straighten what it sees, and wave."""
    seen = np.where(np.isnan(angle), 0.0, angle)
    return np.clip(-0.5 * seen + 0.2 * math.sin(0.1 * tick), -0.4, 0.4)


class Controller:
    """The same as a gait."""

    names = ()

    def step(self, time_s, readings):
        command = answer(readings.angle, round(time_s * CONTROL_RATE_HZ))
        return GaitTick(command, np.empty(0), "test", ())


@pytest.mark.slow
def test_a_loop_closed_over_the_bus_in_lockstep_is_the_loop_in_process(scenario, robot, running):
    truth = [sample.position for sample in sensed(scenario, Controller())]
    live = running(scenario, lockstep=True)
    unknown = np.full(JOINTS, np.nan)
    replies = []
    for tick in range(scenario.tick_count):
        if tick >= 2:
            replies.append(live.replies(JOINTS))
        live.command(answer(positions(robot, replies[-1]) if replies else unknown, tick))
    replies += [live.replies(JOINTS), live.replies(JOINTS)]
    served = live.ended()
    assert (served.complete, served.commands) == (True, JOINTS * scenario.tick_count)
    angles = np.array([positions(robot, frames) for frames in replies])
    np.testing.assert_allclose(angles, truth, rtol=0, atol=1e-12)
    times = np.array([frames["t_device_ns"].astype(np.int64) for frames in replies])
    expected = PERIOD_NS * np.arange(len(replies))[:, None] + 500_000 * np.arange(JOINTS)
    expected[-1] = expected[-1, 0]  # the end of the run has no turns any more
    assert np.array_equal(times - times[0, 0], expected)


def test_commands_in_steps_are_the_same_in_process(scenario):
    commands = np.array([sample.gait.command for sample in simulate(scenario)])
    np.testing.assert_allclose(np.rint(commands / STEP) * STEP, commands, rtol=0, atol=1e-15)
    assert len(np.unique(commands[:, 0])) > 20


@pytest.mark.clock(0.02, "python-can and the kernel's buffers run on the computer's clock")
def test_it_waits_for_the_first_command_and_then_keeps_time(scenario, robot, running):
    live = running(scenario.changed(duration_s=0.3), fast=False, wait=True)
    started_ns = live.pacer.now_ns()
    wait_for(lambda: live.pacer.now_ns() > started_ns + 300_000_000, "a while")
    assert live.pacer.tally.ticks == 0
    before = live.pacer.now_ns()
    live.command([0.1] * JOINTS)
    served = live.ended()
    assert served.complete
    assert -1_000_000 < served.start_ns - before - PERIOD_NS // 2 < 30_000_000
    resting, first = [], live.replies(JOINTS)
    while int(first["t_device_ns"][0]) < served.start_ns:
        resting.append(first)
        first = live.replies(JOINTS)
    for frames in resting:  # straight, whatever it has been commanded by then
        np.testing.assert_array_equal(positions(robot, frames), np.zeros(JOINTS))
    # The last pose at rest is sent at tick 1, the first cycle at tick 2.
    times = np.array([int(reply["t_device_ns"][0]) for reply in resting])
    assert times[-1] == served.start_ns - 1000
    assert (np.diff(times) > 0).all()
    frames = np.concatenate([first, live.replies(30 * JOINTS)])
    cycles = frames["t_device_ns"].reshape(-1, JOINTS).astype(np.int64) - served.start_ns
    stood_still = round(served.pace.stood_still_s * 1e9)
    assert cycles[0, 0] == 0
    assert cycles[-1, 0] <= 30 * PERIOD_NS + stood_still + 1000
    assert any("starts at" in text for text in live.events)


def test_without_commands_it_holds_still_and_says_whose_commands_are_missing(scenario, running):
    live = running(scenario.changed(duration_s=0.5), lockstep=True)
    live.command([0.0] * (JOINTS - 1))
    wait_for(lambda: "waits for commands of joint04" in live.events, live.events)
    live.stop.signal = 15
    served = live.ended()
    assert (served.complete, served.duration_s) == (False, 0.0)


def test_silence_of_the_controller_is_reported_and_so_is_its_return(scenario, running):
    live = running(scenario.changed(duration_s=30.0), fast=False, wait=True)

    def until(part):
        wait_for(lambda: any(part in text for text in live.events), live.events)

    live.command([0.6] * JOINTS)
    until("no command for 0.5 s: joint01, joint02, joint03, joint04 hold their angles")
    live.command([0.1] * JOINTS)
    until("commands are back")
    until("joint01 was commanded beyond its limits, and stops there")


# -- pacing ----------------------------------------------------------------------------------


def test_a_tick_that_comes_much_too_late_leaves_a_gap_and_no_time_goes_back():
    simulated = SimulatedClock()
    pacer = Pacer(PERIOD_NS, clock=simulated.clock)
    pacer.start(pacer.now_ns())
    start, late_s = pacer.start_ns, 2 * PATIENCE_NS * 1e-9
    for tick in range(12):
        while (wait_s := pacer.wait_s(tick)) > 0.0:
            simulated.clock.sleep(wait_s)
        if tick == 10:
            simulated.pass_s(late_s)
        assert pacer.begin(tick) == (pytest.approx(late_s) if tick == 10 else 0.0)
    assert (pacer.tally.ticks, pacer.tally.overruns) == (12, 1)
    assert pacer.tally.worst_s == pacer.tally.stood_still_s == pytest.approx(late_s)
    times = np.array([pacer.clock_ns(k * PERIOD_NS) for k in range(13)])
    gaps = np.full(12, PERIOD_NS)
    gaps[4] += 2 * PATIENCE_NS  # before what is on its way by then
    np.testing.assert_array_equal(np.diff(times), gaps)
    assert (times[0], start % 1000) == (start, 0)
    assert pacer.clock_ns(12 * PERIOD_NS + 7_000_000) == times[12] + 7_000_000


@given(st.lists(st.floats(0.0, 0.04), max_size=60))
def test_a_twin_that_is_little_late_catches_up(work_s):
    simulated = SimulatedClock()
    pacer = Pacer(PERIOD_NS, clock=simulated.clock)
    pacer.start(pacer.now_ns())
    before = 0
    for tick, work in enumerate(work_s):
        while (wait_s := pacer.wait_s(tick)) > 0.0:
            simulated.clock.sleep(wait_s)
        pacer.begin(tick)
        now_ns = pacer.clock_ns(tick * PERIOD_NS)
        assert pacer.now_ns() - PATIENCE_NS <= now_ns < pacer.now_ns() + 1000  # whole us
        assert tick == 0 or now_ns >= before + PERIOD_NS
        before = now_ns
        simulated.pass_s(work)


def test_a_twin_that_is_slower_than_real_time_gives_its_priority_back():
    def policy():
        return os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK

    simulated = SimulatedClock()
    before = policy(), os.getpriority(os.PRIO_PROCESS, 0)
    pacer = Pacer(PERIOD_NS, clock=simulated.clock)
    try:
        raised = pacer.raise_priority()
        assert (policy() == os.SCHED_RR) == (raised == "SCHED_RR 1")
        pacer.start(pacer.now_ns())
        simulated.pass_s(2 * PATIENCE_NS * 1e-9)
        assert pacer.begin(0) > PATIENCE_NS * 1e-9
        assert (policy() == os.SCHED_RR) == (raised == "SCHED_RR 1")
        simulated.pass_s(1.0)
        assert pacer.begin(1) > 0.9
        assert (policy(), os.getpriority(os.PRIO_PROCESS, 0)) == before
    finally:
        pacer.lower_priority()


def test_a_fast_clock_shows_simulated_time():
    pacer = Pacer(PERIOD_NS, fast=True)
    pacer.start(123)
    for tick in range(5):
        assert (pacer.wait_s(tick), pacer.begin(tick)) == (0.0, 0.0)
        assert pacer.now_ns() == pacer.clock_ns(tick * PERIOD_NS) == tick * PERIOD_NS
    assert pacer.tally.overruns == 0


# -- faults ----------------------------------------------------------------------------------


def cycles(robot, line, count):
    """What the bus shows of so many polling cycles, by tick."""
    encoder = ReplyEncoder(robot)
    rng = np.random.default_rng(1)
    shown = []
    for tick in range(count):
        sample = JointSample(tick, np.zeros(JOINTS), *rng.uniform(-0.5, 0.5, (5, JOINTS)))
        time_s = tick / CONTROL_RATE_HZ
        frames = encoder.frames(line.samples([sample], time_s), lambda t: t)
        shown.append(line.replies(frames, tick * PERIOD_NS, time_s))
    return shown


def fault_line(robot, *texts, seed=1):
    return FaultLine(parse_faults(texts, robot), robot, ReplyEncoder(robot), seed)


def test_without_faults_nothing_is_changed(robot):
    shown = cycles(robot, fault_line(robot), 5)
    assert [frames["id_flags"].tolist() for frames in shown] == [[513, 514, 515, 516]] * 5


@pytest.mark.slow
def test_lost_replies_are_those_of_the_joint_in_the_share_that_was_ordered(robot):
    line = fault_line(robot, "lost:joint02:0.3")
    shown = np.concatenate(cycles(robot, line, 2000))
    counts = {k: int((shown["id_flags"] == k).sum()) for k in (513, 514, 515, 516)}
    assert counts[513] == counts[515] == counts[516] == 2000
    assert counts[514] == 2000 - line.lost
    # 5 standard deviations of the binomial distribution
    assert abs(line.lost - 600) < 5 * math.sqrt(2000 * 0.3 * 0.7)
    again = np.concatenate(cycles(robot, fault_line(robot, "lost:joint02:0.3"), 2000))
    other = np.concatenate(cycles(robot, fault_line(robot, "lost:joint02:0.3", seed=2), 2000))
    assert again.tobytes() == shown.tobytes()
    assert other.tobytes() != shown.tobytes()
    sizes = [len(frames) for frames in cycles(robot, fault_line(robot, "lost:1@0.5+0.25"), 100)]
    assert sizes == [4] * 50 + [0] * 25 + [4] * 25


def test_noise_makes_error_frames_and_every_frame_gets_through(robot):
    line = fault_line(robot, "noise:0.2")
    shown = np.concatenate(cycles(robot, line, 1000))
    errors = (shown["id_flags"] & ERROR_FLAG) != 0
    assert int(errors.sum()) == line.hit
    assert shown["id_flags"][~errors].tolist() == [513, 514, 515, 516] * 1000
    # attempts until the first success: p / (1 - p) failures a frame on average
    assert abs(line.hit - 1000) < 5 * math.sqrt(4000 * 0.2 / 0.8**2)


def test_delayed_frames_keep_their_times_and_their_order(robot):
    shown = cycles(robot, fault_line(robot, "delay:0.02@0.05+0.03"), 20)
    assert [len(frames) for frames in shown] == [4] * 5 + [0, 0, 4, 8, 8] + [4] * 10
    times = np.concatenate(shown)["t_device_ns"] // PERIOD_NS
    assert sorted(times.tolist()) == np.repeat(np.arange(20), 4).tolist()
    assert shown[7]["t_device_ns"].tolist() == [5 * PERIOD_NS] * 4


def test_off_the_bus_the_robot_neither_sends_nor_receives(robot):
    line = fault_line(robot, "bus-off@0.05+0.1")
    shown = cycles(robot, line, 30)
    assert [len(frames) for frames in shown] == [4] * 5 + [1] + [0] * 9 + [5] + [4] * 14
    assert shown[5]["id_flags"].tolist() == [ERROR_FLAG | 0x40]
    assert shown[15]["id_flags"].tolist() == [ERROR_FLAG | 0x100, 513, 514, 515, 516]
    assert [line.is_receiving(t) for t in (0.04, 0.05, 0.14, 0.15)] == [True, False, False, True]


def test_a_frozen_encoder_sends_its_last_angle_and_a_stuck_servo_holds_it(robot):
    line = fault_line(robot, "frozen:joint03@0.1", "stuck:joint01@0.1+0.1")
    angles = np.array([positions(robot, frames) for frames in cycles(robot, line, 30)])
    assert (len(np.unique(angles[:10, 2])), len(np.unique(angles[10:, 2]))) == (10, 1)
    assert len(np.unique(angles[:, 0])) == 30
    command, angle = np.full(JOINTS, 0.3), np.full(JOINTS, 0.1)
    assert line.command(command, angle, 0.05).tolist() == [0.3] * 4
    assert line.command(command, angle, 0.10).tolist() == [0.1, 0.3, 0.3, 0.3]
    assert line.command(-command, angle + 1, 0.15).tolist() == [0.1, -0.3, -0.3, -0.3]
    assert line.command(-command, angle, 0.20).tolist() == [-0.3] * 4


def test_a_servo_that_draws_too_much_says_so_and_nothing_else_is_changed(robot):
    clean, struck = (
        cycles(robot, fault_line(robot, *faults), 30)
        for faults in ((), ("over-current:joint02:1.5@0.1+0.1",))
    )
    for quantity in (Quantity.POSITION, Quantity.VELOCITY, Quantity.EFFORT, Quantity.CURRENT):
        angles, expected = (
            np.array([positions(robot, frames, quantity) for frames in shown])
            for shown in (struck, clean)
        )
        if quantity is Quantity.CURRENT:
            expected[10:20, 1] = 1.5
        np.testing.assert_array_equal(angles, expected)


def test_a_stuck_servo_does_not_follow_its_commands(scenario, robot, running):
    stuck = parse_faults(["stuck:joint01@0.2"], robot)
    quiet = dataclasses.replace(scenario.changed(duration_s=1.0), noise=Noise())
    live = running(quiet, lockstep=True, faults=stuck)
    for tick in range(quiet.tick_count):
        live.command([0.3 * math.sin(0.1 * tick), 0.0, 0.3 * math.sin(0.1 * tick), 0.0])
    frames = live.replies(JOINTS * quiet.tick_count).reshape(-1, JOINTS)
    angles = np.array([positions(robot, frame) for frame in frames])
    assert np.ptp(angles[40:, 0]) < 0.1 * np.ptp(angles[40:, 2])
