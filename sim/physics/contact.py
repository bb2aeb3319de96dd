"""The ground: a one-sided spring and damper, and anisotropic friction or drag.

Each link touches the ground in one point, the lowest point of a sphere of the link's radius about
its centre. Friction acts there along the link's own axes: *tangential* is the link's x axis laid
on the ground, *normal* is the horizontal direction 90 degrees to the left of it. Coulomb friction
is regularised: it vanishes smoothly with the slip speed, so a body at rest under a load below the
Coulomb limit creeps (there is no true stiction). A link whose x axis is exactly vertical has no
tangential direction and feels no friction.

Arrays over n links carry the component first, shape (k, n), so that a row is one component.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import numpy as np

from capture.arrays import FloatArray

from ..world.ground import FrictionLaw, Ground

_TINY = 1e-300
"""Makes 0/0 a zero."""


def normal_force(
    penetration: FloatArray, rate: FloatArray, stiffness: float, damping: float
) -> FloatArray:
    """Normal force of the ground, Eq. 7 of Meister et al. 2011, clamped so that it never pulls.

    F_n = max(0, -k p_z - d v_z) where p_z < 0, else 0; here with the penetration -p_z.

    Args:
        penetration: Depth below the surface, negative above it [m], shape (n,).
        rate: Rate of the depth, -v_z [m/s], shape (n,).
        stiffness: k [N/m].
        damping: d [N s/m].

    Returns:
        Force [N], never negative, shape (n,).
    """
    force = np.maximum(stiffness * penetration + damping * rate, 0.0)
    return force * (penetration > 0.0)


def _ellipse(slip: FloatArray, mu: FloatArray, slip_speed: float) -> FloatArray:
    weighted = mu * slip
    squares = weighted * weighted
    floor = (mu * slip_speed) ** 2 + _TINY  # a coefficient may be 0
    return -mu * weighted / np.sqrt(squares[0] + squares[1] + floor)


def _box(slip: FloatArray, mu: FloatArray, slip_speed: float) -> FloatArray:
    return -mu * slip / np.sqrt(slip * slip + slip_speed**2)


def _transeth(slip: FloatArray, mu: FloatArray, slip_speed: float) -> FloatArray:
    squares = slip * slip
    return -mu * slip / np.sqrt(squares[0] + squares[1] + slip_speed**2)


_LAWS: dict[FrictionLaw, Callable[[FloatArray, FloatArray, float], FloatArray]] = {
    FrictionLaw.ELLIPSE: _ellipse,
    FrictionLaw.BOX: _box,
    FrictionLaw.TRANSETH: _transeth,
}


def friction_force(
    slip: FloatArray, normal: FloatArray, mu: FloatArray, slip_speed: float, law: FrictionLaw
) -> FloatArray:
    """Friction along a link's tangential and normal axes.

    With one component of slip alone, all three laws give -mu N v / sqrt(v^2 + eps^2), eps the
    ``slip_speed``; they differ in oblique slip. None ever feeds energy into the body.

    Args:
        slip: Velocity of the contact points along (tangential, normal) [m/s], shape (2, n).
        normal: Normal force [N], shape (n,).
        mu: (mu_t, mu_n), shape (2, 1).
        slip_speed: eps [m/s].
        law: One of Coulomb's: how the two coefficients combine.

    Returns:
        Force along (tangential, normal) [N], shape (2, n).
    """
    return _LAWS[law](slip, mu, slip_speed) * normal


def drag_force(slip: FloatArray, depth: FloatArray, drag: FloatArray) -> FloatArray:
    """Viscous drag along a link's tangential and normal axes, F_i = -c_i v_i.

    It is that of resistive-force theory (Gray & Hancock, J. Exp. Biol. 32, 1955): linear in the
    slip and independent of the load.

    Args:
        slip: Velocity of the contact points along (tangential, normal) [m/s], shape (2, n).
        depth: Of the contact points below the surface; there is no drag above it [m], shape (n,).
        drag: (c_t, c_n) [N s/m], shape (2, 1).

    Returns:
        Force along (tangential, normal) [N], shape (2, n).
    """
    return -drag * slip * (depth > 0.0)


def tangents(quaternion: FloatArray) -> FloatArray:
    """Unit vectors on the ground below the links' x axes.

    Args:
        quaternion: Orientations x, y, z, w as rows, shape (4, n).

    Returns:
        World x and y of the tangential axes, shape (2, n); zero for a vertical link.
    """
    x, y, z, w = quaternion
    tangent = np.empty((2, quaternion.shape[1]))
    # Half of the first two entries of the rotation's first column.
    along_x = np.subtract(0.5, y * y + z * z, out=tangent[0])
    along_y = np.add(x * y, z * w, out=tangent[1])
    length = np.sqrt(along_x * along_x + along_y * along_y)
    tangent /= np.maximum(length, _TINY)
    return tangent


def into_link_axes(tangent: FloatArray, vector: FloatArray) -> FloatArray:
    """Horizontal components of world vectors along the links' tangential and normal axes.

    Args:
        tangent: World x and y of the tangential axes, shape (..., 2, n).
        vector: World x, y and perhaps z, shape (..., 2 or 3, n).

    Returns:
        Components along (tangential, normal), shape (..., 2, n).
    """
    tx, ty = tangent[..., 0, :], tangent[..., 1, :]
    x, y = vector[..., 0, :], vector[..., 1, :]
    parts = np.empty_like(tangent)
    np.add(tx * x, ty * y, out=parts[..., 0, :])
    np.subtract(tx * y, ty * x, out=parts[..., 1, :])
    return parts


class Contact(NamedTuple):
    """The ground's action on all links at one instant.

    Attributes:
        velocity: Velocity of the contact points in the world [m/s], shape (3, n).
        tangent: World x and y of the tangential axes, shape (2, n).
        depth: Of the contact points below the surface, negative above it [m], shape (n,).
        force: Force on the links in the world, at the contact points [N], shape (3, n).
    """

    velocity: FloatArray
    tangent: FloatArray
    depth: FloatArray
    force: FloatArray


ContactLaw: TypeAlias = Callable[[FloatArray, FloatArray, FloatArray, FloatArray], Contact]


def contact_law(ground: Ground | None, radius: FloatArray) -> ContactLaw:
    """The ground's law, ready for one body.

    Args:
        ground: The ground, or None where there is none: no force at all.
        radius: Radii of the links [m], shape (n,).

    Returns:
        A pure function of the links' centres, orientations (x, y, z, w), velocities and angular
        velocities in the world, of shapes (3, n), (4, n), (3, n), (3, n), to a :class:`Contact`.
    """
    surface = ground or Ground(stiffness=0.0, damping=0.0)
    mu = np.array([[surface.mu_tangential], [surface.mu_normal]])
    drag = np.array([[surface.drag_tangential], [surface.drag_normal]])

    def resistance(slip: FloatArray, normal: FloatArray, depth: FloatArray) -> FloatArray:
        if surface.law is FrictionLaw.VISCOUS:
            return drag_force(slip, depth, drag)
        return friction_force(slip, normal, mu, surface.slip_speed, surface.law)

    def contact(
        position: FloatArray, quaternion: FloatArray, velocity: FloatArray, spin: FloatArray
    ) -> Contact:
        # The contact point lies r below the centre: v_c = v + omega x (0, 0, -r).
        at_point = velocity.copy()
        at_point[0] -= radius * spin[1]
        at_point[1] += radius * spin[0]
        depth = radius - position[2]
        normal = normal_force(depth, -velocity[2], surface.stiffness, surface.damping)
        tangent = tangents(quaternion)
        slip = into_link_axes(tangent, at_point)
        (tx, ty), (along, across) = tangent, resistance(slip, normal, depth)
        force = np.empty_like(at_point)
        np.subtract(tx * along, ty * across, out=force[0])
        np.add(ty * along, tx * across, out=force[1])
        force[2] = normal
        return Contact(at_point, tangent, depth, force)

    return contact
