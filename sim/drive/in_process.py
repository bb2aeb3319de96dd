"""Drive the twin in process, as fast as possible, and record it like any run of the twin."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from undulog.capture.common.arrays import FloatArray
from undulog.capture.common.process import StopRequest
from undulog.capture.robot.model import Plane, Robot

from ..gait.contract import Gait, GaitTick, Readings
from ..gait.wave import smoothstep
from ..scenario.scenario import Scenario
from ..twin.recording import Driver, TwinRecording, record
from ..twin.twin import Sample
from .motion import MotionSource

FADE_S = 1.0
"""Duration of the fade to rest [s]."""

STOP = "stop"
"""Mode of a gait that comes to rest."""

_ROUNDING_S = 1e-9  # a tick that is due when the fade ends is in time
_FADED = ("A", "offset")  # of a plane or a joint, not of what a controller tells of itself


class FadingGait:
    """A gait, untouched until it is to end; then its commands shrink smoothly to straight joints.

    The commands are multiplied by 1 - S((t - t_0) / T), S(x) = 3 x^2 - 2 x^3; for a wave that is
    its amplitude and offset going to zero while its phase runs on. It works for any gait, recorded
    commands and adaptive ones alike.
    """

    def __init__(self, gait: Gait, robot: Robot, fade_s: float = FADE_S) -> None:
        """Wrap a gait.

        Args:
            fade_s: T [s].
        """
        self._gait, self._fade_s = gait, fade_s
        self.names = gait.names
        waves = {*Plane, *robot.joint_names}
        parts = [name.rpartition(".") for name in gait.names]
        faded = [wave in waves and value in _FADED for wave, _, value in parts]
        self._faded = np.array(faded, dtype=np.bool_)
        self._rest = np.clip(np.zeros(len(robot.joints)), *robot.limits())
        self._asked = False
        self._begun_s: float | None = None
        self._passed = 0.0  # share of the fade's time

    @property
    def at_rest(self) -> bool:
        """Whether the last command was the pose at rest, to be held from then on."""
        return self._passed == 1.0

    def begin(self) -> None:
        """Come to rest from the next step on; safe to call again."""
        self._asked = True

    def step(self, time_s: float, readings: Readings) -> GaitTick:
        """Return the commands at a time."""
        tick = self._gait.step(time_s, readings)
        if not self._asked:
            return tick
        if self._begun_s is None:
            self._begun_s = time_s
        self._passed = min((time_s - self._begun_s + _ROUNDING_S) / self._fade_s, 1.0)
        share = 1.0 - smoothstep(self._passed)
        command: FloatArray = self._rest + share * (tick.command - self._rest)
        values = tick.values.copy()
        values[self._faded] *= share
        return GaitTick(command, values, STOP, tick.clamped)


def drive_twin(
    driven: MotionSource,
    scenario: Scenario,
    path: Path,
    *,
    force: bool = False,
    stop: StopRequest | None = None,
    on_sample: Callable[[Sample], None] | None = None,
) -> TwinRecording:
    """Drive the twin and record it.

    A stop request lets the gait come to rest first (:class:`Fading`), then the run ends.

    Args:
        scenario: Where; from :meth:`.sim.drive.motion.MotionSource.scenario`.
        on_sample: Called with each sample after it is written.

    Raises:
        SimulationError: If the twin's state becomes impossible.
        OutputExistsError: If the file is there and ``force`` is not given.
        LogWriteError: If the file can't be written.
        ImportError: If the kernels of the run that commands are from are not installed.
    """
    gait = FadingGait(driven.make(scenario.robot, scenario), scenario.robot)
    ended = StopRequest()

    def after(sample: Sample) -> None:
        if on_sample is not None:
            on_sample(sample)
        if stop is not None and stop.requested:
            gait.begin()
        if gait.at_rest:
            ended.signal = stop.signal if stop is not None else None

    return record(
        scenario,
        path,
        driver=Driver(gait, driven.facts, driven.attachments, driven.records),
        force=force,
        stop=ended,
        on_sample=after,
        kernels=driven.kernels,
    )
