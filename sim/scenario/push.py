"""Disturbances: what pushes the robot from outside for a while, a hand, a gust, a rope."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from undulog.capture.common.arrays import FloatArray
from undulog.capture.common.strict_table import Table, listed
from undulog.capture.robot.model import Robot


@dataclass(frozen=True)
class Push:
    """A constant force on the centre of a link.

    Attributes:
        link: Name of the link.
        force: In the world [N].
        start_s: When it begins [s].
        duration_s: How long it lasts [s].
    """

    link: str
    force: tuple[float, float, float]
    start_s: float
    duration_s: float


def pushes_during(
    pushes: Sequence[Push], link_names: Sequence[str], times_s: FloatArray
) -> FloatArray | None:
    """Forces on all links at some times.

    Args:
        pushes: The pushes.
        link_names: Names of the n links.
        times_s: Times of k physics steps [s], shape (k,).

    Returns:
        Forces in the world [N], shape (k, 3, n), or None where nothing pushes at any of them.
    """
    forces: FloatArray | None = None
    for push in pushes:
        acts = (times_s >= push.start_s) & (times_s < push.start_s + push.duration_s)
        if acts.any():
            if forces is None:
                forces = np.zeros((len(times_s), 3, len(link_names)))
            forces[acts, :, link_names.index(push.link)] += push.force
    return forces


def read_pushes(top: Table, robot: Robot | None) -> tuple[Push, ...]:
    """Read ``[[disturbances]]`` of a scenario.

    Args:
        top: The scenario.
        robot: Who is pushed; None after a fault: then names can't be checked.

    Returns:
        The pushes.
    """
    return tuple(
        _read_push(Table(values, where, top.faults), robot)
        for values, where in top.tables("disturbances")
    )


def _read_push(table: Table, robot: Robot | None) -> Push:
    push = Push(
        link=table.text("link"),
        force=table.triple("force"),
        start_s=table.number("start_s", at_least=0.0),
        duration_s=table.number("duration_s", above=0.0),
    )
    names = [] if robot is None else [link.name for link in robot.links]
    if robot is not None and push.link and push.link not in names:
        table.fault("link", listed(names, push.link))
    table.close()
    return push
