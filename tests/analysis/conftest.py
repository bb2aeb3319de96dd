"""Sessions of known truth, written with a foreign writer (mcap-ros2-support), not with ours; and
results built by hand: a snake with weak servos, one joint, and a session without a gait."""

import math

import numpy as np
import pytest
from mcap_ros2.writer import Writer

from analysis.results.analysis import (
    Analysis,
    BodyPoint,
    BodyResult,
    Coupling,
    Estimate,
    GaitFacts,
    Index,
    JointResult,
    Provenance,
    SessionFacts,
    Window,
)
from capture import SessionWriter

EPOCH_NS = 1_735_689_600_123_456_789

JOINT_STATE = """std_msgs/Header header
string[] name
float64[] position
float64[] velocity
float64[] effort
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""


class Bag:
    """A ROS 2 bag of JointStates."""

    def __init__(self, path):
        self.path = path
        self._file = path.open("wb")
        self._writer = Writer(self._file)
        self._schema = self._writer.register_msgdef("sensor_msgs/msg/JointState", JOINT_STATE)

    def write(self, topic, t_ns, names, *fields):
        t_ns = int(t_ns)
        position, velocity, effort = (*fields, (), (), ())[:3]
        self._writer.write_message(
            topic,
            self._schema,
            {
                "header": {
                    "stamp": {"sec": t_ns // 10**9, "nanosec": t_ns % 10**9},
                    "frame_id": "",
                },
                "name": list(names),
                "position": [float(v) for v in position],
                "velocity": [float(v) for v in velocity],
                "effort": [float(v) for v in effort],
            },
            log_time=t_ns,
            publish_time=t_ns,
        )

    def close(self):
        self._writer.finish()
        self._file.close()


@pytest.fixture
def bag(tmp_path):
    """Opens bags by name; all are closed at the end, or earlier with ``close``."""
    opened = []

    def open_bag(name="run.mcap"):
        opened.append(Bag(tmp_path / name))
        return opened[-1]

    return open_bag


@pytest.fixture
def epoch_ns():
    return EPOCH_NS


class Wave:
    """Joints that follow sine commands with known gain and lag, in white noise."""

    def __init__(self, rng, joints=25, frequency=0.97, duration=7.3, rate=100.0):
        self.names = [f"joint{i + 1:02d}" for i in range(joints)]
        self.omega = 2 * np.pi * frequency
        self.amplitude = rng.uniform(0.3, 0.5, joints)
        self.phase = rng.uniform(-np.pi, np.pi) - np.arange(joints) * np.pi / 3
        self.gain = rng.uniform(0.85, 1.1, joints)
        self.lag = rng.uniform(0.02, 0.4, joints)
        self.skew_s = np.linspace(0.0, 5e-3, joints)
        self.ticks_ns = EPOCH_NS + np.rint(np.arange(round(duration * rate)) / rate * 1e9).astype(
            np.int64
        )

    def command(self, t_ns):
        t = (t_ns - EPOCH_NS) * 1e-9
        return self.amplitude * np.sin(self.omega * t + self.phase) + 0.05

    def response(self, t_ns):
        """At one time a joint."""
        t = (np.asarray(t_ns) - EPOCH_NS) * 1e-9
        return self.gain * self.amplitude * np.sin(self.omega * t + self.phase - self.lag) + 0.04

    def bound(self, sigma):
        """Cramér-Rao bound of each lag for an exact command: sqrt(2 sigma^2 / (A^2 N))."""
        return sigma * np.sqrt(2 / self.ticks_ns.size) / (self.gain * self.amplitude)


@pytest.fixture
def wave():
    return Wave


RATE_HZ = 100
REPORT_EPOCH_NS = 1_767_225_600_000_000_000
HOSTILE = "<script>alert('x')</script>$\\frac{a}{b$\x00&\"蛇"


def around(value, half):
    return Estimate(value, (value - half, value + half))


def driven_joint(name, place, plane="horizontal", flags=()):
    """``place`` runs from 0 at the head to 1 at the tail; late and weak in the middle."""
    inside = math.sin(math.pi * place)
    lag = math.radians(7.46 + 6.2 * inside)
    net = -0.016 + 0.424 * inside
    return JointResult(
        name=name,
        plane=plane,
        command_amplitude_rad=0.4,
        gain=around(1.07 - 0.14 * inside + 0.01 * math.cos(9 * place), 0.0042),
        lag_rad=around(lag, math.radians(0.21)),
        energy_net_j=net,
        energy_plus_j=max(net, 0) + 0.05,
        energy_abs_j=abs(net) + 0.11,
        energy_el_j=net * 1.9 + 0.2,
        energy_el_clipped_j=max(net, 0) * 2.1 + 0.25,
        coverage=0.998,
        samples=800,
        flags=tuple(flags),
    )


def passive_joint(name, plane="vertical"):
    return JointResult(
        name=name,
        plane=plane,
        command_amplitude_rad=None,
        gain=Estimate(),
        lag_rad=Estimate(),
        energy_net_j=0.0021,
        energy_plus_j=0.004,
        energy_abs_j=0.0059,
        energy_el_j=None,
        energy_el_clipped_j=None,
        coverage=1.0,
        samples=800,
    )


def provenance(path):
    return Provenance(
        command=f"undulog analyse {path}",
        versions={"undulog": "0.1.0", "numpy": "2.4.6"},
        inputs={path: "9f" * 32},
        options={"harmonics": 1, "settle_s": None},
    )


def point(place, link, mm, deg):
    return BodyPoint(place, link, around(mm * 1e-3, 0.6e-3), around(math.radians(deg), 0.03))


def exact(place, link, mm, deg):
    return BodyPoint(place, link, Estimate(mm * 1e-3), Estimate(math.radians(deg)))


def make_snake(path="weak.mcap", rename=None, session_id="weak-servo-pi3-7f3a"):
    name = rename or (lambda text: text)
    joints = []
    for i in range(25):
        label = name(f"joint{i + 1:02d}")
        if i % 2 == 0:
            joints.append(driven_joint(label, i / 24, flags=("saturated",) if i == 12 else ()))
        else:
            joints.append(passive_joint(label))
    body = BodyResult(
        plane="horizontal",
        observed=(
            point("head", name("link01"), 52, 0),
            point("middle", name("link13"), 35, -128),
            point("tail", name("link26"), 30, 97),
        ),
        null={
            "viscous": (
                exact("head", name("link01"), 55, 0),
                exact("middle", name("link13"), 41, -117),
                exact("tail", name("link26"), 38, 110),
            ),
        },
    )
    indices = {
        "gain_cv": Index(0.0412, (0.0387, 0.0440), 0.0004, "1", "coefficient of variation of gain"),
        "lag_sd": Index(0.0371, (0.0352, 0.0391), 1e-7, "rad", "circular sd of lag"),
        "boundary_contrast_lag": Index(
            -0.1082, (-0.1134, -0.1030), None, "rad", "lag, ends minus middle"
        ),
        "energy_gini": Index(0.44, None, None, "1", "Gini coefficient of E_abs"),
    }
    return Analysis(
        session=SessionFacts(
            id=name(session_id),
            path=path,
            robot=name("snake25"),
            start_ns=1_767_225_600_000_000_000,
            duration_s=16.0,
            verdict="good",
        ),
        gait=GaitFacts(
            frequency_hz=around(0.5, 0.0002),
            windows=(Window(8.0, 16.0, 4.0),),
            wave="head-to-tail",
            lag_per_joint_rad={"horizontal": math.pi / 3},
        ),
        joints=tuple(joints),
        body=body,
        heterogeneity=indices,
        coupling=Coupling(
            identifiable=False,
            why="one gait gives 13 numbers for 169 unknowns",
            record="kicks of the phase and amplitude of one joint at a time: "
            "undulog plan phase-kicks -o DIR",
        ),
        warnings=(
            "Boundary and modules can't be told apart by one direction; record the reverse.",
            name("E_el of joint02 is null: the session has no /joint_current of it."),
        ),
        provenance=provenance(path),
    )


def make_still():
    nothing = Estimate()
    joints = tuple(
        JointResult(f"j{i}", None, None, nothing, nothing, None, None, None, None, None, 0.0, 0)
        for i in range(4)
    )
    return Analysis(
        session=SessionFacts("ramp", "ramp.mcap", None, 1_767_225_600_000_000_000, 3.0, None),
        gait=GaitFacts(nothing),
        joints=joints,
        body=None,
        heterogeneity={"gain_cv": Index(None, None, None, "1", "coefficient of variation of gain")},
        coupling=Coupling(False, "no gait was found", "a periodic gait of at least 5 cycles"),
        warnings=("No gait: the commands are a ramp, no line stands out of their spectrum.",),
        provenance=provenance("ramp.mcap"),
    )


def make_single():
    return Analysis(
        session=SessionFacts("bench", "servo.mcap", "bench1", 0, 21.0, "degraded"),
        gait=GaitFacts(around(1.25, 0.001), (Window(1.0, 21.0, 25.0),)),
        joints=(driven_joint("servo", 0.5, plane=None),),
        body=None,
        heterogeneity={},
        coupling=Coupling(False, "one joint has nobody to be coupled to"),
        warnings=(),
        provenance=provenance("servo.mcap"),
    )


@pytest.fixture(scope="session")
def snake():
    """25 joints, 13 yaw joints driven, like the twin with weak servos."""
    return make_snake()


@pytest.fixture(scope="session")
def hostile():
    """Names that try to leave their place in the markup."""
    return make_snake(path=HOSTILE, rename=lambda text: HOSTILE + text)


@pytest.fixture(scope="session")
def still():
    """No gait, no robot, everything null."""
    return make_still()


@pytest.fixture(scope="session")
def single():
    """One driven joint whose plane is unknown."""
    return make_single()


@pytest.fixture(scope="session")
def recorded(snake, tmp_path_factory):
    """A session of the snake: commands and responses follow the analysis to the letter."""
    path = tmp_path_factory.mktemp("session") / "weak.mcap"
    names = [joint.name for joint in snake.joints]
    amplitude = np.array([joint.command_amplitude_rad or 0.0 for joint in snake.joints])
    gain = np.array([joint.gain.value or 0.0 for joint in snake.joints])
    lag = np.array([joint.lag_rad.value or 0.0 for joint in snake.joints])
    with SessionWriter(path, session_id="s", epoch_ns=REPORT_EPOCH_NS) as writer:
        commands = writer.joint_state("/joint_commands", names, unit="rad")
        states = writer.joint_state("/joint_states", names, unit="rad")
        for k in range(16 * RATE_HZ + 1):
            phase = 2 * np.pi * 0.5 * k / RATE_HZ - np.pi / 6 * np.arange(25)
            position = amplitude * gain * np.sin(phase - lag)
            if k == 1400:
                position[0] = np.nan
            t_ns = REPORT_EPOCH_NS + k * (1_000_000_000 // RATE_HZ)
            commands.write(t_ns, amplitude * np.sin(phase))
            states.write(t_ns, position)
    return path
