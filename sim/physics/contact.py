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

from collections.abc import Callable, Iterable
from typing import NamedTuple, TypeAlias

import numpy as np

from undulog.capture.common.arrays import FloatArray, frozen

from ..scenario.world import FrictionLaw, Ground
from .engine import BodyState

_NEXT, _LAST = frozen(np.array([1, 2, 0])), frozen(np.array([2, 0, 1]))

_TINY = 1e-300  # makes 0/0 a zero


PerNewton: TypeAlias = Callable[[FloatArray], FloatArray]
"""Friction along (tangential, normal) for a load of 1 N, given the slip, both of shape (2, n)."""


def cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """Cross products; ``numpy.cross`` costs six times as much on short arrays.

    Args:
        a: Vectors, shape (3, n).
        b: Vectors, shape (3, n).

    Returns:
        a x b, shape (3, n).
    """
    return a.take(_NEXT, 0) * b.take(_LAST, 0) - a.take(_LAST, 0) * b.take(_NEXT, 0)


def into_frames(quaternion: FloatArray, vector: FloatArray) -> FloatArray:
    """World vectors in frames of their own: v - 2 w (u x v) + 2 u x (u x v).

    Args:
        quaternion: Orientations of the frames, u and w, shape (4, n).
        vector: In the world, shape (3, n).

    Returns:
        The same vectors in the frames, shape (3, n).
    """
    u, w = quaternion[:3], quaternion[3]
    turned = cross(u, vector)
    return vector - 2.0 * w * turned + 2.0 * cross(u, turned)


def out_of_frames(quaternion: FloatArray, vector: FloatArray) -> FloatArray:
    """Vectors in frames of their own in the world; undoes :func:`into_frames`.

    Args:
        quaternion: Orientations of the frames, u and w, shape (4, n).
        vector: In the frames, shape (3, n).

    Returns:
        The same vectors in the world, shape (3, n).
    """
    u, w = quaternion[:3], quaternion[3]
    turned = cross(u, vector)
    return vector + 2.0 * w * turned + 2.0 * cross(u, turned)


def normal_force(
    penetration: FloatArray,
    rate: FloatArray,
    stiffness: float | FloatArray,
    damping: float | FloatArray,
    out: FloatArray | None = None,
) -> FloatArray:
    """Normal force of the ground, Eq. 7 of Meister et al. 2011, clamped so that it never pulls.

    F_n = max(0, -k p_z - d v_z) where p_z < 0, else 0; here with the penetration -p_z.

    Args:
        penetration: Depth below the surface, negative above it [m], shape (n,).
        rate: Rate of the depth, -v_z [m/s], shape (n,).
        stiffness: k [N/m].
        damping: d [N s/m].
        out: Where the result goes; a new array by default.

    Returns:
        Force [N], never negative, shape (n,).
    """
    force = np.maximum(stiffness * penetration + damping * rate, 0.0)
    return np.multiply(force, np.heaviside(penetration, 0.0), out=out)


def _ellipse(mu: FloatArray, slip_speed: float) -> PerNewton:
    against = -mu * mu
    floor = (mu * slip_speed) ** 2 + _TINY  # a coefficient may be 0

    def friction(slip: FloatArray) -> FloatArray:
        weighted = against * slip
        power = weighted * slip
        return weighted / np.sqrt(floor - (power[0] + power[1]))

    return friction


def _box(mu: FloatArray, slip_speed: float) -> PerNewton:
    return lambda slip: -mu * slip / np.sqrt(slip * slip + slip_speed**2)


def _transeth(mu: FloatArray, slip_speed: float) -> PerNewton:
    def friction(slip: FloatArray) -> FloatArray:
        squares = slip * slip
        return -mu * slip / np.sqrt(squares[0] + squares[1] + slip_speed**2)

    return friction


FRICTION: dict[FrictionLaw, Callable[[FloatArray, float], PerNewton]] = {
    FrictionLaw.ELLIPSE: _ellipse,
    FrictionLaw.BOX: _box,
    FrictionLaw.TRANSETH: _transeth,
}
"""Coulomb's laws, given (mu_t, mu_n), shape (2, 1) or (2, n), and the slip speed eps [m/s].

With one component of slip alone, all three give -mu N v / sqrt(v^2 + eps^2); they differ in oblique
slip. None ever feeds energy into the body."""


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


