"""Sessions of known truth, written with a foreign writer (mcap-ros2-support), not with ours;
results built by hand; experiments with a linear chain."""

import zlib

import numpy as np
import pytest

from support import built_results, linear_chain
from support.analysed import analysed, experiment
from support.joint_runs import write_joints
from support.written_sessions import joint_state, write_foreign

EPOCH_NS = 1_735_689_600_123_456_789


@pytest.fixture(autouse=True)
def _own_draws(request):
    """Begin a module's ``RNG`` anew for each test, by its name: it draws the same if run alone."""
    if (rng := getattr(request.module, "RNG", None)) is not None:
        seed = zlib.crc32(request.node.name.encode())
        rng.bit_generator.state = np.random.default_rng(seed).bit_generator.state


class Bag:
    """A ROS 2 bag of JointStates."""

    def __init__(self, path):
        self.path, self.messages = path, []

    def write(self, topic, t_ns, names, *fields):
        values = zip(("position", "velocity", "effort"), fields, strict=False)
        content = {name: np.asarray(field, dtype=float).tolist() for name, field in values}
        self.messages.append((topic, int(t_ns), joint_state(int(t_ns), list(names), **content)))

    def write_both(self, t_ns, names, command, *response):
        """Write a command and the state at the same time."""
        self.write("/joint_commands", t_ns, names, command)
        self.write("/joint_states", t_ns, names, *response)

    def close(self):
        write_foreign(self.path, self.messages)

    def analysed(self, options=None):
        """Close the bag and analyse it."""
        self.close()
        return analysed(self.path, options)


@pytest.fixture
def bag(tmp_path):
    """Opens bags by name; each is written when it is closed."""
    return lambda name="run.mcap": Bag(tmp_path / name)


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
        since_ns = np.rint(np.arange(round(duration * rate)) / rate * 1e9)
        self.ticks_ns = EPOCH_NS + since_ns.astype(np.int64)

    def command(self, t_ns):
        return self.amplitude * np.sin(self.omega * ((t_ns - EPOCH_NS) * 1e-9) + self.phase) + 0.05

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


HOSTILE = "<script>alert('x')</script>$\\frac{a}{b$\x00&\"蛇"


@pytest.fixture(scope="session")
def snake():
    """25 joints, 13 yaw joints driven, like the twin with weak servos."""
    return built_results.make_snake()


@pytest.fixture(scope="session")
def hostile():
    """Names that try to leave their place in the markup."""
    return built_results.make_snake(path=HOSTILE, rename=lambda text: HOSTILE + text)


@pytest.fixture(scope="session")
def still():
    """No gait, no robot, everything null."""
    return built_results.make_still()


@pytest.fixture(scope="session")
def single():
    """One driven joint whose plane is unknown."""
    return built_results.make_single()


@pytest.fixture(scope="session")
def recorded(snake, tmp_path_factory):
    """A session of the snake: commands and responses follow the analysis to the letter."""
    path = tmp_path_factory.mktemp("session") / "weak.mcap"
    names = [joint.name for joint in snake.joints]
    phase = np.pi * np.arange(1601)[:, None] / 100 - np.pi / 6 * np.arange(25)
    amplitude = np.array([joint.command_amplitude_rad or 0.0 for joint in snake.joints])
    gain = np.array([joint.gain.value or 0.0 for joint in snake.joints])
    lag = np.array([joint.lag_rad.value or 0.0 for joint in snake.joints])
    position = amplitude * gain * np.sin(phase - lag)
    position[1400, 0] = np.nan
    when = {"rate_hz": 100, "epoch_ns": built_results.START_NS}
    return write_joints(path, names, amplitude * np.sin(phase), [position], **when)


@pytest.fixture(scope="session")
def both_ways_files(tmp_path_factory):
    """Six runs each way, in turn."""
    return linear_chain.both_ways(tmp_path_factory.mktemp("ways"))


@pytest.fixture(scope="session")
def both_ways(both_ways_files):
    """A wave and its reverse; the second joint is weak."""
    return experiment(both_ways_files)


@pytest.fixture(scope="session")
def kicked(tmp_path_factory):
    """Every joint's command kicked in phase and amplitude, and a pattern held out."""
    return experiment(linear_chain.kicked(tmp_path_factory.mktemp("kicks")))


@pytest.fixture(scope="session")
def swept(tmp_path_factory):
    """A lag sweep: the commands of the runs are the columns of a DFT."""
    return experiment(linear_chain.swept(tmp_path_factory.mktemp("sweep")))
