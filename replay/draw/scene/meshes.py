"""Links that have a mesh: drawn as it is, coloured as the capsules are."""

from __future__ import annotations

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from undulog.capture.common.arrays import FloatArray
from undulog.capture.robot.kinematics import quaternion_from_rotation
from undulog.capture.robot.mesh import mesh_type
from undulog.capture.robot.model import Robot

MESHES = "/world/snake/meshes"

_NOWHERE = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)


def meshed(robot: Robot) -> NDArray[np.bool_]:
    """Which links are drawn as their meshes.

    Args:
        robot: The robot.

    Returns:
        Whether a link's mesh is at hand, shape (number of links,).
    """
    files = dict(robot.meshes)
    return np.array([link.mesh in files for link in robot.links])


def log_shapes(rec: rr.RecordingStream, robot: Robot) -> None:
    """Write the meshes, once.

    Args:
        rec: The recording.
        robot: The robot.
    """
    files = dict(robot.meshes)
    for link in robot.links:
        if link.mesh in files:
            shape = rr.Asset3D(contents=files[link.mesh], media_type=mesh_type(link.mesh))
            rec.log(f"{MESHES}/{link.name}", shape, static=True)


def log_poses(
    rec: rr.RecordingStream,
    robot: Robot,
    times: list[rr.TimeColumn],
    poses: tuple[FloatArray, FloatArray],
    colors: NDArray[np.uint8],
) -> None:
    """Write where the meshed links were and what colour they had.

    Args:
        rec: The recording.
        robot: The robot, m joints.
        times: Timelines of n rows.
        poses: Link centres [m], shape (n, m + 1, 3), and orientations, shape (n, m + 1, 3, 3).
        colors: Shape (n, m + 1, 4) or one that broadcasts to it.
    """
    centre, quaternion = poses[0], quaternion_from_rotation(poses[1])
    spread = np.broadcast_to(colors, (*centre.shape[:2], 4))
    for i in np.flatnonzero(meshed(robot)):
        pose = np.concatenate([centre[:, i], quaternion[:, i]], axis=-1)
        known = np.isfinite(pose).all(axis=-1)
        pose[~known] = _NOWHERE
        scale = np.where(known, robot.links[i].mesh_scale, 0.0)  # of no size where unknown
        rec.send_columns(
            f"{MESHES}/{robot.links[i].name}",
            times,
            [
                *rr.Transform3D.columns(
                    translation=pose[:, :3],
                    quaternion=pose[:, 3:],
                    scale=np.repeat(scale[:, None], 3, axis=1),
                ),
                *rr.Asset3D.columns(albedo_factor=spread[:, i]),
            ],
        )
