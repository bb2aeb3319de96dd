"""How shape moves the body: a first-order model around a gait, from perturbed gaits.

Where friction is viscous or Coulomb's and inertia is small, the body's velocity xi in its own axes
is homogeneous of degree one in the rate of shape: xi(r, s r') = s xi(r, r'), so it may be counted
by the phase of the gait instead of time. Around a cycle r0(phase), with d = r - r0, to first order
(Bittner, Hatton & Revzen, Nonlinear Dynamics 94, 2018, doi 10.1007/s11071-018-4466-9)::

    xi = A(phase) r' + B(phase) d,      A = d xi / d r',  B = d xi / d r

since by Euler's theorem xi(r0, r0') = A r0'. A is the local connection (Hatton & Choset, Int. J.
Robotics Research 30, 2011) on the cycle if xi is linear in r' as under viscous drag, and an
effective one otherwise. A gait that is only later is the same gait, which gives
B r0' = A' r0', the direction that gaits of one phase can't show. A and B are Fourier series in the
phase, fitted by least squares to the mean cycles of all gaits; errors are those of leaving gaits
out one at a time (jackknife), in closed form.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import null_space

from undulog.capture.common.arrays import ComplexArray, FloatArray, frozen
from undulog.capture.common.errors import DataError

from ...estimators.intervals import t_factor
from .travel import HARMONICS, PHASES, GaitCycle, step_of_cycle, wave_at

MIN_GAITS = 8
MOST_MODES = 3
MOST_CONDITION = 100.0
"""The weakest perturbation of a shape mode is at least about this share of the gait itself."""

ORDER = HARMONICS
"""Of A and B as Fourier series in the phase; with fewer terms than the cycles have, A is biased."""

_ALONE = 1 - 1e-6
"""Largest share of its own prediction that a gait may have."""

_CLOSED = 0.01
"""Equations of a shift in phase that are weaker than this share of the strongest are dropped: small
harmonics of the gait would tie A and B together beyond the order that they are known to."""

_GRID: FloatArray = 2 * np.pi * np.arange(32) / 32


@dataclass(frozen=True)
class ShapeBase:
    """Shape modes of several gaits, and the mean gait in them; m joints, k modes, order h.

    Attributes:
        mean: Mean angles of all gaits [rad], shape (m,).
        modes: Orthonormal columns, shape (m, k).
        share: Of the variance of all shapes, shape (k,).
        cycle: r0, complex Fourier coefficients [rad], shape (k, h + 1).
        fundamental: Of the mean gait, the phase of all others is measured against it, shape (m,).
        largest: Root mean square perturbation of each mode, the largest of all gaits [rad], (k,).
        largest_rest: The same of what is outside the modes.
    """

    mean: FloatArray
    modes: FloatArray
    share: FloatArray
    cycle: ComplexArray
    fundamental: ComplexArray
    largest: FloatArray
    largest_rest: float

    def phase(self, shape: ComplexArray) -> float:
        """Return by how much a gait's phase is ahead of the mean gait's [rad]."""
        return float(np.angle(np.vdot(self.fundamental, shape[:, 1])))

    def perturbation(self, shape: ComplexArray) -> tuple[ComplexArray, ComplexArray]:
        """Return r - r0 of a gait in the mean gait's phase, shape (k, h + 1), and the rest."""
        off = turned(shape, self.phase(shape))
        off[:, 0] -= self.mean
        inside = self.modes.T @ off
        return inside - self.cycle, off - self.modes @ inside

    def outside(self, shape: ComplexArray) -> str | None:
        """Return which mode is outside the range of the perturbations, and by how much."""
        inside, rest = self.perturbation(shape)
        size = _size(inside)
        ratio = np.divide(
            size, self.largest, out=np.full(size.size, np.inf), where=self.largest > 0
        )
        worst = int(np.argmax(ratio))
        if ratio[worst] > 1:
            return (
                f"shape mode {worst + 1} is perturbed by {np.degrees(size[worst]):.2g} degrees, "
                f"{ratio[worst]:.3g} times the largest perturbation that the model is fitted to"
            )
        left, most = float(np.linalg.norm(_size(rest))), max(self.largest_rest, self.least)
        if left > most:
            return (
                f"{np.degrees(left):.2g} degrees of its shape are in none of the modes, "
                f"{left / most:.3g} times the most that the model allows"
            )
        return None

    @property
    def least(self) -> float:
        """Return the size of the perturbations that count as none [rad]."""
        return float(np.linalg.norm(_size(self.cycle))) / MOST_CONDITION


