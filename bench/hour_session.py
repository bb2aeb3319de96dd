"""A long session of the 25-joint snake as a recorder would write it, faster than real time.

Every number goes through the resolution of the part that measures it (12-bit servo encoders,
10-bit converters for infrared and voltage, whole units of the shipped DBC elsewhere) before it
becomes the float64 of the log, and the raw frames carry the same numbers: a session of ideal
sines would compress far better, and one of white noise far worse, than a real one.

The bus runs a fixed cycle of 80 frames every 10 ms, 8,000 frames a second: command and state of
each servo, a voltage frame of each servo (not in the DBC), ranges, and the accelerometer and the
compass in turn.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from undulog.capture import SessionWriter, load_robot
from undulog.capture.common.arrays import FloatArray, IntArray
from undulog.capture.log.messages.frames import DIR_TX, FRAME_DTYPE, FrameArray
from undulog.capture.robot.model import Robot

EPOCH_NS = 1_700_000_000_000_000_000
JOINTS = 25
TICKS = 100
"""Bus cycles in a block of one second."""

CYCLE = 80
SLOT_NS = 125_000
BATCHES = 2
"""Messages of raw frames a cycle: a recorder's tick is 5 ms."""

JOINT_TOPICS: dict[str, tuple[str, ...]] = {
    "/joint_commands": ("position",),
    "/joint_states": ("position", "velocity", "effort"),
    "/joint_current": ("position",),
    "/joint_voltage": ("position",),
    "/joint_temperature": ("position",),
}
BUS = "/can/can0"

_OMEGA = 2 * np.pi * 0.5
_LAG = np.pi / 3
_AMPLITUDE = 0.4
_LARGER, _LARGER_S = 0.15, 61.0
_FASTER, _FASTER_S = 0.1, 47.0
"""An adaptive gait's amplitude and frequency vary by these parts, in these times [s]."""

_COMMAND_SLOTS = np.arange(0, 50, 2)
_STATE_SLOTS = np.arange(1, 50, 2)
_VOLTAGE_SLOTS = np.arange(50, 75)
_RANGE_SLOTS = np.arange(75, 79)
_TURN_SLOT = 79
_IDS = np.zeros((2, CYCLE), np.uint32)
_IDS[:, _COMMAND_SLOTS] = 257 + np.arange(JOINTS)
_IDS[:, _STATE_SLOTS] = 513 + np.arange(JOINTS)
_IDS[:, _VOLTAGE_SLOTS] = 641 + np.arange(JOINTS)
_IDS[:, _RANGE_SLOTS] = 769 + np.arange(4)
_IDS[:, _TURN_SLOT] = [784, 785]
_LENGTHS = np.full((2, CYCLE), 8, np.uint8)
_LENGTHS[:, _COMMAND_SLOTS] = 2
_LENGTHS[:, _VOLTAGE_SLOTS] = 3
_LENGTHS[:, _TURN_SLOT] = [6, 4]


@dataclass(frozen=True)
class Block:
    """One second of everything: raw numbers as the bus carries them, and times.

    Attributes:
        device_ns: Time of each frame on the device [Unix ns], shape (ticks, 80).
        host_ns: The same on the host.
        command: 0.01 deg, shape (ticks, 25).
        state: Position 0.01 deg, velocity 0.1 deg/s, torque mN m, current mA, temperature degC,
            shape (5, ticks, 25).
        voltage: Counts of a 10-bit converter, shape (ticks, 25).
        ranges: Infrared and sonar [mm], shape (ticks, 16).
        acceleration: mg, shape (ticks, 3).
        field: 0.01 uT, shape (ticks, 2).
    """

    device_ns: IntArray
    host_ns: IntArray
    command: IntArray
    state: IntArray
    voltage: IntArray
    ranges: IntArray
    acceleration: IntArray
    field: IntArray

    def frames(self) -> FrameArray:
        """Return all frames in order, shape (ticks * 80,)."""
        ticks = len(self.device_ns)
        frames = np.zeros((ticks, CYCLE), FRAME_DTYPE)
        frames["t_device_ns"], frames["t_host_ns"] = self.device_ns, self.host_ns
        turns = np.arange(ticks) % 2
        frames["id_flags"], frames["dlc"] = _IDS[turns], _LENGTHS[turns]
        frames["dir"][:, _COMMAND_SLOTS] = DIR_TX
        position, velocity, torque, current, temperature = self.state
        halves = torque & 0xFFF | (current & 0xFFF) << 12
        words = position & 0xFFFF | (velocity & 0xFFFF) << 16 | halves << 32 | temperature << 56
        data = np.zeros((ticks, CYCLE), "<u8")
        data[:, _COMMAND_SLOTS] = (self.command & 0xFFFF).astype(np.uint64)
        data[:, _STATE_SLOTS] = words.view(np.uint64)
        data[:, _VOLTAGE_SLOTS] = (self.voltage | (temperature & 0xFF) << 16).view(np.uint64)
        data[:, _RANGE_SLOTS] = _packed(self.ranges.reshape(ticks, 4, 4))
        data[::2, _TURN_SLOT] = _packed(self.acceleration[::2])
        data[1::2, _TURN_SLOT] = _packed(self.field[1::2])
        frames["data"] = data.view(np.uint8).reshape(ticks, CYCLE, 8)
        return frames.reshape(-1)


