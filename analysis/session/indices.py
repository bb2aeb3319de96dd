"""The heterogeneity indices of a session: one set for each driven plane and group."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from undulog.capture.common.console import Warn
from undulog.capture.robot.model import Robot

from ..energy.joint import Energies
from ..response.fitting import GaitFit
from ..results.analysis import Index, JointResult
from ..results.remarks import Note
from ..signals.reading import by_plane
from .heterogeneity import ENDS, KINDS, MIDDLE, energy_indices, index, response_indices


def heterogeneity_indices(
    robot: Robot | None,
    gait: GaitFit | None,
    joints: tuple[JointResult, ...],
    energies: Mapping[str, Energies],
    warn: Warn,
) -> dict[str, Index]:
    """Indices of each driven plane, and in it of each group of joints that share a rhythm.

    Args:
        robot: The robot, or None; then all joints are one chain.
        gait: The fitted gait, or None.
        joints: The joints' results.
        energies: By joint name.
        warn: Told why an index is None.

    Returns:
        Every index of :data:`.KINDS`, None where it can't be computed. Where
        both planes are driven each has its own, named e.g. ``gain_cv_horizontal``; where joints of
        one plane have several frequencies each group has its own, e.g. ``gain_cv_vertical_group1``.
    """
    unknown = {name: index(name) for name in KINDS}
    if gait is None or all(group.response is None for group in gait.groups):
        warn(Note("no joint's gain and lag are known: the heterogeneity indices are null"))
        return unknown
    known = {joint.name for joint in joints if joint.lag_rad.value is not None}
    old = {joint.name for joint in joints if joint.name in known and "stale" in joint.flags}
    if old != known:  # where all samples are late by a hold, that makes no difference
        known -= old
    groups = [by_plane(robot, group.driven) for group in gait.groups]
    planes = list(dict.fromkeys(plane for group in groups for plane in group))
    result: dict[str, Index] = {}
    parts = [(plane, k) for plane in planes for k, group in enumerate(groups) if plane in group]
    for plane, k in parts:
        names = groups[k][plane]
        sound = [name for name in names if name in known]
        several = sum(plane in group for group in groups) > 1
        label = f"{plane} {gait.groups[k].fit.frequency_hz:.4g} Hz" if several else plane
        found = unknown | _of_plane(label, names, sound, gait.groups[k], warn)
        powers = [energies[name].mechanical for name in sound]
        per_cycle = [power.abs_j for power in powers if power is not None]
        if per_cycle and len(per_cycle) == len(sound):
            found |= energy_indices(np.stack(per_cycle))
        suffix = f"_{plane}" if len(planes) > 1 else ""
        suffix += f"_group{k}" if several else ""
        result |= {f"{name}{suffix}": one for name, one in found.items()}
    warn(
        Note(
            "boundary or module: not separable from a wave in one direction (module_share is "
            "null); record the reverse"
        )
    )
    return result


def _of_plane(
    plane: str, names: list[str], sound: list[str], gait: GaitFit, warn: Warn
) -> dict[str, Index]:
    """Indices of gain and lag of one plane; its contrasts need every joint of it."""
    if gait.response is None or len(sound) < 2:
        warn(
            Note(
                f"fewer than two {plane} joints have a response: its heterogeneity indices are null"
            )
        )
        return {}
    found = response_indices(gait.response.select([gait.answered.index(name) for name in sound]))
    if len(names) < MIDDLE + ENDS:
        warn(
            Note(
                f"{len(names)} driven {plane} joints are too few for a contrast of the ends with "
                f"the middle {MIDDLE}: the boundary contrasts are null"
            )
        )
    elif len(sound) < len(names):
        warn(
            f"the {plane} indices leave out joints without gain and lag; the boundary contrasts, "
            "which need them all, are null"
        )
        found = {k: one for k, one in found.items() if not k.startswith("boundary_contrast")}
    return found
