"""The articulated body of many runs at once: Featherstone's articulated-body algorithm, compiled.

A block holds :data:`LANES` runs. Its arrays have the run as the last axis, so that the innermost
loops go over runs and a compiler turns them into instructions on several runs at a time; on a GPU
each thread has a run, and the loops have one turn. A run's
numbers never meet those of another run.

The algorithm (Featherstone, Rigid Body Dynamics Algorithms, 2008, Chapter 7) goes through the
chain three times: velocities from head to tail, inertias as the joints let them be felt from tail
to head, accelerations from head to tail. Everything of a link is in the link's own axes and about
its front joint (the head's: its centre), so that a joint is a turn about one axis and a shift along
x. Accelerations are those of the body's points less gravity, which then acts through the head
alone. A joint about y is one about z in axes turned about x by a right angle, y* = -z and z* = y:
the same code is compiled for both.

The integrator is that of :mod:`.sim.physics.mujoco`, semi-implicit Euler: rates first, then angles
by the new rates; the head's angular velocity is kept in the head's axes.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple, cast

import numpy as np
from numba import njit
from numba.extending import overload

from undulog.capture.common.arrays import FloatArray

from ..physics.compiled_kernels import inlined

LANES = 16
"""Runs of a block: two vectors of float64, one of float32, where a vector has 512 bits."""

# Rows of a link, with those of the joint in front of it.
ARM, CENTRE, RADIUS, MASS, INERTIA = 0, 1, 2, 3, 4
"""From the front joint back to the rear joint, and to the centre [m]; principal moments."""
SERVO = 7  # as :attr:`.sim.physics.servo.Servos.table`
ANGLE, RATE, ROTOR, SPEED = 19, 20, 21, 22
TORQUE, COSINE, SINE = 23, 24, 25
BIAS, DRIFT, FEEL, PULL = 26, 32, 37, 42
"""Wrench that velocities and ground ask for; acceleration that velocities make; U / D; u / D."""
SUMS = 43  # of effort, current and voltage since they were last taken
WORK = 46  # mechanical, its absolute value, electrical, its positive part, since the start
LINK_ROWS = 50

# Rows of the head: position, quaternion x y z w, velocity in the world, spin in its own axes.
PLACE, TURN, VELOCITY, SPIN = 0, 3, 7, 10
HEAD_ROWS = 13

# Rows that are carried along the chain: forwards ...
W, V, UP, HEIGHT = 0, 3, 6, 9
"""Angular velocity, velocity and the world's vertical, in a link's axes; height [m]."""
ALONG, ACROSS, LOAD, DEPTH = 10, 11, 12, 13
FASTEST, WHERE, FLAT = 14, 15, 16
# ... from tail to head ...
AI, AH, AM, WRENCH = 19, 25, 34, 40
# ... and back.
A = 46
CARRIED_ROWS = 52

_HALF, _ONE, _TWO = cast("list[float]", [np.float32(x) for x in (0.5, 1.0, 2.0)])
_QUARTER_1, _QUARTER_2 = 1.5707963267341256, 6.077100506506192e-11  # pi/2 in two parts
_SYMMETRIC = ((0, 1, 2), (1, 3, 4), (2, 4, 5))


Lanes = Callable[..., None]
"""A loop over the runs of a block."""


def of_lanes(rows: FloatArray) -> None:
    """Refuse rows of another width than a block's; on a GPU nothing: a thread has one lane.

    With it the compiler knows how far apart rows are, hence that they don't overlap. The number of
    lanes is an argument all the same: a loop of known length is unrolled before it is vectorised.
    """


@overload(of_lanes)
def _of_lanes(rows: FloatArray) -> Callable[[FloatArray], None]:  # noqa: ARG001 - its type
    def check(rows: FloatArray) -> None:
        if rows.shape[1] != LANES:
            raise ValueError

    return check


def floor(x: float) -> float:
    """The largest whole number that isn't above x, in its precision: np.floor, not on a GPU."""
    return np.floor(x)


@overload(floor)
def _floor(x: float) -> Callable[[float], float]:  # noqa: ARG001 - its type
    def of_numpy(x: float) -> float:
        return np.floor(x)

    return of_numpy