def tangents(
    quaternion: Iterable[FloatArray],
    out: tuple[FloatArray | None, FloatArray | None] = (None, None),
) -> tuple[FloatArray, FloatArray]:
    """Unit vectors on the ground below the links' x axes.

    Args:
        quaternion: Orientations x, y, z, w, each of shape (n,).
        out: Where the result goes; new arrays by default.

    Returns:
        World x and y of the tangential axes, each of shape (n,); zero for a vertical link.
    """
    x, y, z, w = quaternion
    # Half of the first two entries of the rotation's first column.
    along_x, along_y = 0.5 - (y * y + z * z), x * y + z * w
    length = np.maximum(np.hypot(along_x, along_y), _TINY)
    return np.divide(along_x, length, out=out[0]), np.divide(along_y, length, out=out[1])


def into_link_axes(
    tx: FloatArray,
    ty: FloatArray,
    x: FloatArray,
    y: FloatArray,
    out: tuple[FloatArray | None, FloatArray | None] = (None, None),
) -> tuple[FloatArray, FloatArray]:
    """Horizontal world vectors along the links' tangential and normal axes.

    Args:
        tx: World x of the tangential axes, shape (..., n).
        ty: World y of the tangential axes, same shape.
        x: World x of the vectors, same shape.
        y: World y of the vectors, same shape.
        out: Where the result goes; new arrays by default.

    Returns:
        Components along (tangential, normal), each of the same shape.
    """
    along = np.add(tx * x, ty * y, out=out[0])
    return along, np.subtract(tx * y, ty * x, out=out[1])


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


class GroundLaw:
    """The ground's law, bound to the arrays where one body's state and contact stand.

    Short arrays cost by the call, not by the element. So components are views that are made once,
    and constants are as wide as what they meet.
    """

    def __init__(
        self, ground: Ground | None, radius: FloatArray, body: BodyState, contact: Contact
    ) -> None:
        """Get ready.

        Args:
            ground: The ground, or None where there is none: no force at all.
            radius: Radii of the links [m], shape (n,).
            body: Where the body's state stands whenever :meth:`act` is called.
        """
        surface = ground or Ground(stiffness=0.0, damping=0.0)
        ones = np.ones((2, len(radius)))
        self._stiffness, self._damping = surface.stiffness * ones[0], surface.damping * ones[0]
        mu = np.array([[surface.mu_tangential], [surface.mu_normal]]) * ones
        self._drag = np.array([[surface.drag_tangential], [surface.drag_normal]]) * ones
        self._friction = (
            None
            if surface.law is FrictionLaw.VISCOUS
            else FRICTION[surface.law](mu, surface.slip_speed)
        )
        self._radius, self._height = radius, body.position[2]
        self._quaternion, self._velocity = tuple(body.quaternion), tuple(body.velocity)
        self._spin = body.spin[0], body.spin[1]
        self._at_point, self._depth = tuple(contact.velocity), contact.depth
        self._tangent = contact.tangent[0], contact.tangent[1]
        self._force = tuple(contact.force)
        self._slip, self._resistance = np.empty_like(ones), np.empty_like(ones)
        self._slip_parts = self._slip[0], self._slip[1]
        self._along, self._across = self._resistance

    def act(self) -> None:
        """Fill in the contact."""
        # The contact point lies r below the centre: v_c = v + omega x (0, 0, -r).
        r, (vx, vy, vz), (wx, wy) = self._radius, self._velocity, self._spin
        x, y, z = self._at_point
        np.subtract(vx, r * wy, out=x)
        np.add(vy, r * wx, out=y)
        np.copyto(z, vz)
        depth = np.subtract(r, self._height, out=self._depth)
        force_x, force_y, normal = self._force
        normal_force(depth, -vz, self._stiffness, self._damping, out=normal)
        # Into the link's axes, where the ground resists, and back.
        tx, ty = tangents(self._quaternion, self._tangent)
        into_link_axes(tx, ty, x, y, self._slip_parts)
        if self._friction is None:
            self._resistance[...] = drag_force(self._slip, depth, self._drag)
        else:
            np.multiply(self._friction(self._slip), normal, out=self._resistance)
        along, across = self._along, self._across
        np.subtract(tx * along, ty * across, out=force_x)
        np.add(ty * along, tx * across, out=force_y)