def _packed(values: IntArray) -> IntArray:
    """Return up to four 16-bit values along the last axis, little-endian in one word."""
    shifts = 16 * np.arange(values.shape[-1])
    return ((values & 0xFFFF) << shifts).sum(axis=-1)


class Wave(NamedTuple):
    """The gait at some times.

    Attributes:
        amplitude: Of each joint [rad], shape (n,).
        omega: Angular frequency [rad/s], shape (n,).
        phase: Of the first joint, the integral of ``omega`` [rad], shape (n,).
    """

    amplitude: FloatArray
    omega: FloatArray
    phase: FloatArray


def wave_at(t: FloatArray, *, adaptive: bool) -> Wave:
    """Return the gait at some times.

    Args:
        t: Since the session's start [s], shape (n,).
        adaptive: Whether amplitude and frequency vary, so that no two samples have the same.

    Returns:
        The gait.
    """
    if not adaptive:
        return Wave(np.full_like(t, _AMPLITUDE), np.full_like(t, _OMEGA), _OMEGA * t)
    slow, fast = 2 * np.pi / _LARGER_S, 2 * np.pi / _FASTER_S
    return Wave(
        _AMPLITUDE * (1 + _LARGER * np.sin(slow * t)),
        _OMEGA * (1 + _FASTER * np.sin(fast * t)),
        _OMEGA * (t + _FASTER / fast * (1 - np.cos(fast * t))),
    )


def blocks(seconds: int, seed: int = 1, *, adaptive: bool = False) -> Iterator[Block]:
    """Seconds of a snake on its way: a travelling wave, noise, and the parts' resolution.

    Args:
        seconds: How many.
        seed: Of the noise.
        adaptive: Whether the gait varies all the time, see :func:`wave_at`.

    Yields:
        One block a second.
    """
    rng = np.random.default_rng(seed)
    k = np.arange(JOINTS)
    for second in range(seconds):
        tick = second * TICKS + np.arange(TICKS)
        slots = tick[:, None] * 10_000_000 + np.arange(CYCLE) * SLOT_NS
        jitter_ns = rng.integers(0, 12, slots.shape) * 1000  # device clock: whole microseconds
        device_ns = EPOCH_NS + slots + jitter_ns
        latency_ns = 40_000 + rng.gamma(4.0, 2500.0, slots.shape)
        t = tick[:, None] * 0.01
        size, omega, turned = wave_at(t, adaptive=adaptive)
        phase = turned + k * _LAG
        wave, slope = size * np.sin(phase), size * omega * np.cos(phase)
        shape = wave.shape
        late = 0.95 * size * np.sin(phase - 0.12)
        late_slope = 0.95 * size * omega * np.cos(phase - 0.12)
        counts = np.rint((late + rng.normal(0, 3e-4, shape)) * 4096 / (2 * np.pi))  # 12 bit
        torque = 120 * np.sin(phase - 0.3) + 25 * np.sign(slope) + rng.normal(0, 4, shape)
        current = np.abs(torque) + 30 + rng.normal(0, 5, shape)
        warm = 24 + 12 * (1 - np.exp(-t / 900)) + 0.1 * k + rng.normal(0, 0.15, shape)
        state = [
            counts * 36000 / 4096,
            np.degrees(late_slope + rng.normal(0, 0.01, shape)) * 10,
            torque,
            current,
            warm,
        ]
        volts = 7.4 - 0.3 * t / 3600 - 0.4e-3 * current + rng.normal(0, 5e-3, shape)
        yield Block(
            device_ns=device_ns,
            host_ns=(device_ns + latency_ns).astype(np.int64),
            command=np.rint(np.degrees(wave) * 100).astype(np.int64),
            state=np.rint(np.array(state)).astype(np.int64),
            voltage=np.rint(volts * 1023 / 16).astype(np.int64),
            ranges=_ranges(rng, t),
            acceleration=np.rint(
                np.array([0, 0, 1000])
                + 80 * np.sin(2 * _OMEGA * t + np.arange(3))
                + rng.normal(0, 4, (TICKS, 3))
            ).astype(np.int64),
            field=np.rint(
                2000 * np.cos(0.02 * t - np.array([0, np.pi / 2])) + rng.normal(0, 15, (TICKS, 2))
            ).astype(np.int64),
        )


