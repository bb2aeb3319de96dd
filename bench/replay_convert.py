"""Time, size and memory of converting a session for the viewer.

``python bench/replay_convert.py [MINUTES]`` writes a session of 25 joints at 100 Hz (commands,
states with velocity and torque, current, voltage, odometry, gait; encoder noise 3 mrad), converts
it in a fresh process and prints what that took. Ten minutes by default.
"""

import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from capture import SessionWriter, load_robot
from capture.robot import Plane

CONVERT = """
import resource, sys, time
from pathlib import Path
from capture import Session
from replay import write_recording
start = time.perf_counter()
with Session.open(sys.argv[1]) as session:
    write_recording(session, Path(sys.argv[2]))
peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
print(f"{time.perf_counter() - start:.1f} s, peak memory {peak:.0f} MB", end=", ")
"""


def write_session(path: Path, minutes: float) -> None:
    """Write the session."""
    robot = load_robot("snake25")
    names = robot.joint_names
    yaw = robot.joint_indices(Plane.HORIZONTAL)
    rng = np.random.default_rng(0)
    t = np.arange(round(minutes * 6000)) / 100.0
    phase = np.pi * t
    wave = phase[:, None] - np.arange(len(yaw)) * np.pi / 3
    command, position, velocity, effort = (np.zeros((len(t), len(names))) for _ in range(4))
    command[:, yaw] = 0.4 * np.sin(wave)
    position[:, yaw] = 0.38 * np.sin(wave - 0.15)
    position += 0.003 * rng.standard_normal(position.shape)
    velocity[:, yaw] = 0.38 * np.pi * np.cos(wave - 0.15)
    effort[:, yaw] = 0.1 * np.cos(wave + 0.5)
    head = np.stack([0.25 * t, 0.05 * np.sin(phase), np.full_like(t, 0.025)], axis=1)
    turn = 0.2 * np.sin(phase + 1.0)
    epoch_ns = 1_735_689_600_000_000_000
    with SessionWriter(path, session_id="bench", epoch_ns=epoch_ns, robot=robot) as w:
        commands = w.joint_state("/joint_commands", names, unit="rad")
        states = w.joint_state("/joint_states", names, unit="rad", velocity=True, effort=True)
        current = w.joint_state("/joint_current", names, unit="A")
        voltage = w.joint_state("/joint_voltage", names, unit="V")
        gait = w.joint_state("/gait", ["horizontal.A", "horizontal.phase"], unit="rad")
        odometry = w.odometry("/odom", frame="world", child="link01")
        for i, t_ns in enumerate((epoch_ns + np.round(t * 1e9).astype(np.int64)).tolist()):
            commands.write(t_ns, command[i])
            states.write(t_ns, position[i], velocity[i], effort[i])
            current.write(t_ns, effort[i])
            voltage.write(t_ns, 6.0 * effort[i])
            gait.write(t_ns, np.array([0.4, phase[i]]))
            heading = np.array([0.0, 0.0, np.sin(turn[i] / 2), np.cos(turn[i] / 2)])
            odometry.write(t_ns, head[i], heading, np.zeros(3), np.zeros(3))


def main(minutes: float) -> None:
    """Write, convert three times, print."""
    with tempfile.TemporaryDirectory() as folder:
        log, recording = Path(folder) / "bench.mcap", Path(folder) / "bench.rrd"
        write_session(log, minutes)
        print(f"{minutes:g} min, 25 joints at 100 Hz, {log.stat().st_size / 1e6:.0f} MB of MCAP")
        for _ in range(3):
            command = [sys.executable, "-c", CONVERT, str(log), str(recording)]
            done = subprocess.run(command, check=True, capture_output=True, text=True)
            print(f"{done.stdout}{recording.stat().st_size / 1e6:.0f} MB of .rrd")


if __name__ == "__main__":
    main(float(sys.argv[1]) if len(sys.argv) > 1 else 10.0)
