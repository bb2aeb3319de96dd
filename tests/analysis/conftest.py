"""Sessions of known truth, written with a foreign writer (mcap-ros2-support), not with ours."""

import numpy as np
import pytest
from mcap_ros2.writer import Writer

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