def _ranges(rng: np.random.Generator, t: FloatArray) -> IntArray:
    """Return infrared distances by way of a 10-bit converter, and the sonar [mm]."""
    way = 0.8 + 0.5 * np.sin(0.11 * t + np.arange(16)) + 0.03 * np.sin(_OMEGA * t + np.arange(16))
    counts = np.rint(1023 / 5.0 * (0.6 / way + 0.1) + rng.normal(0, 0.7, way.shape))
    metres = 0.6 / np.maximum(counts * 5.0 / 1023 - 0.1, 0.05)
    metres[:, 15] = np.round(way[:, 15] * 2 + rng.normal(0, 2e-3, len(way)), 2)
    return np.rint(metres * 1000).astype(np.int64)


class Recording:
    """Writes blocks to the topics of the log contract."""

    def __init__(
        self, writer: SessionWriter, robot: Robot, *, can: bool, adaptive: bool = False
    ) -> None:
        """Open all channels.

        Args:
            writer: The session.
            robot: The 25-joint snake.
            can: Whether the raw frames are kept.
            adaptive: Whether the gait varies all the time, as that of the blocks.
        """
        self._adaptive = adaptive
        names = robot.joint_names
        joint = writer.joint_state
        self._commands = joint("/joint_commands", names, unit="rad")
        self._command_offsets = joint("/joint_command_offset", names, unit="s")
        self._states = joint("/joint_states", names, unit="rad", velocity=True, effort=True)
        self._offsets = joint("/joint_sample_offset", names, unit="s")
        self._current = joint("/joint_current", names, unit="A")
        self._voltage = joint("/joint_voltage", names, unit="V")
        self._temperature = joint("/joint_temperature", names, unit="degC")
        parts = [f"{plane}.{part}" for plane in ("horizontal", "vertical") for part in _GAIT]
        self._gait = joint("/gait", parts, unit="rad, omega in rad/s")
        self._ranges = [
            writer.range(
                sensor.topic,
                frame=sensor.name,
                min_range=sensor.range_min or 0.0,
                max_range=sensor.range_max or 0.0,
                field_of_view=sensor.field_of_view or 0.0,
                infrared=sensor.kind == "ir",
            )
            for sensor in robot.sensors
            if sensor.range_max is not None
        ]
        self._imu = writer.imu("/imu", frame="accelerometer")
        self._compass = writer.magnetic_field("/compass", frame="compass")
        links = [link.name for link in robot.links]
        self._odometry = writer.odometry("/odom", frame="world", child=links[0])
        self._transforms = writer.transforms("/tf", parent="world", children=links)
        self._bus = writer.frames(BUS) if can else None
        self._random = np.random.default_rng(2)
        self._seconds = 0

    def write(self, block: Block) -> None:
        """Write one block, in the order of a recorder's loop.

        Args:
            block: One second.
        """
        radians = np.radians(0.01)
        command = block.command * radians
        position, velocity, torque, current, temperature = block.state
        states = position * radians, velocity * np.radians(0.1), torque * 1e-3
        power = current * 1e-3, block.voltage * (16 / 1023), temperature * 1.0
        sent, sampled = block.device_ns[:, _COMMAND_SLOTS], block.device_ns[:, _STATE_SLOTS]
        sent_s, sampled_s = (sent - sent[:, :1]) * 1e-9, (sampled - sampled[:, :1]) * 1e-9
        ranges = block.ranges * 1e-3
        force, field = block.acceleration * 9.80665e-3, np.zeros((TICKS, 3))
        field[:, :2] = block.field * 1e-8
        gait, head, spots, turns = self._motion()
        frames = block.frames().reshape(TICKS, BATCHES, -1)
        sent_ns: list[int] = sent[:, 0].tolist()
        sampled_ns: list[int] = sampled[:, 0].tolist()
        logged_ns: list[list[int]] = block.host_ns.tolist()
        for i, (command_ns, t_ns, host_ns) in enumerate(
            zip(sent_ns, sampled_ns, logged_ns, strict=True)
        ):
            if self._bus is not None:
                for batch, at in zip(frames[i], (39, 79), strict=True):
                    self._bus.write(host_ns[at], batch)
            log = {"log_time_ns": host_ns[79]}
            self._commands.write(command_ns, command[i], **log)
            self._command_offsets.write(command_ns, sent_s[i], **log)
            self._states.write(t_ns, *(values[i] for values in states), **log)
            self._offsets.write(t_ns, sampled_s[i], **log)
            for channel, values in zip(
                (self._current, self._voltage, self._temperature), power, strict=True
            ):
                channel.write(t_ns, values[i], **log)
            for channel, value in zip(self._ranges, ranges[i].tolist(), strict=True):
                channel.write(host_ns[75], value, **log)
            if i % 2:
                self._compass.write(host_ns[79], field[i], **log)
            else:
                self._imu.write(host_ns[79], force[i], **log)
            self._gait.write(t_ns, gait[i], **log)
            self._odometry.write(t_ns, *(part[i] for part in head), **log)
            if i % 5 == 0:
                self._transforms.write(t_ns, spots[i], turns[i], **log)
        self._seconds += 1

    def _motion(self) -> tuple[FloatArray, tuple[FloatArray, ...], FloatArray, FloatArray]:
        """Return gait parameters, the tracked head, and the links' poses over the next second."""
        t = (self._seconds * TICKS + np.arange(TICKS)) * 0.01
        noise = self._random.normal
        gait = np.zeros((TICKS, 10))
        gait[:, 0], gait[:, 1], turned = wave_at(t, adaptive=self._adaptive)
        gait[:, 2] = _LAG
        gait[:, 4] = turned % (2 * np.pi)
        links = np.arange(26)
        heading = 0.3 * np.sin(_OMEGA * t[:, None] + links * _LAG)
        spots = np.zeros((TICKS, 26, 3))
        spots[..., 0] = 0.05 * t[:, None] - np.cumsum(0.06 * np.cos(heading), axis=1)
        spots[..., 1] = -np.cumsum(0.06 * np.sin(heading), axis=1)
        turns = np.zeros((TICKS, 26, 4))
        turns[..., 2], turns[..., 3] = np.sin(heading / 2), np.cos(heading / 2)
        tracked = np.round(spots[:, 0] + noise(0, 1e-4, (TICKS, 3)), 5)  # mocap: 10 um steps
        linear = np.round(np.gradient(tracked, 0.01, axis=0), 4)
        spin = np.round(noise(0, 0.01, (TICKS, 3)), 4)
        return gait, (tracked, np.round(turns[:, 0], 5), linear, spin), spots, turns


_GAIT = ("A", "omega", "lag", "offset", "phase")


def write_session(
    path: Path,
    seconds: int,
    *,
    can: bool,
    adaptive: bool = False,
    progress: Callable[[int], None] | None = None,
) -> None:
    """Write a session.

    Args:
        path: The file to make.
        seconds: How long it is.
        can: Whether the raw frames are kept.
        adaptive: Whether the gait's amplitude and frequency vary all the time.
        progress: Called with the seconds written so far.
    """
    robot = load_robot("snake25")
    with contextlib.closing(
        SessionWriter(path, session_id="one-hour", epoch_ns=EPOCH_NS, robot=robot)
    ) as writer:
        recording = Recording(writer, robot, can=can, adaptive=adaptive)
        for second, block in enumerate(blocks(seconds, adaptive=adaptive), start=1):
            recording.write(block)
            if progress is not None:
                progress(second)
