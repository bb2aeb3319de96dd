"""A planar chain of links under resistive drag, without inertia: its velocity in closed form.

Each link feels the force -c_t v_t - c_n v_n at its centre (resistive-force theory, Gray & Hancock
1955) and, as a slender rod, a moment; the sums of forces and moments about the head are zero.
Everything is in complex numbers, x + j y in the axes of the head link.
"""

import numpy as np

from undulog.analysis.parts.body.travel import HARMONICS, GaitCycle, step_of_cycle, wave_at

_STEP = 1e-6


class Swimmer:
    """A chain of links of one length; ``turning`` is the drag moment c_n L^3 / 12, or less."""

    def __init__(self, length=1.0, tangential=1.0, normal=10.0, turning=None):
        self.length, self.tangential, self.normal = length, tangential, normal
        self.turning = normal * length**3 / 12 if turning is None else turning

    def links(self, angles):
        """Return centres and orientations of the links."""
        turned = np.concatenate([[0.0], np.cumsum(angles)])
        half = self.length / 2 * np.exp(1j * turned)
        return np.concatenate([[0.0], -np.cumsum(half[:-1] + half[1:])]), turned

    def wrench(self, centres, turned, velocity, spin):
        """Return force and moment about the head that the ground exerts."""
        local = velocity * np.exp(-1j * turned)
        drag = self.length * (self.tangential * local.real + 1j * self.normal * local.imag)
        force = -drag * np.exp(1j * turned)
        moment = np.imag(np.conj(centres) * force) - self.turning * spin
        return np.array([force.sum().real, force.sum().imag, moment.sum()])

    def at_head(self, angles):
        """Return the head's velocity (forward, left, turning) for each joint's rate, (3, m)."""
        centres, turned = self.links(angles)
        still = np.zeros(turned.size)
        body = [
            self.wrench(centres, turned, 1.0 + 0 * centres, still),
            self.wrench(centres, turned, 1j + 0 * centres, still),
            self.wrench(centres, turned, 1j * centres, still + 1.0),
        ]
        joints = []
        for k in range(len(angles)):
            off = np.zeros(len(angles))
            off[k] = _STEP
            (after, spun), (before, turned_back) = (
                self.links(angles + off),
                self.links(angles - off),
            )
            slide, spin = (after - before) / (2 * _STEP), (spun - turned_back) / (2 * _STEP)
            joints.append(self.wrench(centres, turned, slide, spin))
        return -np.linalg.solve(np.array(body).T, np.array(joints).T)

    def chassis(self, angles):
        """Return place and heading of the virtual chassis, by singular value decomposition."""
        centres, _ = self.links(angles)
        off = centres - centres.mean()
        _, _, axes = np.linalg.svd(np.stack([off.real, off.imag], axis=-1))
        axis = complex(*axes[0])
        ahead = np.real(np.conj(axis) * (off[0] - off[-1])) >= 0
        return centres.mean(), np.angle(axis if ahead else -axis)

    def connection(self, angles):
        """Return the chassis' velocity in its own axes for each joint's rate, shape (3, m)."""
        place, heading = self.chassis(angles)
        connection_form = np.zeros((3, len(angles)))
        for k, (x, y, turn) in enumerate(self.at_head(angles).T):
            off = np.zeros(len(angles))
            off[k] = _STEP
            (after, ahead), (before, behind) = (
                self.chassis(angles + off),
                self.chassis(angles - off),
            )
            moved = x + 1j * y + 1j * turn * place + (after - before) / (2 * _STEP)
            moved *= np.exp(-1j * heading)
            spun = np.angle(np.exp(1j * (ahead - behind))) / (2 * _STEP)
            connection_form[:, k] = moved.real, moved.imag, turn + spun
        return connection_form

    def cycle(self, shape, omega=1.0, count=32):
        """Return one cycle of a gait, from Fourier coefficients of its m angles."""
        phase = 2 * np.pi * np.arange(count) / count
        rate = wave_at(1j * np.arange(shape.shape[1]) * shape, phase)
        angles = wave_at(shape, phase)
        velocity = np.stack(
            [self.connection(angle) @ rate[:, k] for k, angle in enumerate(angles.T)], axis=1
        )
        spectrum = 2 * np.fft.rfft(velocity, axis=1) / count
        spectrum[:, 0] /= 2
        names = tuple(f"joint{k + 1:02d}" for k in range(len(shape)))
        step = step_of_cycle(velocity)
        return GaitCycle(names, shape, spectrum[:, : HARMONICS + 1], omega, np.tile(step, (3, 1)))


def three_modes(joints, lag=1.0):
    """Return orthonormal columns: the two of a wave and an even bend."""
    k = np.arange(joints) - (joints - 1) / 2
    return np.linalg.qr(np.stack([np.cos(lag * k), np.sin(lag * k), np.ones(joints)], axis=1))[0]


def perturbed_gaits(joints, count, size, seed, amplitude=0.4):
    """Return a wave and perturbed ones, in three modes: shapes, (count, joints, 1 + HARMONICS)."""
    random = np.random.default_rng(seed)
    scale = amplitude * (joints / 2) ** 0.5
    shapes = np.zeros((count, 3, HARMONICS + 1), dtype=np.complex128)
    shapes[:, 0, 1], shapes[:, 1, 1] = scale, -1j * scale
    off = random.uniform(-1, 1, (3, count - 1, 3)) * size * scale
    shapes[1:, :, 1] += off[0] + 1j * off[1]
    shapes[1:, :, 0] += off[2]
    return three_modes(joints) @ shapes
