"""Faults at work: between the twin and what its bus shows of it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from undulog.capture.common.arrays import BoolArray, FloatArray
from undulog.capture.log.messages.frames import DIR_RX, ERROR_FLAG, FrameArray, empty_frames
from undulog.capture.robot.model import Robot
from undulog.capture.sources.events import BUS_OFF, RESTARTED

from ..scenario.bus_faults import BusFault, FaultKind
from ..sensing.contract import JointSample, SensorSample
from .encode import ReplyEncoder

STREAM = 50
"""Number of the random stream that decides which frames are hit."""

_PROTOCOL_VIOLATION, _BUS_ERROR = 0x008, 0x080  # linux/can/error.h
_NS = 1_000_000_000


class FaultLine:
    """What stands between a healthy robot and its bus."""

    def __init__(
        self, faults: Sequence[BusFault], robot: Robot, replies: ReplyEncoder, seed: int
    ) -> None:
        """Start with all faults ahead.

        Args:
            faults: What is to go wrong.
            robot: The robot.
            replies: Encodes what its joints report.
            seed: Of the random losses and errors.
        """
        self._of = {kind: [f for f in faults if f.kind is kind] for kind in FaultKind}
        self._joint = {name: i for i, name in enumerate(robot.joint_names)}
        self._replies = replies
        self._random = np.random.default_rng([seed, STREAM])
        self._held: dict[BusFault, float] = {}
        self._off = False
        self._late: list[tuple[int, FrameArray]] = []
        self.lost = 0
        """Replies that were lost."""
        self.hit = 0
        """Transmissions that were hit by noise."""

    def command(self, command: FloatArray, angle: FloatArray, time_s: float) -> FloatArray:
        """What the servos make of their commands.

        Args:
            command: Joint angles to be reached [rad], shape (m,).
            angle: The newest angles that the encoders told [rad], NaN before the first, shape (m,).
            time_s: Time since the start [s].

        Returns:
            The same, but for a stuck servo the angle that it had when it got stuck.
        """
        acting = [fault for fault in self._of[FaultKind.STUCK] if fault.acts(time_s)]
        if not acting:
            return command
        command = command.copy()
        for fault in acting:
            i = self._joint[fault.joint]
            known = command[i] if np.isnan(angle[i]) else angle[i]
            command[i] = self._held.setdefault(fault, float(known))
        return command

    def samples(self, samples: Sequence[SensorSample], time_s: float) -> list[SensorSample]:
        """What the sensors tell.

        Args:
            samples: What healthy ones would.
            time_s: Time since the start [s].

        Returns:
            The same, but for a frozen encoder its last angle, and for a servo with a winding
            that draws too much that current.
        """
        frozen, drawing = (
            [fault for fault in self._of[kind] if fault.acts(time_s)]
            for kind in (FaultKind.FROZEN, FaultKind.OVER_CURRENT)
        )
        if not (frozen or drawing):
            return list(samples)
        told: list[SensorSample] = []
        for sample in samples:
            if not isinstance(sample, JointSample):
                told.append(sample)
                continue
            position, current = sample.position.copy(), sample.current.copy()
            for fault in frozen:
                i = self._joint[fault.joint]
                position[i] = self._held.setdefault(fault, float(position[i]))
            for fault in drawing:
                current[self._joint[fault.joint]] = fault.value
            told.append(sample._replace(position=position, current=current))
        return told

    def hears(self, time_s: float) -> bool:
        """Whether the robot hears the bus.

        Args:
            time_s: Time since the start [s].
        """
        return not any(fault.acts(time_s) for fault in self._of[FaultKind.BUS_OFF])

    def replies(self, frames: FrameArray, now_ns: int, time_s: float) -> FrameArray:
        """What the bus shows of the robot's frames.

        Args:
            frames: What it sends now, shape (n,).
            now_ns: The robot's clock [ns].
            time_s: Time since the start [s].

        Returns:
            What is on the bus by now: frames, those of before that were late, and error frames.
        """
        parts: list[FrameArray] = []
        if self._off == self.hears(time_s):
            self._off = not self._off
            parts.append(_error_frames(BUS_OFF if self._off else RESTARTED, now_ns, 1))
        for fault in self._of[FaultKind.LOST]:
            if fault.acts(time_s) and len(frames):
                frames = frames[~self._losses(fault, frames)]
        waiting = sum(fault.value for fault in self._of[FaultKind.DELAY] if fault.acts(time_s))
        if waiting or self._late:
            self._late.append((now_ns + round(waiting * _NS), frames))
            due = [late for due_ns, late in self._late if due_ns <= now_ns]
            self._late = [late for late in self._late if late[0] > now_ns]
            frames = np.concatenate([empty_frames(0), *due])
        if not self._off:
            parts.append(self._noisy(frames, now_ns, time_s))
        return np.concatenate([empty_frames(0), *parts])

    def _losses(self, fault: BusFault, frames: FrameArray) -> BoolArray:
        struck = self._random.random(len(frames)) < fault.value
        own = self._replies.identifiers(fault.joint)
        struck &= np.isin(frames["id_flags"], own)
        self.lost += int(struck.sum())
        return struck

    def _noisy(self, frames: FrameArray, now_ns: int, time_s: float) -> FrameArray:
        """Frames, each after as many error frames as attempts to send it were hit."""
        for fault in self._of[FaultKind.NOISE]:
            if not fault.acts(time_s) or not len(frames):
                continue
            hits = self._random.geometric(1.0 - fault.value, len(frames)) - 1
            self.hit += int(hits.sum())
            errors = _error_frames(_PROTOCOL_VIOLATION | _BUS_ERROR, now_ns, int(hits.sum()))
            frames = np.insert(frames, np.repeat(np.arange(len(frames)), hits), errors)
        return frames


def _error_frames(classes: int, now_ns: int, count: int) -> FrameArray:
    frames = empty_frames(count)
    frames["id_flags"] = ERROR_FLAG | classes
    frames["dlc"] = 8
    frames["dir"] = DIR_RX
    frames["t_device_ns"] = now_ns
    return frames
