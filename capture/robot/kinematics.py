"""Where the links are, given the head's pose and the joint angles.

Frames and signs as in :mod:`.capture.robot`. Quaternions are x, y, z, w, as ROS has them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import PurePosixPath

import numpy as np

from ..common.arrays import FloatArray
from ..common.errors import DataError
from ..common.strict_table import Faults, shown
from .model import Link, Plane, Robot

MESH_TYPES = {
    ".glb": "model/gltf-binary",
    ".obj": "model/obj",
    ".stl": "model/stl",
}
"""Suffix of a mesh file to its media type (IANA)."""


def mesh_type(name: str) -> str | None:
    """Return the media type of a mesh file by its name, None for a file of another kind."""
    return MESH_TYPES.get(PurePosixPath(name).suffix.lower())


def read_meshes(
    links: Sequence[Link], faults: Faults, read: Callable[[str], bytes | None]
) -> tuple[tuple[str, bytes], ...]:
    """Read the mesh files of the links, each once; return their names and bytes.

    Args:
        faults: Where files that can't be read are noted.
        read: Bytes of a file of that name, None where it can't be read.
    """
    meshes: dict[str, bytes] = {}
    for link in links:
        if not link.mesh or link.mesh in meshes:
            continue
        data = read(link.mesh)
        if data is None:
            faults.add(f"mesh of {link.name}", shown(link.mesh), "a file beside the description")
        else:
            meshes[link.mesh] = data
    return tuple(meshes.items())


def rotation_from_quaternion(quaternion: FloatArray) -> FloatArray:
    """Return the rotation matrices of unit quaternions.

    Args:
        quaternion: x, y, z, w, shape (..., 4).

    Returns:
        Shape (..., 3, 3), columns are the frame's axes in the world.
    """
    x, y, z, w = np.moveaxis(quaternion, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def quaternion_from_rotation(rotation: FloatArray) -> FloatArray:
    """Return the unit quaternions of rotation matrices, w >= 0.

    Shepperd's method (J. Guidance and Control 1, 1978): the largest of the four components is
    computed first, so that no division is by a small number.

    Args:
        rotation: Shape (..., 3, 3).

    Returns:
        x, y, z, w, shape (..., 4).
    """
    r = rotation
    xx, yy, zz = r[..., 0, 0], r[..., 1, 1], r[..., 2, 2]
    # Four times the outer product q q^T, q = (x, y, z, w).
    outer = np.empty((*r.shape[:-2], 4, 4), dtype=np.float64)
    outer[..., 0, 0] = 1 + xx - yy - zz
    outer[..., 1, 1] = 1 - xx + yy - zz
    outer[..., 2, 2] = 1 - xx - yy + zz
    outer[..., 3, 3] = 1 + xx + yy + zz
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        outer[..., i, j] = outer[..., j, i] = r[..., i, j] + r[..., j, i]
        outer[..., k, 3] = outer[..., 3, k] = r[..., j, i] - r[..., i, j]
    largest = np.argmax(np.diagonal(outer, axis1=-2, axis2=-1), axis=-1)
    column = np.take_along_axis(outer, largest[..., None, None], axis=-1)[..., 0]
    unit = column / np.linalg.norm(column, axis=-1, keepdims=True)
    sign: FloatArray = np.where(unit[..., 3:] < 0, -1.0, 1.0)
    return sign * unit


def link_poses(
    robot: Robot, head_position: FloatArray, head_rotation: FloatArray, angles: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return centres and orientations of all links in the world.

    Args:
        robot: The robot, m joints.
        head_position: Centre of the head link [m], shape (..., 3).
        head_rotation: Orientation of the head link, shape (..., 3, 3).
        angles: Joint angles [rad], shape (..., m).

    Returns:
        Link centres [m], shape (..., m + 1, 3), and rotations, shape (..., m + 1, 3, 3); NaN
        behind the first joint whose angle is NaN.

    Raises:
        DataError: If ``angles`` has not one column a joint.
    """
    lead = _lead(robot, angles)
    rotation = np.empty((len(robot.links), 3, 3, *lead), dtype=np.float64)
    position = _along(robot, head_position, head_rotation, angles, rotation)
    lost = np.logical_or.accumulate(np.moveaxis(~np.isfinite(angles), -1, 0))
    if lost.any():  # a joint's own axis does not turn with it
        np.copyto(rotation[1:], np.nan, where=lost[:, None, None])
    return np.moveaxis(position, (0, 1), (-2, -1)), np.moveaxis(rotation, (0, 1, 2), (-3, -2, -1))


def link_positions(
    robot: Robot, head_position: FloatArray, head_rotation: FloatArray, angles: FloatArray
) -> FloatArray:
    """Return the centres of all links in the world: :func:`link_poses` without orientations.

    Args:
        robot: The robot, m joints.
        head_position: Centre of the head link [m], shape (..., 3).
        head_rotation: Orientation of the head link, shape (..., 3, 3).
        angles: Joint angles [rad], shape (..., m).

    Returns:
        Shape (..., m + 1, 3) [m]; NaN behind the first joint whose angle is NaN.

    Raises:
        DataError: If ``angles`` has not one column a joint.
    """
    two = np.empty((2, 3, 3, *_lead(robot, angles)), dtype=np.float64)
    position = _along(robot, head_position, head_rotation, angles, two)
    return np.moveaxis(position, (0, 1), (-2, -1))


def _lead(robot: Robot, angles: FloatArray) -> tuple[int, ...]:
    m = len(robot.joints)
    if angles.shape[-1:] != (m,):
        raise DataError(f"angles has shape {angles.shape}; the robot {robot.name} has {m} joints")
    return angles.shape[:-1]


def _along(
    robot: Robot,
    head_position: FloatArray,
    head_rotation: FloatArray,
    angles: FloatArray,
    rotation: FloatArray,
) -> FloatArray:
    """Go from link to link, head to tail.

    Instants are the last axes, so that each operation runs over neighbours in memory: a joint
    turns two axes of its link, which takes a fifth of the time of products of small matrices.

    Args:
        rotation: Filled in, link i at place i modulo its length: axes as columns, shape
            (k, 3, 3, ...), k at least 2 where there are joints.

    Returns:
        Centres [m], shape (m + 1, 3, ...).
    """
    position = np.empty((len(robot.links), 3, *angles.shape[:-1]), dtype=np.float64)
    np.moveaxis(position[0], 0, -1)[...] = head_position
    np.moveaxis(rotation[0], (0, 1), (-2, -1))[...] = head_rotation
    turned = np.moveaxis(angles, -1, 0)
    half = [link.length / 2 for link in robot.links]
    for i, joint in enumerate(robot.joints):
        front, rear = rotation[i % len(rotation)], rotation[(i + 1) % len(rotation)]
        cosine, sine = np.cos(turned[i]), np.sin(turned[i])
        # About z: x to y; about y: z to x.
        first, second = (0, 1) if joint.plane is Plane.HORIZONTAL else (2, 0)
        axis = 3 - first - second
        np.multiply(cosine, front[:, first], out=rear[:, first])
        rear[:, first] += sine * front[:, second]
        np.multiply(cosine, front[:, second], out=rear[:, second])
        rear[:, second] -= sine * front[:, first]
        rear[:, axis] = front[:, axis]
        np.multiply(-half[i], front[:, 0], out=position[i + 1])
        position[i + 1] += position[i]
        position[i + 1] -= half[i + 1] * rear[:, 0]
    return position
