"""Driving the twin in process: as fast as it can, recorded like any run of the twin."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from undulog.capture.common.interruption import StopRequest

from ..scenario.scenario import Scenario
from ..twin.recording import Driver, Recording, record
from ..twin.twin import Sample
from .driven import Driven
from .fading import FadingGait


def drive_twin(
    driven: Driven,
    scenario: Scenario,
    path: Path,
    *,
    force: bool = False,
    stop: StopRequest | None = None,
    on_sample: Callable[[Sample], None] | None = None,
) -> Recording:
    """Drive the twin and record it.

    A stop request lets the gait come to rest first (:mod:`.sim.drive.fading`), then ends the run.

    Args:
        driven: What to drive.
        scenario: Where; from :meth:`.sim.drive.driven.Driven.scenario`.
        path: The file to create.
        force: Replace an existing file.
        stop: Looked at between samples.
        on_sample: Told of each sample after it was written.

    Returns:
        What was recorded.

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

    driver = Driver(gait, driven.facts, driven.attachments, driven.records)
    return record(
        scenario,
        path,
        driver=driver,
        force=force,
        stop=ended,
        on_sample=after,
        kernels=driven.kernels,
    )
