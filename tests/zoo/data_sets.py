"""Data sets for learning, simulated: robots, people who teach them, actuators, and planted faults.

An episode is a table of commands and states, one row a tick of the control loop. Ticks are 1 / fps
apart but for an episode whose rate is off: there they aren't, and the table doesn't show it.
"""

import json
from dataclasses import dataclass, replace

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

FINE = 8
"""Steps of the simulation in a tick."""

OFFSET, GAIN, DELAY, DROPPED, RATE = "offset", "gain", "delay", "dropped", "rate"
KINDS = (OFFSET, GAIN, DELAY, DROPPED, RATE)

ENOUGH_RAD = np.radians(8.0)
"""A joint with a planted fault is commanded to move so far: a smaller motion shows no gain."""


@dataclass(frozen=True)
class Robot:
    """Joints, their actuators, and how they are recorded.

    Attributes:
        lag_s: Time constants, shape (m,).
        delay_s: Shape (m,).
        play_rad: Full width of the backlash, shape (m,).
        sag_rad: Largest sag under gravity, shape (m,).
        gain: Shape (m,).
        noise_rad: Standard deviation of the sensors' noise.
        step_rad: Step of the encoders.
        hold: Ticks for which a command is held; 0: lines join the ticks.
        scatter: Standard deviations between episodes of offset [rad], gain, and lag [s].
    """

    motion: str
    fps: int
    lag_s: np.ndarray
    delay_s: np.ndarray
    play_rad: np.ndarray
    sag_rad: np.ndarray
    gain: np.ndarray
    noise_rad: float
    step_rad: float
    hold: int
    scatter: tuple[float, float, float]

    @property
    def joints(self):
        """Number of joints."""
        return self.lag_s.size


@dataclass(frozen=True)
class Fault:
    """What is planted in an episode.

    Attributes:
        joint: None for all joints.
        form: Of several ways to plant the kind.
    """

    kind: str
    episode: int
    joint: int | None = None
    form: str = ""
    size: float = 0.0


@dataclass(frozen=True)
class DataSet:
    """Commands and states of the episodes, [(n, m)] each [rad]."""

    robot: Robot
    actions: list[np.ndarray]
    states: list[np.ndarray]
    fault: Fault | None


def draw_robot(rng):
    """Return an arm, the upper body of a humanoid, or a snake."""
    motion, fps, joints = (
        ("pick", 30, 6),
        ("pick", int(rng.choice([30, 50])), int(rng.integers(14, 30))),
        ("gait", int(rng.choice([20, 50])), int(rng.integers(8, 17))),
    )[rng.integers(3)]
    spread = 0.25 * rng.random()

    def joint_values(low, high):
        middle = np.exp(rng.uniform(np.log(low), np.log(high)))
        return middle * np.exp(spread * rng.standard_normal(joints))

    return Robot(
        motion, fps,
        lag_s=joint_values(0.03, 0.15),
        delay_s=joint_values(0.02, 0.08),
        play_rad=np.radians(rng.choice([0.0, 1.2])) * rng.random(joints),
        sag_rad=np.radians(1.5) * rng.random(joints) * (motion == "pick"),
        gain=1 + 0.03 * rng.standard_normal(joints),
        noise_rad=float(np.radians(np.exp(rng.uniform(np.log(0.01), np.log(0.25))))),
        step_rad=float(2 * np.pi / rng.choice([4096, 16384])),
        hold=int(rng.choice([0, 1, 1, 2, 3])),
        scatter=(np.radians(0.15) * rng.random(), 0.004 * rng.random(), 0.0015 * rng.random()),
    )  # fmt: skip


def draw_count(rng, most=200):
    """Return a number of episodes."""
    return int(np.exp(rng.uniform(np.log(10), np.log(most))))


