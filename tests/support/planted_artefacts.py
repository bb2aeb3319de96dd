"""Sessions with artefacts planted at known times, and how a detector did on them."""

import numpy as np

from support.joint_runs import write_joints
from undulog.analysis.parts.artefacts.measure import find_artefacts
from undulog.analysis.signals.columns import read_columns
from undulog.capture import Session, load_robot

RATE_HZ = 100
DURATION_S = 20.0
OMEGA = np.pi  # 0.5 Hz
DRIVEN = range(0, 25, 2)


class Snake:
    """25 joints, the yaw joints driven: gain, lag, noise and encoder steps by the seed.

    Every quantity is an array of one row a sample, to be spoilt before it is written.
    """

    def __init__(self, seed, steps=(0.0, 2 * np.pi / 4096, 0.005)):
        rng = self.rng = np.random.default_rng(seed)
        self.robot = load_robot("snake25")
        self.t = np.arange(round(DURATION_S * RATE_HZ)) / RATE_HZ
        amplitude, gain = np.zeros(25), rng.uniform(0.8, 1.1, 25)
        amplitude[DRIVEN] = rng.uniform(0.2, 0.4)
        lag = rng.uniform(0.05, 0.5, 25)
        phase = OMEGA * self.t[:, None] - np.pi / 3 * np.arange(25) + rng.uniform(0, 6)
        self.command = amplitude * np.sin(phase)
        angle = gain * amplitude * np.sin(phase - lag) + rng.normal(0, 0.02, 25)
        rate = OMEGA * gain * amplitude * np.cos(phase - lag)
        self.step = rng.choice(steps)
        self.position = self.encoded(
            angle + rng.normal(0, rng.choice([0.0, 5e-4, 3e-3]), angle.shape)
        )
        self.velocity = rate + rng.normal(0, 0.01, rate.shape)
        self.effort = 0.1 * np.cos(phase - 0.3) + rng.normal(0, 0.002, rate.shape)

    def encoded(self, angle):
        """Return the angles as the encoders report them."""
        return np.round(angle / self.step) * self.step if self.step else angle

    def joint(self):
        """Draw a driven joint, as an index."""
        return int(self.rng.choice(DRIVEN))

    def span(self, shortest=1.0, longest=6.0):
        """Draw an interval inside the session: first sample and one past the last."""
        length = self.rng.uniform(shortest, longest)
        start = self.rng.uniform(2.0, DURATION_S - 2.0 - length)
        return round(start * RATE_HZ), round((start + length) * RATE_HZ)

    def write(self, path):
        """Write a session with the robot's description."""
        states = (self.position, self.velocity, self.effort)
        facts = {"robot": self.robot, "scenario": "[servo]\nstall_torque = 1.5\n"}
        names = self.robot.joint_names
        return write_joints(path, names, self.command, states, rate_hz=RATE_HZ, **facts)


def artefacts(path):
    """Return the artefacts that are found in a session."""
    with Session.open(path) as session:
        columns = read_columns(session, "/joint_commands", "/joint_states", lambda _: None)
        return find_artefacts(session, columns)


def overlap(spans, start_s, stop_s):
    """Return the intersection over union of time intervals with one interval."""
    inner = sum(max(0.0, min(b, stop_s) - max(a, start_s)) for a, b in spans)
    return inner / (sum(b - a for a, b in spans) + stop_s - start_s - inner)
