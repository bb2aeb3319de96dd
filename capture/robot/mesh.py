"""Shapes of links for the picture: mesh files that travel with the robot description."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import PurePosixPath

from ..common.strict_table import Faults, shown
from .model import Link

MESH_TYPES = {
    ".glb": "model/gltf-binary",
    ".obj": "model/obj",
    ".stl": "model/stl",
}
"""Suffix of a mesh file to its media type (IANA)."""


def is_mesh(name: str) -> bool:
    """Whether a file is a mesh, by its name.

    Args:
        name: File name.

    Returns:
        Whether its suffix is one of :data:`MESH_TYPES`.
    """
    return mesh_type(name) is not None


def mesh_type(name: str) -> str | None:
    """Media type of a mesh file.

    Args:
        name: File name.

    Returns:
        The type, None for a file of another kind.
    """
    return MESH_TYPES.get(PurePosixPath(name).suffix.lower())


def read_meshes(
    links: Sequence[Link], faults: Faults, read: Callable[[str], bytes | None]
) -> tuple[tuple[str, bytes], ...]:
    """Read the mesh files that the links name, each once.

    Args:
        links: The links.
        faults: Where files that can't be read are noted.
        read: Bytes of a file of that name, None where it can't be read.

    Returns:
        File name and bytes of each.
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
