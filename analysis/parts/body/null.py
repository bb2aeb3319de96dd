"""The perfect-tracking null: how a planar chain moves when every joint is exactly on its command.

Head, middle and tail of such a chain differ by kinematics alone. How the body moves follows from
the joint angles by a linear condition on the head's velocity xi (Kelly & Murray, J. Robotic
Systems 12, 1995; Hatton & Choset, Int. J. Robotics Research 30, 2011)::

    sum_i G_i^T M_i (G_i xi + s_i) = 0

where G_i xi + s_i is link i's velocity. With M the drag of a slender rod (c_t and c_n = K c_t per
length) this is viscous motion without inertia, force and moment free; with M the link's mass and
inertia it is a free body whose momentum is and stays zero.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from undulog.capture.common.arrays import BoolArray, ComplexArray, FloatArray
from undulog.capture.robot.model import Plane, Robot

from ...signals.columns import DRAG_RATIO

SAMPLES = 128
"""Times per cycle: enough for the eighth harmonic of the head's motion many times over."""


@dataclass(frozen=True)
class RigidChain:
    """A planar chain of rigid links, head first.

    Attributes:
        length: Link lengths [m], shape (n,).
        along: Metric of motion along the link: drag c_t L, or mass, shape (n,).
        across: Metric of motion across the link: drag c_n L, or mass, shape (n,).
        turning: Metric of turning: drag c_n L^3/12, or moment of inertia, shape (n,).
    """

    length: FloatArray
    along: FloatArray
    across: FloatArray
    turning: FloatArray


@dataclass(frozen=True)
class ChainMotion:
    """Motion of a chain over one cycle, from the head at the origin along x.

    Attributes:
        head: Position x + j y of the head's centre [m], shape (samples,).
        heading: Its orientation [rad], shape (samples,).
        angles: Joint angles [rad], shape (samples, m).
        displacement: Of the head over the cycle, x + j y [m].
        turn: Of the head over the cycle [rad].
    """

    head: ComplexArray
    heading: FloatArray
    angles: FloatArray
    displacement: complex
    turn: float


def viscous_chain(robot: Robot, ratio: float = DRAG_RATIO) -> RigidChain:
    """Return the robot's chain under anisotropic viscous drag, without inertia.

    Args:
        ratio: K = c_n / c_t.

    Returns:
        The chain with c_t = 1; the motion doesn't depend on it.
    """
    length = np.array([link.length for link in robot.links])
    return RigidChain(length, length, ratio * length, ratio * length**3 / 12)


def free_chain(robot: Robot, plane: Plane) -> RigidChain:
    """Return the robot's chain that nothing touches, at rest as a whole.

    Args:
        plane: The plane of motion; it says which moment of inertia counts.
    """
    length = np.array([link.length for link in robot.links])
    mass = np.array([link.mass for link in robot.links])
    axis = 2 if plane is Plane.HORIZONTAL else 1
    return RigidChain(length, mass, mass, np.array([link.inertia[axis] for link in robot.links]))


def one_cycle(
    chain: RigidChain, amplitudes: ComplexArray, offsets: FloatArray, omega: float
) -> ChainMotion:
    """Move a chain through one cycle of its gait.

    Args:
        chain: n links.
        amplitudes: Complex amplitudes of the joint angles, theta_i = offset_i +
            Re sum_h amplitudes[i, h - 1] exp(j h omega t), shape (n - 1, harmonics).
        offsets: Mean joint angles [rad], shape (n - 1,).
        omega: Angular frequency [rad/s].

    Returns:
        The motion, at ``SAMPLES`` times of one cycle.
    """
    phase = 2 * np.pi * np.arange(SAMPLES) / SAMPLES
    order: FloatArray = np.arange(1.0, amplitudes.shape[1] + 1)
    wave = np.exp(1j * np.outer(phase, order))
    angles = offsets + np.real(wave @ amplitudes.T)
    velocity = _head_velocity(chain, angles, np.real((1j * order * omega * wave) @ amplitudes.T))
    head, heading, displacement, turn = travel(velocity, omega)
    return ChainMotion(head, heading, angles, displacement, turn)


