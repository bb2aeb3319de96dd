"""A robot's planes put together: modulation handed out, limits kept, values named."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from undulog.capture.common.arrays import BoolArray, FloatArray, IntArray
from undulog.capture.common.errors import UsageError
from undulog.capture.robot.model import Plane, Robot

from .contract import WALK, GaitTick, Modulation
from .limits import within_limits
from .readings import Readings
from .rhythm import Change, Rhythm
from .wave import JOINT_VALUE_NAMES, VALUE_NAMES


@dataclass(frozen=True)
class _PlanePart:
    """One driven plane of the robot: its joints, their limits, and what sets their rhythm."""

    plane: Plane
    rhythm: Rhythm
    joints: IntArray
    names: tuple[str, ...]
    lower: FloatArray
    upper: FloatArray

    def cut(self, key: str, wanted: FloatArray, given: FloatArray) -> list[str]:
        """Names of a value that was cut: that of the plane, or those of the joints concerned."""
        differs: BoolArray = wanted != given
        if differs.all():
            return [f"{self.plane}.{key}"]
        return [f"{self.names[i]}.{key}" for i in np.flatnonzero(differs)]


class WaveGenerator:
    """A generator made of one rhythm a plane; joints of the other planes are held straight."""

    def __init__(
        self, rhythms: Mapping[Plane, Rhythm], robot: Robot, *, per_joint: bool = False
    ) -> None:
        """Put the planes together.

        Args:
            rhythms: The driven planes.
            robot: Who is to move.
            per_joint: Tell every joint's own values too: for whoever sets joints apart, by the
                rhythm itself or by :meth:`modulate`. Unlike limits within a plane set them apart
                as well.
        """
        lower, upper = robot.limits()
        self._held = np.clip(np.zeros(len(robot.joints)), lower, upper)
        self._parts: list[_PlanePart] = []
        for plane, rhythm in rhythms.items():
            joints = robot.joint_indices(plane)
            names = tuple(joint.name for joint in robot.joints if joint.plane is plane)
            part = _PlanePart(plane, rhythm, joints, names, lower[joints], upper[joints])
            self._parts.append(part)
        unlike = any(np.ptp(part.lower) + np.ptp(part.upper) > 0.0 for part in self._parts)
        self._per_joint = per_joint or unlike
        self._modulation = Modulation.none(len(robot.joints))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the values: each driven plane's, then perhaps those of its joints."""
        names: list[str] = []
        for part in self._parts:
            names += [f"{part.plane}.{key}" for key in VALUE_NAMES]
            if self._per_joint:
                names += [f"{joint}.{key}" for key in JOINT_VALUE_NAMES for joint in part.names]
        return tuple(names)

    def modulate(self, modulation: Modulation) -> None:
        """Change the generator from the next step on.

        Args:
            modulation: What to change, until the next call.

        Raises:
            UsageError: If it is of another number of joints or has a value that is not finite.
        """
        given = modulation.amplitude_factor, modulation.offset
        if any(values.shape != self._held.shape for values in given):
            raise UsageError(
                f"a modulation of {given[0].size} factors and {given[1].size} offsets; the robot "
                f"has {self._held.size} joints"
            )
        finite = all(np.isfinite(values).all() for values in given)
        if not (finite and math.isfinite(modulation.frequency_factor)):
            raise UsageError(f"a modulation can't hold NaN or infinity: {modulation}")
        self._modulation = modulation

    def step(self, time_s: float, readings: Readings) -> GaitTick:
        """Advance to a time and say what to do from then on.

        Args:
            time_s: Time since the start [s], never less than in the call before.
            readings: What the robot has told by then.

        Returns:
            Commands and values.
        """
        modulation = self._modulation
        command = self._held.copy()
        values: list[FloatArray] = []
        clamped: list[str] = []
        for part in self._parts:
            joints = part.joints
            change = Change(
                modulation.amplitude_factor[joints],
                modulation.offset[joints],
                modulation.frequency_factor,
            )
            swing = part.rhythm.step(time_s, change, readings)
            amplitude, offset = within_limits(swing.amplitude, swing.offset, part.lower, part.upper)
            clamped += part.cut("A", swing.amplitude, amplitude)
            clamped += part.cut("offset", swing.offset, offset)
            angle = amplitude * np.sin(swing.phase) + offset
            # Rounding of offset + amplitude may pass the limit in the last digit.
            command[joints] = np.minimum(np.maximum(angle, part.lower), part.upper)
            first = amplitude[0], swing.omega, swing.lag, offset[0], swing.phase[0]
            values.append(np.array(first))
            if self._per_joint:
                values += [amplitude, offset, swing.phase]
        return GaitTick(command, np.concatenate(values), WALK, tuple(clamped))