@dataclass(frozen=True)
class Connection:
    """A fitted model; k modes, P = 2 ORDER + 1 terms, g gaits.

    Attributes:
        condition: Ratio of the strongest to the weakest direction of shape and rate of shape
            that the gaits show, at the worst phase.
        coefficients: Of A and B by term, shape (2 k P, 3).
        covariance: Of those of each component of velocity, by jackknife, shape (3, 2 k P, 2 k P).
        gram: Inverse of the design's moments in the directions that the gaits show, shape
            (2 k P, 2 k P).
        hidden: The other directions, orthonormal columns, shape (2 k P, d).
        most_hidden: Root mean square part of the gaits in them, the largest of all [rad].
        dof: Degrees of freedom of all errors.
        spread: Standard deviation of a gait's step that the model leaves, shape (3,).
    """

    base: ShapeBase
    condition: float
    coefficients: FloatArray
    covariance: FloatArray
    gram: FloatArray
    hidden: FloatArray
    most_hidden: float
    dof: float
    spread: FloatArray

    def matrices(self, phase: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return A and the half width of its 95 % interval, each of shape (n, 3, k)."""
        count = self.base.share.size
        terms = _terms(phase)
        coefficients = self.coefficients.reshape(2, count, -1, 3)[0]
        value = np.einsum("np,kpc->nck", terms, coefficients)
        parts = self.covariance.reshape(3, 2, count, terms.shape[1], 2, count, terms.shape[1])
        square = np.einsum("np,ckpkq,nq->nck", terms, parts[:, 0, :, :, 0], terms)
        return value, t_factor(self.dof) * np.sqrt(np.maximum(square, 0.0))

    @property
    def identified(self) -> bool:
        """Return whether the gaits show every direction, so that A is known."""
        return self.condition <= MOST_CONDITION

    def outside(self, shape: ComplexArray) -> str | None:
        """Return why a gait is outside the range of the perturbations, None if it is inside."""
        if (mode := self.base.outside(shape)) is not None:
            return mode
        rows = _rows(self.base, self.base.perturbation(shape)[0], _GRID)
        size, most = float(_length(rows @ self.hidden)), max(self.most_hidden, self.base.least)
        if size <= most:
            return None
        return (
            "its modes are perturbed in a way that no gait of the model shows, by "
            f"{np.degrees(size):.2g} degrees, {size / most:.3g} times the most that the model "
            "allows"
        )

    def predict(self, shape: ComplexArray) -> tuple[FloatArray, FloatArray]:
        """Predict the step of a gait over its cycle.

        Args:
            shape: Fourier coefficients of its joint angles [rad], shape (m, h + 1).

        Returns:
            Forward and left [m] and turn [rad], and the half widths of their 95 % intervals, each
            of shape (3,).
        """
        inside, _ = self.base.perturbation(shape)
        velocity = (_rows(self.base, inside, PHASES) @ self.coefficients).T
        rows = _rows(self.base, inside, _GRID)
        leverage = float(np.einsum("nq,qr,nr->", rows, self.gram, rows)) / len(_GRID)
        return step_of_cycle(velocity), t_factor(self.dof) * self.spread * (1 + leverage) ** 0.5


def turned(coefficients: ComplexArray, phase: float) -> ComplexArray:
    """Return Fourier coefficients with the phase counted from a later one, a copy."""
    return coefficients * np.exp(-1j * phase * _orders(coefficients))


def shape_base(shapes: ComplexArray, most_modes: int = MOST_MODES) -> ShapeBase:
    """Return the modes and the mean gait.

    Args:
        shapes: Of g gaits, shape (g, m, h + 1).
    """
    aligned, fundamental = aligned_shapes(shapes)
    mean = aligned[:, :, 0].real.mean(axis=0)
    off = aligned.copy()
    off[:, :, 0] -= mean
    second = np.einsum("gih,gjh,h->ij", off, off.conj(), _powers(off)).real / len(off)
    power, vectors = np.linalg.eigh(second)
    modes = vectors[:, ::-1][:, :most_modes]
    largest = np.argmax(np.abs(modes), axis=0)
    modes = modes * np.sign(modes[largest, np.arange(modes.shape[1])])
    inside = np.einsum("ik,gih->gkh", modes, off)
    cycle = inside.mean(axis=0)
    rest = off - np.einsum("ik,gkh->gih", modes, inside)
    return ShapeBase(
        mean=mean,
        modes=modes,
        share=power[::-1][: modes.shape[1]] / power.sum(),
        cycle=cycle,
        fundamental=fundamental,
        largest=_size(inside - cycle).max(axis=0),
        largest_rest=float(np.linalg.norm(_size(rest), axis=-1).max()),
    )


def aligned_shapes(shapes: ComplexArray) -> tuple[ComplexArray, ComplexArray]:
    """Return gaits with their phases as alike as can be, and the mean fundamental of the joints.

    Args:
        shapes: Shape (g, m, h + 1).
    """
    first = shapes[:, :, 1]
    mean = _central(first)
    for _ in range(2):
        phase = np.angle(first @ mean.conj())
        mean = np.mean(first * np.exp(-1j * phase)[:, None], axis=0)
    phase = np.angle(first @ mean.conj())
    return np.stack([turned(*pair) for pair in zip(shapes, phase, strict=True)]), mean


def _central(first: ComplexArray) -> ComplexArray:
    """Return the fundamental that differs least from the others, in the median; (g, m) to (m,)."""
    power = np.sum(np.abs(first) ** 2, axis=1)
    # |a - b exp(j phase)|^2 at the best phase
    off = power[:, None] + power - 2 * np.abs(first.conj() @ first.T)
    return first[int(np.argmin(np.median(off, axis=1)))]


def fit_connection(cycles: Sequence[GaitCycle], most_modes: int = MOST_MODES) -> Connection:
    """Fit the model to gaits around one gait.

    Args:
        cycles: Of the same joints, one or more.

    Raises:
        DataError: If they are too few or too much alike; it names the condition number.
    """
    base = shape_base(np.stack([cycle.shape for cycle in cycles]), most_modes)
    perturbations = [base.perturbation(cycle.shape)[0] for cycle in cycles]
    condition = condition_of(cycles, most_modes)
    count, needed = len(cycles), f"at least {MIN_GAITS} gaits around one gait are needed"
    number = f"the condition number is {condition:.3g}, at most {MOST_CONDITION:g} is of use"
    if count < MIN_GAITS:
        raise DataError(f"{count} gait{'' if count == 1 else 's'}: {needed}; {number}")
    if float(np.linalg.norm(base.largest)) < base.least:
        raise DataError(f"the {count} gaits are too much alike: {number}")
    return _fitted(base, condition, perturbations, cycles)


def condition_of(cycles: Sequence[GaitCycle], most_modes: int = MOST_MODES) -> float:
    """Return the condition number of the shapes and rates of shape that gaits show."""
    base = shape_base(np.stack([cycle.shape for cycle in cycles]), most_modes)
    return _condition(base, [base.perturbation(cycle.shape)[0] for cycle in cycles])


def distances(cycles: Sequence[GaitCycle]) -> FloatArray:
    """Return by which share each gait's joints differ from the gait most like the others.

    Args:
        cycles: g gaits of the same joints.

    Returns:
        Shape (g,), 0 for the central gait itself; a shift in phase is no difference.
    """
    first = np.stack([cycle.shape[:, 1] for cycle in cycles])
    central = _central(first)
    phase = np.angle(first @ central.conj())
    off = first * np.exp(-1j * phase)[:, None] - central
    return np.linalg.norm(off, axis=1) / max(float(np.linalg.norm(central)), 1e-12)


def _fitted(
    base: ShapeBase,
    condition: float,
    perturbations: Sequence[ComplexArray],
    cycles: Sequence[GaitCycle],
) -> Connection:
    """Fit A and B."""
    rows = np.stack([_rows(base, perturbation, _GRID) for perturbation in perturbations])
    velocity = np.stack(
        [wave_at(turned(cycle.velocity, base.phase(cycle.shape)), _GRID).T for cycle in cycles]
    )
    free = null_space(_same_gait(base), rcond=_CLOSED)
    power, vectors = np.linalg.eigh(np.einsum("gnq,gnr->qr", rows @ free, rows @ free))
    shown = power > power[-1] / MOST_CONDITION**2
    row, hidden = free @ vectors[:, shown], free @ vectors[:, ~shown]
    gram = row / power[shown] @ row.T
    coefficients = gram @ np.einsum("gnq,gnc->qc", rows, velocity)
    left = velocity - rows @ coefficients
    count, k = len(cycles), base.share.size
    change = np.zeros((count, *coefficients.shape))
    leverage = np.zeros(count)
    steps = np.zeros((count, 3))
    alone = np.zeros((count, 3))
    for g, row in enumerate(rows):
        # (I - H)^-1 by eigenvectors; a direction that only this gait shows is no direction.
        shares, vectors = np.linalg.eigh(row @ gram @ row.T)
        shares = np.clip(shares, 0.0, _ALONE)
        without: FloatArray = vectors @ ((vectors.T @ left[g]) / (1 - shares)[:, None])
        change[g] = gram @ row.T @ without
        leverage[g] = float(np.sum(shares / (1 - shares))) / len(row)
        steps[g] = step_of_cycle(_fine(velocity[g]))
        alone[g] = step_of_cycle(_fine(velocity[g] - without))
    centred = change - change.mean(axis=0)
    covariance = (count - 1) / count * np.einsum("gqc,grc->cqr", centred, centred)
    scaled = (alone - steps) ** 2 / (1 + leverage)[:, None]
    return Connection(
        base=base,
        condition=condition,
        coefficients=frozen(coefficients),
        covariance=frozen(covariance),
        gram=frozen(gram),
        hidden=frozen(hidden),
        most_hidden=float(np.max(_length(rows @ hidden))),
        dof=float(max(count - 2 * k, 1)),
        spread=frozen(np.sqrt(scaled.mean(axis=0))),
    )


def _fine(velocity: FloatArray) -> FloatArray:
    """Return a velocity on the grid of the fit, shape (n, 3), at ``PHASES``, shape (3, samples)."""
    spectrum = np.fft.rfft(velocity, axis=0)
    return np.fft.irfft(spectrum, PHASES.size, axis=0).T * (PHASES.size / len(velocity))


def _terms(phase: FloatArray) -> FloatArray:
    """Return 1, cos and sin of the phase up to ORDER, shape (n, P)."""
    order: FloatArray = np.arange(1.0, ORDER + 1)
    angle = np.outer(phase, order)
    return np.concatenate([np.ones((phase.size, 1)), np.cos(angle), np.sin(angle)], axis=1)


def _slopes(phase: FloatArray) -> FloatArray:
    """Return the derivatives of the terms, shape (n, P)."""
    order: FloatArray = np.arange(1.0, ORDER + 1)
    angle = np.outer(phase, order)
    return np.concatenate(
        [np.zeros((phase.size, 1)), -order * np.sin(angle), order * np.cos(angle)], axis=1
    )


def _rate(coefficients: ComplexArray) -> ComplexArray:
    return 1j * _orders(coefficients) * coefficients


def _orders(coefficients: ComplexArray) -> FloatArray:
    """Return 0, 1, ... of the last axis of Fourier coefficients."""
    return np.arange(float(coefficients.shape[-1]))


def _powers(coefficients: ComplexArray) -> FloatArray:
    """Return the mean square of each term of unit amplitude."""
    powers = np.full(coefficients.shape[-1], 0.5)
    powers[0] = 1.0
    return powers


def _rows(base: ShapeBase, perturbation: ComplexArray, phase: FloatArray) -> FloatArray:
    """Return the design of a gait: r' and d, each times the terms, shape (n, 2 k P)."""
    rate = wave_at(_rate(base.cycle + perturbation), phase)
    both = np.concatenate([rate, wave_at(perturbation, phase)])
    return np.einsum("kn,np->nkp", both, _terms(phase)).reshape(phase.size, -1)


def _same_gait(base: ShapeBase) -> FloatArray:
    """Return the rows whose product is B r0' - A' r0', shape (n, 2 k P)."""
    rate = wave_at(_rate(base.cycle), _GRID)
    parts = [np.einsum("kn,np->nkp", rate, terms) for terms in (-_slopes(_GRID), _terms(_GRID))]
    return np.concatenate(parts, axis=1).reshape(_GRID.size, -1)


def _condition(base: ShapeBase, perturbations: Sequence[ComplexArray]) -> float:
    """Return the worst condition number of r' and d over the phases; a shift in phase is known."""
    off = np.stack([wave_at(perturbation, _GRID) for perturbation in perturbations])
    rate = np.stack(
        [wave_at(_rate(base.cycle + perturbation), _GRID) for perturbation in perturbations]
    )
    shift = wave_at(_rate(base.cycle), _GRID)[None] * len(perturbations) ** 0.5
    design = np.concatenate(
        [np.concatenate([rate, off], axis=1), np.concatenate([np.zeros_like(shift), shift], axis=1)]
    )
    size = np.linalg.svd(design.transpose(2, 0, 1), compute_uv=False)
    if size.shape[1] < design.shape[1] or not (size[:, -1] > 0).all():
        return float("inf")
    return float(np.max(size[:, 0] / size[:, -1]))


def _length(hidden: FloatArray) -> FloatArray:
    """Return the root mean square over phases of parts of the design, (..., n, d) to (...)."""
    return np.sqrt(np.mean(np.sum(hidden**2, axis=-1), axis=-1) / (1 + ORDER))


def _size(coefficients: ComplexArray) -> FloatArray:
    """Return root mean squares over the cycle, over the last axis."""
    return np.sqrt(np.abs(coefficients) ** 2 @ _powers(coefficients))