def taught(rng, robot, count, periods_s):
    """Return ways of a teacher through common places, changed in each episode.

    Minimum-jerk moves (Flash & Hogan, J. Neurosci. 5, 1985) with pauses and a tremor.

    Returns:
        The way of each episode, a function of time to (n, m), and its length [s].
    """
    stations = int(rng.integers(3, 8))
    places = rng.uniform(-1, 1, (stations, robot.joints)) * rng.uniform(0.2, 1.0, robot.joints)
    usual_s, tempo = rng.uniform(0.6, 2.0, stations), rng.uniform(0.02, 0.3)
    pause, tremor = rng.uniform(0.0, 0.8), np.radians(rng.uniform(0, 0.15))
    ways = []
    for period_s in periods_s:
        visited = places + rng.uniform(0.02, 0.25) * rng.standard_normal(places.shape)
        visited = np.concatenate([places[:1], visited, places[:1]])
        moves_s = np.concatenate([usual_s, usual_s[:1]]) * np.exp(
            tempo * rng.standard_normal(stations + 1)
        )
        rests_s = rng.exponential(pause, stations + 1) * (rng.random(stations + 1) < 0.6)
        starts_s = 0.5 + np.concatenate([[0], np.cumsum(moves_s + rests_s)])
        shaking = rng.uniform(6, 11), rng.uniform(0, 6.3, robot.joints)

        def way(t_s, visited=visited, starts_s=starts_s, moves_s=moves_s, shaking=shaking):
            place = np.tile(visited[0], (t_s.size, 1))
            for k, move_s in enumerate(moves_s):
                u = np.clip((t_s - starts_s[k]) / move_s, 0, 1)
                place += (u**3 * (10 - 15 * u + 6 * u * u))[:, None] * (visited[k + 1] - visited[k])
            hz, phase = shaking
            return place + tremor * np.sin(2 * np.pi * hz * t_s[:, None] + phase)

        ways.append((way, float(starts_s[-1]) + period_s))
    return ways


def undulating(rng, robot, periods_s):
    """Return gaits with an amplitude, a direction and a frequency of each episode."""
    usual, spread = rng.uniform(0.3, 0.9), rng.choice([0.0, 0.02, 0.2])
    ways = []
    for _ in periods_s:
        hz = usual * np.exp(spread * rng.standard_normal())
        amplitude, bend = rng.uniform(0.3, 0.7), rng.uniform(-0.2, 0.2)
        phase = rng.uniform(0, 6.3) + rng.choice([-1, 1]) * rng.uniform(0.4, 1) * np.arange(
            robot.joints
        )

        def way(t_s, hz=hz, amplitude=amplitude, bend=bend, phase=phase):
            ramp = np.clip(t_s / 2, 0, 1)[:, None]
            return ramp * (amplitude * np.sin(2 * np.pi * hz * t_s[:, None] + phase) + bend)

        ways.append((way, rng.uniform(8, 16)))
    return ways