@inlined
def _sine_cosine(x: float) -> tuple[float, float]:
    """Sine and cosine, for angles up to some thousand turns [rad]."""
    real = type(x)
    quarters = floor(x * real(2 / math.pi) + _HALF)
    r = x - quarters * real(_QUARTER_1) - quarters * real(_QUARTER_2)
    z = r * r
    s = real(1 / 6227020800) * z - real(1 / 39916800)
    s = (s * z + real(1 / 362880)) * z - real(1 / 5040)
    s = (s * z + real(1 / 120)) * z - real(1 / 6)
    s = r + r * z * s
    c = real(1 / 479001600) - real(1 / 87178291200) * z
    c = (c * z - real(1 / 3628800)) * z + real(1 / 40320)
    c = (c * z - real(1 / 720)) * z + real(1 / 24)
    c = _ONE - _HALF * z + z * z * c
    halves = floor(quarters * _HALF)
    sign = _ONE - _TWO * (halves - _TWO * floor(halves * _HALF))
    odd = quarters != _TWO * halves
    return sign * (c if odd else s), sign * (-s if odd else c)


class JointPasses(NamedTuple):
    """The passes of the algorithm over a joint of one plane."""

    forward: Lanes
    backward: Lanes
    accelerate: Lanes


def _joint(vertical: bool) -> JointPasses:
    """Compile the passes over a joint about y (vertical) or z."""
    Y, Z, SIGN = (2, 1, -1.0) if vertical else (1, 2, 1.0)
    IXY, IXZ, IYY, IYZ, IZZ = (
        AI + _SYMMETRIC[a][b] for a, b in ((0, Y), (0, Z), (Y, Y), (Y, Z), (Z, Z))
    )
    MXY, MXZ, MYY, MYZ, MZZ = (k - AI + AM for k in (IXY, IXZ, IYY, IYZ, IZZ))
    HXY, HXZ, HYX, HZX = AH + Y, AH + Z, AH + 3 * Y, AH + 3 * Z
    HYY, HYZ, HZY, HZZ = HYX + Y, HYX + Z, HZX + Y, HZX + Z
    F = WRENCH + 3

    @njit(error_model="numpy")
    def forward(front: FloatArray, link: FloatArray, carried: FloatArray, lanes: int) -> None:
        """From the front joint of a link to that of the next."""
        of_lanes(front)
        of_lanes(link)
        of_lanes(carried)
        sign = carried.dtype.type(SIGN)
        for r in range(lanes):
            s, c = _sine_cosine(link[ANGLE, r])
            arm, rate = front[ARM, r], link[RATE, r]
            wx, wy, wz = carried[W, r], sign * carried[W + Y, r], carried[W + Z, r]
            vx, vy, vz = carried[V, r], sign * carried[V + Y, r], carried[V + Z, r]
            kx, ky = carried[UP, r], sign * carried[UP + Y, r]
            vy, vz = vy + arm * wz, vz - arm * wy
            ax, ay, az = -arm * (wy * wy + wz * wz), arm * wx * wy, arm * wx * wz
            wx, wy = c * wx + s * wy, c * wy - s * wx
            carried[HEIGHT, r] += arm * kx
            carried[W, r], carried[W + Y, r], carried[W + Z, r] = wx, sign * wy, wz + rate
            carried[V, r], carried[V + Y, r] = c * vx + s * vy, sign * (c * vy - s * vx)
            carried[V + Z, r] = vz
            carried[UP, r], carried[UP + Y, r] = c * kx + s * ky, sign * (c * ky - s * kx)
            link[COSINE, r], link[SINE, r] = c, s
            link[DRIFT, r], link[DRIFT + 1, r] = rate * wy, -rate * wx
            link[DRIFT + 2, r], link[DRIFT + 3, r] = c * ax + s * ay, c * ay - s * ax
            link[DRIFT + 4, r] = az

    @njit(error_model="numpy")
    def backward(front: FloatArray, link: FloatArray, carried: FloatArray, lanes: int) -> None:
        """From what is behind a link to what is behind the link before it."""
        of_lanes(front)
        of_lanes(link)
        of_lanes(carried)
        sign = carried.dtype.type(SIGN)
        for r in range(lanes):
            # The link and all behind it, about its front joint.
            mass, centre = link[MASS, r], link[CENTRE, r]
            static = mass * centre
            ixx, ixy = carried[AI, r] + link[INERTIA, r], sign * carried[IXY, r]
            ixz, iyz = carried[IXZ, r], sign * carried[IYZ, r]
            iyy = carried[IYY, r] + link[INERTIA + Y, r] + static * centre
            izz = carried[IZZ, r] + link[INERTIA + Z, r] + static * centre
            hxx, hxy, hxz = carried[AH, r], sign * carried[HXY, r], carried[HXZ, r]
            hyx, hyy = sign * carried[HYX, r], carried[HYY, r]
            hyz = sign * carried[HYZ, r] - static
            hzx, hzy, hzz = carried[HZX, r], sign * carried[HZY, r] + static, carried[HZZ, r]
            mxx, mxy, mxz = carried[AM, r] + mass, sign * carried[MXY, r], carried[MXZ, r]
            myy, myz = carried[MYY, r] + mass, sign * carried[MYZ, r]
            mzz = carried[MZZ, r] + mass
            nx = carried[WRENCH, r] + link[BIAS, r]
            ny = sign * (carried[WRENCH + Y, r] + link[BIAS + Y, r])
            nz = carried[WRENCH + Z, r] + link[BIAS + Z, r]
            fx = carried[F, r] + link[BIAS + 3, r]
            fy = sign * (carried[F + Y, r] + link[BIAS + 3 + Y, r])
            fz = carried[F + Z, r] + link[BIAS + 3 + Z, r]
            ax, ay = link[DRIFT, r], link[DRIFT + 1, r]
            bx, by, bz = link[DRIFT + 2, r], link[DRIFT + 3, r], link[DRIFT + 4, r]
            nx += ixx * ax + ixy * ay + hxx * bx + hxy * by + hxz * bz
            ny += ixy * ax + iyy * ay + hyx * bx + hyy * by + hyz * bz
            nz += ixz * ax + iyz * ay + hzx * bx + hzy * by + hzz * bz
            fx += hxx * ax + hyx * ay + mxx * bx + mxy * by + mxz * bz
            fy += hxy * ax + hyy * ay + mxy * bx + myy * by + myz * bz
            fz += hxz * ax + hyz * ay + mxz * bx + myz * by + mzz * bz
            # What the joint lets through.
            give = _ONE / izz
            gx, gy, px, py, pz = ixz * give, iyz * give, hzx * give, hzy * give, hzz * give
            torque = link[TORQUE, r]
            pull = (torque - nz) * give
            link[FEEL, r], link[FEEL + 1, r], link[FEEL + 2, r] = gx, gy, px
            link[FEEL + 3, r], link[FEEL + 4, r], link[PULL, r] = py, pz, pull
            nx, ny, nz = nx + ixz * pull, ny + iyz * pull, torque
            fx, fy, fz = fx + hzx * pull, fy + hzy * pull, fz + hzz * pull
            ixx, ixy, iyy = ixx - ixz * gx, ixy - ixz * gy, iyy - iyz * gy
            hxx, hxy, hxz = hxx - ixz * px, hxy - ixz * py, hxz - ixz * pz
            hyx, hyy, hyz = hyx - iyz * px, hyy - iyz * py, hyz - iyz * pz
            mxx, mxy, mxz = mxx - hzx * px, mxy - hzx * py, mxz - hzx * pz
            myy, myz, mzz = myy - hzy * py, myz - hzy * pz, mzz - hzz * pz
            # Into the axes of the link before it: vectors (x, y) -> (c x - s y, s x + c y).
            c, s = link[COSINE, r], link[SINE, r]
            cc, ss, cs = c * c, s * s, c * s
            nx, ny, fx, fy = c * nx - s * ny, s * nx + c * ny, c * fx - s * fy, s * fx + c * fy
            both = _TWO * cs * ixy
            ixy = cs * (ixx - iyy) + (cc - ss) * ixy
            ixx, iyy = cc * ixx + ss * iyy - both, ss * ixx + cc * iyy + both
            both = _TWO * cs * mxy
            mxy = cs * (mxx - myy) + (cc - ss) * mxy
            mxx, myy = cc * mxx + ss * myy - both, ss * mxx + cc * myy + both
            mxz, myz = c * mxz - s * myz, s * mxz + c * myz
            hxx, hyx = c * hxx - s * hyx, s * hxx + c * hyx
            hxy, hyy = c * hxy - s * hyy, s * hxy + c * hyy
            hxx, hxy = c * hxx - s * hxy, s * hxx + c * hxy
            hyx, hyy = c * hyx - s * hyy, s * hyx + c * hyy
            hxz, hyz = c * hxz - s * hyz, s * hxz + c * hyz
            # About the front joint of that link.
            arm = front[ARM, r]
            ixy -= arm * hxz
            iyy -= arm * hyz
            hyx, hyy, hyz = hyx - arm * mxz, hyy - arm * myz, hyz - arm * mzz
            iyy -= arm * hyz
            carried[AI, r], carried[IXY, r], carried[IXZ, r] = ixx, sign * ixy, arm * hxy
            carried[IYY, r], carried[IYZ, r] = iyy, sign * arm * hyy
            carried[IZZ, r] = arm * arm * myy
            carried[AH, r], carried[HXY, r], carried[HXZ, r] = hxx, sign * hxy, hxz
            carried[HYX, r], carried[HYY, r], carried[HYZ, r] = sign * hyx, hyy, sign * hyz
            carried[HZX, r], carried[HZY, r] = arm * mxy, sign * arm * myy
            carried[HZZ, r] = arm * myz
            carried[AM, r], carried[MXY, r], carried[MXZ, r] = mxx, sign * mxy, mxz
            carried[MYY, r], carried[MYZ, r], carried[MZZ, r] = myy, sign * myz, mzz
            carried[WRENCH, r], carried[WRENCH + Y, r] = nx, sign * (ny - arm * fz)
            carried[WRENCH + Z, r] = nz + arm * fy
            carried[F, r], carried[F + Y, r], carried[F + Z, r] = fx, sign * fy, fz

    @njit(error_model="numpy")
    def accelerate(
        front: FloatArray, link: FloatArray, carried: FloatArray, dt: float, lanes: int
    ) -> None:
        """Advance a joint, and go on to its link."""
        of_lanes(front)
        of_lanes(link)
        of_lanes(carried)
        sign = carried.dtype.type(SIGN)
        for r in range(lanes):
            c, s, arm = link[COSINE, r], link[SINE, r], front[ARM, r]
            ax, ay, az = carried[A, r], sign * carried[A + Y, r], carried[A + Z, r]
            bx, by = carried[A + 3, r], sign * carried[A + 3 + Y, r] + arm * az
            bz = carried[A + 3 + Z, r] - arm * ay
            ax, ay, bx, by = c * ax + s * ay, c * ay - s * ax, c * bx + s * by, c * by - s * bx
            felt = link[FEEL, r] * ax + link[FEEL + 1, r] * ay
            felt += link[FEEL + 2, r] * bx + link[FEEL + 3, r] * by + link[FEEL + 4, r] * bz
            joint = link[PULL, r] - (az + felt)
            carried[A, r], carried[A + Y, r] = ax + link[DRIFT, r], sign * (ay + link[DRIFT + 1, r])
            carried[A + Z, r], carried[A + 3, r] = az + joint, bx + link[DRIFT + 2, r]
            carried[A + 3 + Y, r] = sign * (by + link[DRIFT + 3, r])
            carried[A + 3 + Z, r] = bz + link[DRIFT + 4, r]
            before = link[RATE, r]
            after = before + dt * joint
            work = dt * _HALF * (before + after) * link[TORQUE, r]
            link[WORK, r] += work
            link[WORK + 1, r] += abs(work)
            link[RATE, r] = after
            link[ANGLE, r] += dt * after

    return JointPasses(forward, backward, accelerate)