def travel(velocity: FloatArray, omega: float) -> tuple[ComplexArray, FloatArray, complex, float]:
    """Integrate a velocity that is periodic in the body's own frame.

    Turning and path are integrated in Fourier series, exactly up to the resolution of the cycle.

    Args:
        velocity: Forward, left and turning at even times of one cycle, shape (samples, 3).
        omega: Angular frequency of the cycle [rad/s].

    Returns:
        Positions x + j y, from 0, and headings [rad], from 0, each of shape (samples,); their
        change over the cycle.
    """
    count = len(velocity)
    phase = 2 * np.pi * np.arange(count) / count
    omegas: FloatArray = omega * np.fft.fftfreq(count, 1 / count).astype(np.float64)
    spinning = np.fft.fft(velocity[:, 2]) / count
    mean_turn = float(spinning[0].real)
    swing = np.real(
        np.exp(1j * np.outer(phase / omega, omegas[1:])) @ (spinning[1:] / (1j * omegas[1:]))
    )
    swing -= swing[0]
    # In the world the velocity is exp(j mean_turn t) times something periodic.
    slip = np.fft.fft((velocity[:, 0] + 1j * velocity[:, 1]) * np.exp(1j * swing)) / count
    time_s = np.append(phase, 2 * np.pi) / omega
    path = _integral(omegas + mean_turn, time_s) @ slip
    heading = mean_turn * time_s[:-1] + swing
    return path[:-1], heading, complex(path[-1]), 2 * np.pi * mean_turn / omega


def places(
    chain: RigidChain, motion: ChainMotion, links: tuple[int, ...], cycles: int
) -> ComplexArray:
    """Where some links are over several cycles.

    Args:
        motion: Its motion over one cycle.

    Returns:
        Positions x + j y [m] of the link centres, shape (cycles * SAMPLES, number of links).
    """
    centre, _ = _shape(chain, motion.angles)
    cycle = motion.head[:, None] + np.exp(1j * motion.heading)[:, None] * centre[:, list(links)]
    start, turned = 0j, 1 + 0j
    parts: list[ComplexArray] = []
    for _ in range(cycles):
        parts.append(start + turned * cycle)
        start += turned * motion.displacement
        turned *= np.exp(1j * motion.turn)
    return np.concatenate(parts)


def _shape(chain: RigidChain, angles: FloatArray) -> tuple[ComplexArray, FloatArray]:
    """Link centres x + j y and orientations in the head's frame, each of shape (t, n)."""
    turned = np.concatenate([np.zeros((angles.shape[0], 1)), np.cumsum(angles, axis=1)], axis=1)
    half = chain.length / 2 * np.exp(1j * turned)
    steps = half[:, :-1] + half[:, 1:]
    centre = np.concatenate(
        [np.zeros((angles.shape[0], 1)), -np.cumsum(steps, axis=1)], axis=1
    ).astype(np.complex128)
    return centre, turned


def _head_velocity(chain: RigidChain, angles: FloatArray, rates: FloatArray) -> FloatArray:
    """Return the head's velocity (forward, left, turning) in its own frame, shape (t, 3)."""
    centre, turned = _shape(chain, angles)
    spin = np.concatenate([np.zeros((rates.shape[0], 1)), np.cumsum(rates, axis=1)], axis=1)
    # Velocity of the centres that the joint rates alone cause, the head held.
    half = 1j * spin * chain.length / 2 * np.exp(1j * turned)
    slide = np.zeros_like(centre)
    slide[:, 1:] = -np.cumsum(half[:, :-1] + half[:, 1:], axis=1)
    # Rows (along, across, turning) of every link: G maps the head's velocity, s is the rest.
    link = np.exp(-1j * turned)
    moved = np.stack([link, 1j * link, 1j * centre * link], axis=-1)
    jacobian = np.zeros((*turned.shape, 3, 3))
    jacobian[..., 0, :], jacobian[..., 1, :] = moved.real, moved.imag
    jacobian[..., 2, 2] = 1.0
    rest = np.stack([(slide * link).real, (slide * link).imag, spin], axis=-1)
    metric = np.stack([chain.along, chain.across, chain.turning], axis=-1)
    matrix: FloatArray = np.einsum("tnij,ni,tnik->tjk", jacobian, metric, jacobian)
    force: FloatArray = np.einsum("tnij,ni,tni->tj", jacobian, metric, rest)
    velocity: FloatArray = np.linalg.solve(matrix, -force[..., None]).astype(np.float64)
    return velocity[..., 0]


def _integral(omegas: FloatArray, time_s: FloatArray) -> ComplexArray:
    """Return the integral of exp(j omega t) from 0 to t, shape (times, omegas)."""
    still: BoolArray = np.abs(omegas) * time_s[-1] < 1e-12
    safe = np.where(still, 1.0, omegas)
    turning: ComplexArray = (np.exp(1j * np.outer(time_s, safe)) - 1) / (1j * safe)
    turning[:, still] = time_s[:, None]
    return turning