def simulate(rng, robot, count, fault=None):
    """Simulate a data set, with a fault whose joint is drawn if it has none but needs one."""
    periods_s = np.full(count, 1 / robot.fps)
    if fault is not None and fault.kind == RATE:
        periods_s[fault.episode] *= 1 + fault.size
    make = taught if robot.motion == "pick" else lambda r, b, _, p: undulating(r, b, p)
    ways = make(rng, robot, count, periods_s)
    ticks = [
        int(length_s / period_s) for (_, length_s), period_s in zip(ways, periods_s, strict=True)
    ]
    actions = [way(np.arange(n) * p) for (way, _), n, p in zip(ways, ticks, periods_s, strict=True)]
    held = max(robot.hold, 1)
    actions = [action[np.arange(len(action)) // held * held] for action in actions]
    if fault is not None:
        fault = _placed(rng, fault, actions[fault.episode])
    states = _driven(rng, robot, actions, periods_s, fault)
    actions = [action.astype(np.float32) for action in actions]
    if fault is not None:
        _recorded_wrong(rng, robot, actions, states, fault)
    return DataSet(robot, actions, [state.astype(np.float32) for state in states], fault)


def draw(seed, kind=None, most=200):
    """Simulate a data set with a robot of its own, sound or with a fault of some kind."""
    rng = np.random.default_rng([seed, 0 if kind is None else 1 + KINDS.index(kind)])
    robot, count = draw_robot(rng), draw_count(rng, most)
    if kind is None:
        return simulate(rng, robot, count)
    forms = {
        GAIN: ("zero", "middle", "drive"),
        DELAY: ("joint", "joint", "all"),
        DROPPED: ("rows", "rows", "several", "states"),
    }
    form = str(rng.choice(forms.get(kind, ("",))))
    size = {
        OFFSET: np.radians(5) * rng.choice([-1, 1]),
        GAIN: 0.75,
        DELAY: 0.1,
        DROPPED: rng.integers(3, 11),
        RATE: 0.1 * rng.choice([-1, 1]),
    }[kind]
    return simulate(rng, robot, count, Fault(kind, int(rng.integers(count)), None, form, size))


def _placed(rng, fault, action):
    """Return a fault with its joint, one that moves."""
    if fault.kind in {DROPPED, RATE} or fault.form == "all" or fault.joint is not None:
        return fault
    moving = np.flatnonzero(np.ptp(action, axis=0) > ENOUGH_RAD)
    return replace(fault, joint=int(rng.choice(moving)))


def _driven(rng, robot, actions, periods_s, fault):
    """Return the measured positions: delay, first-order lag, backlash, sag, noise, encoder."""
    count, longest, m = len(actions), max(map(len, actions)), robot.joints
    offset, gain, lag_s = (
        s * rng.standard_normal((count, m)) + s * rng.standard_normal((count, 1))
        for s in robot.scatter
    )
    gain, delay_s = (gain + 1) * robot.gain, robot.delay_s + lag_s
    if fault is not None and fault.kind == DELAY:
        delay_s[fault.episode, slice(None) if fault.joint is None else fault.joint] += fault.size
    if fault is not None and fault.form == "drive":
        gain[fault.episode, fault.joint] *= fault.size
    padded = np.stack([np.pad(a, ((0, longest - len(a)), (0, 0)), mode="edge") for a in actions])
    delays = delay_s / periods_s[:, None] * FINE
    decay = np.exp(-periods_s[:, None] / FINE / robot.lag_s)
    motor, link, half = padded[:, 0].copy(), padded[:, 0].copy(), robot.play_rad / 2
    rows, columns = np.arange(count)[:, None], np.arange(m)
    states = np.empty_like(padded)
    for step in range(longest * FINE):
        tick, part = np.divmod(np.maximum(step - delays, 0), FINE)
        tick = tick.astype(int)
        asked = padded[rows, tick, columns]
        part = part / FINE if robot.hold == 0 else np.maximum(part - FINE + 1, 0)
        asked += (padded[rows, np.minimum(tick + 1, longest - 1), columns] - asked) * part
        if step % FINE == 0:
            states[:, step // FINE] = link
        motor = asked + decay * (motor - asked)
        link = np.clip(link, motor - half, motor + half)
    states = gain[:, None] * states + offset[:, None] + robot.sag_rad * np.cos(states)
    states += robot.noise_rad * rng.standard_normal(states.shape)
    states = np.rint(states / robot.step_rad) * robot.step_rad
    return [state[: len(action)] for state, action in zip(states, actions, strict=True)]


def _recorded_wrong(rng, robot, actions, states, fault):
    """Plant what is wrong in the record alone."""
    e, j = fault.episode, fault.joint
    if fault.kind == OFFSET:
        states[e][:, j] += fault.size
    elif fault.form in {"zero", "middle"}:
        middle = states[e][:, j].mean() if fault.form == "middle" else 0.0
        states[e][:, j] = middle + fault.size * (states[e][:, j] - middle)
    elif fault.kind == DROPPED:
        lost = int(fault.size)
        speed = np.abs(np.diff(states[e], axis=0)).mean(axis=1)
        fast = np.flatnonzero(speed[5 : -lost - 5] > np.median(speed)) + 5
        if fault.form == "several":
            gone = rng.choice(fast, min(lost, fast.size), replace=False)
        else:
            gone = rng.choice(fast) + np.arange(lost)
        states[e] = np.delete(states[e], gone, axis=0)
        if fault.form == "states":
            actions[e] = actions[e][: len(states[e])]
        else:
            actions[e] = np.delete(actions[e], gone, axis=0)


def write(folder, data, version="v3.0"):
    """Write a data set as LeRobot lays it out: v2 an episode a file, v3 all of them in one."""
    joints = [f"joint_{k}.pos" for k in range(data.robot.joints)]
    feature = {"dtype": "float32", "shape": [len(joints)], "names": joints}
    number = {"dtype": "int64", "shape": [1], "names": None}
    names = ("timestamp", "frame_index", "episode_index", "index", "task_index")
    info = {
        "codebase_version": version,
        "robot_type": data.robot.motion,
        "fps": data.robot.fps,
        "features": {"action": feature, "observation.state": feature}
        | dict.fromkeys(names, number),
    }
    chunk = folder / "data" / "chunk-000"
    for path in (chunk, folder / "meta"):
        path.mkdir(parents=True)
    (folder / "meta" / "info.json").write_text(json.dumps(info))
    tables = [_table(data, e) for e in range(len(data.actions))]
    if version == "v3.0":
        pq.write_table(pa.concat_tables(tables), chunk / "file-000.parquet")
    else:
        for e, table in enumerate(tables):
            pq.write_table(table, chunk / f"episode_{e:06d}.parquet")
    return folder


def _table(data, episode):
    action, state = data.actions[episode], data.states[episode]
    frames = np.arange(len(action))
    vectors = {
        name: pa.FixedSizeListArray.from_arrays(pa.array(values.ravel()), values.shape[1])
        for name, values in (("action", action), ("observation.state", state))
    }
    first = sum(map(len, data.actions[:episode]))
    return pa.table(
        {
            **vectors,
            "timestamp": pa.array((frames / data.robot.fps).astype(np.float32)),
            "frame_index": frames,
            "episode_index": np.full(frames.size, episode),
            "index": first + frames,
            "task_index": np.zeros(frames.size, dtype=np.int64),
        }
    )