YAW_FORWARD, YAW_BACKWARD, YAW_ACCELERATE = _joint(vertical=False)
PITCH_FORWARD, PITCH_BACKWARD, PITCH_ACCELERATE = _joint(vertical=True)


@njit(error_model="numpy")
def begin(head: FloatArray, carried: FloatArray, lanes: int) -> None:
    """Carry the head's motion, in its own axes."""
    of_lanes(head)
    of_lanes(carried)
    for r in range(lanes):
        x, y, z, w = head[TURN, r], head[TURN + 1, r], head[TURN + 2, r], head[TURN + 3, r]
        vx, vy, vz = head[VELOCITY, r], head[VELOCITY + 1, r], head[VELOCITY + 2, r]
        xx, yy, zz, xy, xz, yz = x * x, y * y, z * z, x * y, x * z, y * z
        wx, wy, wz = w * x, w * y, w * z
        kx, ky, kz = _TWO * (xz - wy), _TWO * (yz + wx), _ONE - _TWO * (xx + yy)
        carried[V, r] = (_ONE - _TWO * (yy + zz)) * vx + _TWO * (xy + wz) * vy + kx * vz
        carried[V + 1, r] = _TWO * (xy - wz) * vx + (_ONE - _TWO * (xx + zz)) * vy + ky * vz
        carried[V + 2, r] = _TWO * (xz + wy) * vx + _TWO * (yz - wx) * vy + kz * vz
        carried[UP, r], carried[UP + 1, r], carried[UP + 2, r] = kx, ky, kz
        carried[W, r], carried[W + 1, r] = head[SPIN, r], head[SPIN + 1, r]
        carried[W + 2, r] = head[SPIN + 2, r]
        carried[HEIGHT, r] = head[PLACE + 2, r]


@inlined
def _solve(
    a: float, b: float, c: float, d: float, e: float, f: float, x: float, y: float, z: float
) -> tuple[float, float, float]:
    """Solve [[a b c] [b d e] [c e f]] u = (x, y, z), positive definite, by L D L^T."""
    p, q = b / a, c / a
    d -= p * b
    e -= p * c
    t = e / d
    f -= q * c + t * e
    y -= p * x
    z = (z - q * x - t * y) / f
    y = y / d - t * z
    return x / a - p * y - q * z, y, z


@njit(error_model="numpy")
def accelerate_head(
    link: FloatArray,
    head: FloatArray,
    carried: FloatArray,
    gravity: FloatArray,
    dt: float,
    lanes: int,
) -> None:
    """Advance the head, on which no joint acts: [I H; H^T M] (alpha, a) = -(n, f)."""
    of_lanes(link)
    of_lanes(head)
    of_lanes(carried)
    of_lanes(gravity)
    real = carried.dtype.type
    for r in range(lanes):
        mass = link[MASS, r]
        ixx, ixy, ixz = carried[AI, r] + link[INERTIA, r], carried[AI + 1, r], carried[AI + 2, r]
        iyy, iyz = carried[AI + 3, r] + link[INERTIA + 1, r], carried[AI + 4, r]
        izz = carried[AI + 5, r] + link[INERTIA + 2, r]
        hxx, hxy, hxz = carried[AH, r], carried[AH + 1, r], carried[AH + 2, r]
        hyx, hyy, hyz = carried[AH + 3, r], carried[AH + 4, r], carried[AH + 5, r]
        hzx, hzy, hzz = carried[AH + 6, r], carried[AH + 7, r], carried[AH + 8, r]
        mxx, mxy, mxz = carried[AM, r] + mass, carried[AM + 1, r], carried[AM + 2, r]
        myy, myz, mzz = carried[AM + 3, r] + mass, carried[AM + 4, r], carried[AM + 5, r] + mass
        n, f = WRENCH, WRENCH + 3
        fx, fy = carried[f, r] + link[BIAS + 3, r], carried[f + 1, r] + link[BIAS + 4, r]
        fz = carried[f + 2, r] + link[BIAS + 5, r]
        gx, gy, gz = _solve(mxx, mxy, mxz, myy, myz, mzz, fx, fy, fz)
        xx, xy, xz = _solve(mxx, mxy, mxz, myy, myz, mzz, hxx, hxy, hxz)
        yx, yy, yz = _solve(mxx, mxy, mxz, myy, myz, mzz, hyx, hyy, hyz)
        zx, zy, zz = _solve(mxx, mxy, mxz, myy, myz, mzz, hzx, hzy, hzz)
        ax, ay, az = _solve(
            ixx - (hxx * xx + hxy * xy + hxz * xz),
            ixy - (hxx * yx + hxy * yy + hxz * yz),
            ixz - (hxx * zx + hxy * zy + hxz * zz),
            iyy - (hyx * yx + hyy * yy + hyz * yz),
            iyz - (hyx * zx + hyy * zy + hyz * zz),
            izz - (hzx * zx + hzy * zy + hzz * zz),
            hxx * gx + hxy * gy + hxz * gz - (carried[n, r] + link[BIAS, r]),
            hyx * gx + hyy * gy + hyz * gz - (carried[n + 1, r] + link[BIAS + 1, r]),
            hzx * gx + hzy * gy + hzz * gz - (carried[n + 2, r] + link[BIAS + 2, r]),
        )
        bx = -(gx + xx * ax + yx * ay + zx * az)
        by = -(gy + xy * ax + yy * ay + zy * az)
        bz = -(gz + xz * ax + yz * ay + zz * az)
        carried[A, r], carried[A + 1, r], carried[A + 2, r] = ax, ay, az
        carried[A + 3, r], carried[A + 4, r], carried[A + 5, r] = bx, by, bz
        x, y, z, w = head[TURN, r], head[TURN + 1, r], head[TURN + 2, r], head[TURN + 3, r]
        # v + 2 w (u x v) + 2 u x (u x v): into the world.
        cx, cy, cz = y * bz - z * by, z * bx - x * bz, x * by - y * bx
        vx = head[VELOCITY, r]
        vx += dt * (bx + _TWO * (w * cx + y * cz - z * cy) + gravity[0, r])
        vy = head[VELOCITY + 1, r]
        vy += dt * (by + _TWO * (w * cy + z * cx - x * cz) + gravity[1, r])
        vz = head[VELOCITY + 2, r]
        vz += dt * (bz + _TWO * (w * cz + x * cy - y * cx) + gravity[2, r])
        head[VELOCITY, r], head[VELOCITY + 1, r], head[VELOCITY + 2, r] = vx, vy, vz
        head[PLACE, r] += dt * vx
        head[PLACE + 1, r] += dt * vy
        head[PLACE + 2, r] += dt * vz
        sx, sy, sz = (
            head[SPIN, r] + dt * ax,
            head[SPIN + 1, r] + dt * ay,
            head[SPIN + 2, r] + dt * az,
        )
        head[SPIN, r], head[SPIN + 1, r], head[SPIN + 2, r] = sx, sy, sz
        # By exp(dt s): sin(a)/a and cos(a) of half the angle by their series.
        half = _HALF * dt
        sx, sy, sz = half * sx, half * sy, half * sz
        square = sx * sx + sy * sy + sz * sz
        sine = _ONE - square * real(1 / 110) * (_ONE - square * real(1 / 156))
        sine = _ONE - square * real(1 / 42) * (_ONE - square * real(1 / 72) * sine)
        sine = _ONE - square * real(1 / 6) * (_ONE - square * real(1 / 20) * sine)
        cosine = _ONE - square * real(1 / 90) * (_ONE - square * real(1 / 132))
        cosine = _ONE - square * real(1 / 30) * (_ONE - square * real(1 / 56) * cosine)
        cosine = _ONE - square * _HALF * (_ONE - square * real(1 / 12) * cosine)
        sx, sy, sz = sine * sx, sine * sy, sine * sz
        tx = x * cosine + w * sx + y * sz - z * sy
        ty = y * cosine + w * sy + z * sx - x * sz
        tz = z * cosine + w * sz + x * sy - y * sx
        tw = w * cosine - x * sx - y * sy - z * sz
        unit = _ONE / math.sqrt(tx * tx + ty * ty + tz * tz + tw * tw)
        head[TURN, r], head[TURN + 1, r] = unit * tx, unit * ty
        head[TURN + 2, r], head[TURN + 3, r] = unit * tz, unit * tw
