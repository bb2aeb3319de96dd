"""Designs of experiments: which runs each needs, and how long a chain rings before it is measured.

Phase kicks and the reversal of a wave are deviations from a recorded gait. A lag sweep and a
multisine make the coupling of a chain without contact identifiable, a band of odd random-phase
multisines the best linear approximation.

Without contact, at small amplitude, a = H c at every frequency. From r runs, Y = H C; H = Y C^-1 is
best estimated when C is a DFT matrix, C_jk = A exp(j 2 pi j k / m): its condition number is 1. A
lag sweep is just that: m gaits of the lags 2 pi k / m. In a multisine every frequency has such a
matrix of its own, all in the same m runs (Dobrowiecki, Schoukens & Guillaume, "Optimized excitation
signals for MIMO frequency response function measurements", IEEE Trans. Instrum. Meas. 55, 2006).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from undulog.capture.common.arrays import ComplexArray, FloatArray, IntArray
from undulog.capture.common.errors import UsageError
from undulog.capture.robot.model import Joint, Plane, Robot

from ..experiment.multisine_runs import KIND, MOST_LINES, Inputs
from ..session.runs import HEADING
from .runs import RATE_HZ, PlannedRun, Tone

HELD_OUT = (0.05, 0.1, 0.15)
"""Largest random phase of each held-out pattern [rad]."""

TIME_CONSTANTS = 5.0
"""So many of the slowest mode's time constants are waited for: 0.7 % of it is left."""

GROUP = 4
"""Consecutive odd lines of which one is left out."""

DRAWS = 64
"""Draws of the phases of which the one with the least peak is taken."""

LEAST_LINES = 6
HIGHEST_HZ = RATE_HZ / 8
"""Highest excited frequency [Hz]: above it the samples of the plan hardly follow a sine."""


def phase_kicks(
    names: tuple[str, ...], amplitude: ComplexArray, repeats: int, *, kick: float, base_runs: int
) -> tuple[PlannedRun, ...]:
    """Plan runs of the gait, four kicks of each joint, and held-out patterns.

    Args:
        names: Of the m driven joints.
        amplitude: Of the gait, shape (m,).
        repeats: How often all of it is run.
        kick: Of phase [rad] and of log amplitude.
        base_runs: Runs without a kick in all, at least one a repeat.

    Returns:
        4 m + 3 runs and those without a kick a repeat, in random order, so that warming up looks
        like no kick but like scatter.
    """
    random = np.random.default_rng(1)
    runs: list[PlannedRun] = []
    kinds = ("phase", kick * 1j), ("amplitude", kick)
    signs = (1, "up"), (-1, "down")
    for _ in range(repeats):
        once = [PlannedRun("base", amplitude, {"kind": "base"})] * math.ceil(base_runs / repeats)
        for (joint, name), (kind, step), (sign, word) in product(enumerate(names), kinds, signs):
            off = np.zeros(len(names), dtype=np.complex128)
            off[joint] = sign * step
            kicked = (amplitude * np.exp(off)).astype(np.complex128)
            facts = {"kind": kind, "joint": name, "sign": f"{sign:+d}"}
            once.append(PlannedRun(f"{name}-{kind}-{word}", kicked, facts))
        for size in HELD_OUT:
            turned = amplitude * np.exp(1j * random.uniform(-size, size, len(names)))
            once.append(PlannedRun("held-out", turned.astype(np.complex128), {"kind": "held-out"}))
        runs += [once[k] for k in random.permutation(len(once))]
    return tuple(runs)


def reversal(amplitude: ComplexArray, repeats: int = 6) -> tuple[PlannedRun, ...]:
    """Plan runs of a wave and of its reverse, the robot turned by half a turn in half of each.

    A tilted floor then cancels between runs that are each other's mirror image: the wave at one
    heading and its reverse at the other.

    Args:
        amplitude: Of the gait, head to tail, shape (m,).
        repeats: Runs each way.

    Returns:
        Twice as many runs, the heading among their facts. Four make a block, in which the two
        runs of a mirror image follow each other; the next block swaps the waves, so that warming
        up looks like neither direction nor heading, and the robot is turned every second run.
    """
    ways = (("as-recorded", amplitude), ("reversed", amplitude[::-1]))
    runs: list[PlannedRun] = []
    for k in range(2 * repeats):
        way, wave = ways[(k + k // 4) % 2]
        turned = k % 4 in (1, 2)
        facts = {"kind": way, HEADING: f"{math.pi if turned else 0.0:.6f}"}
        runs.append(PlannedRun(f"{way}-{180 if turned else 0}", wave, facts))
    return tuple(runs)


def lag_sweep(m: int, amplitude: float, repeats: int) -> tuple[PlannedRun, ...]:
    """Plan as many gaits as there are joints, of the lags 2 pi k / m.

    Args:
        amplitude: Of every command [rad].
        repeats: How often all of it is run.

    Returns:
        m runs a repeat, in random order so that warming up looks like no lag.
    """
    random = np.random.default_rng(1)
    order: list[int] = [k for _ in range(repeats) for k in random.permutation(m).tolist()]
    facts = [{"kind": "lag", "lag_rad": f"{2 * np.pi * k / m:.6f}"} for k in range(m)]
    return tuple(PlannedRun(f"lag{k:02d}", amplitude * dft(m)[k], facts[k]) for k in order)


def multisine(m: int, amplitude: float, omega: FloatArray, repeats: int) -> tuple[PlannedRun, ...]:
    """Plan m runs of all joints at all tones, with the phases of a DFT matrix over the runs.

    Args:
        amplitude: Of the first tone of every command [rad]; the others fall as 1 / omega^2, so
            that all of them need about the same torque, and none shakes the chain out of its
            linear range.
        omega: Angular frequencies of the tones, the gait's first [rad/s], shape (L,).
        repeats: How often all of it is run.

    Returns:
        m runs a repeat, in random order.
    """
    random = np.random.default_rng(1)
    phase = np.exp(1j * random.uniform(-np.pi, np.pi, omega.size))
    strength = phase * (omega[0] / omega) ** 2
    runs: list[PlannedRun] = []
    for _ in range(repeats):
        for k in random.permutation(m).tolist():
            amplitudes = [
                (amplitude * phasor * dft(m)[k]).astype(np.complex128) for phasor in strength
            ]
            more = tuple(Tone(float(w), a) for w, a in zip(omega[1:], amplitudes[1:], strict=True))
            facts = {"kind": "multisine", "experiment": str(k)}
            runs.append(PlannedRun(f"experiment{k:02d}", amplitudes[0], facts, more))
    return tuple(runs)


def tones(omega: float, count: int) -> FloatArray:
    """Return frequencies of which none is another plus a whole number of the gait's.

    In units of the gait's frequency over 2 L - 1, tone i is the line i (2 L - 1) + i: remainders
    0 .. L - 1 are all different, of either sign. So the sidebands that a nonlinearity makes of one
    tone around the gait's multiples fall on no other tone.

    Args:
        omega: Of the gait, itself the first tone [rad/s].
        count: L, at least 1.

    Returns:
        Rising [rad/s], shape (L,).
    """
    step = 2 * count - 1
    place = np.arange(count)
    return omega * ((place + 1) * step + place) / step


def period_s(omega: float, count: int) -> float:
    """Return the time after which a multisine repeats [s].

    Args:
        omega: Of the gait [rad/s].

    Returns:
        2 L - 1 periods of the gait.
    """
    return (2 * count - 1) * 2 * np.pi / omega


def dft(m: int) -> ComplexArray:
    """Return exp(j 2 pi j k / m), row k = run, column j = joint; shape (m, m)."""
    place = np.arange(m)
    return np.exp(2j * np.pi / m * place[:, None] * place[None, :]).astype(np.complex128)


@dataclass(frozen=True)
class Multisine:
    """What the realisations of one experiment share.

    Attributes:
        lines: Excited multiples of 1 / ``period_s``, odd, ascending, shape (k,).
        period_s: After which the commands repeat [s].
        amplitude: Of each excited line's sine [rad].
        peak: Largest deviation from the offset in any run [rad].
    """

    lines: IntArray
    period_s: float
    amplitude: float
    peak: float

    @property
    def rms(self) -> float:
        """Root mean square of each command about its offset [rad]."""
        return self.amplitude * float(np.sqrt(self.lines.size / 2))


def odd_lines(band_hz: tuple[float, float], period_s: float, seed: int) -> IntArray:
    """Draw the excited lines.

    Args:
        band_hz: Lowest and highest frequency [Hz].
        period_s: A whole number of samples of a plan [s].

    Raises:
        UsageError: If the band or the period has no such lines.
    """
    low, high = band_hz
    samples = period_s * RATE_HZ
    if not 0 < low < high <= HIGHEST_HZ:
        raise UsageError(
            f"--band {low:g} {high:g} is not from a lower to a higher frequency above 0 and up to "
            f"{HIGHEST_HZ:g} Hz"
        )
    if not (0 < samples < 1e6 and abs(samples - round(samples)) < 1e-6):
        raise UsageError(f"--period {period_s:g} is not a multiple of {1 / RATE_HZ:g} s")
    first, last = np.ceil(low * period_s - 1e-9), np.floor(high * period_s + 1e-9)
    odd = np.arange(int(first) | 1, int(last) + 1, 2)
    if odd.size - odd.size // GROUP < LEAST_LINES:
        raise UsageError(
            f"--band {low:g} {high:g} holds {odd.size} odd multiples of 1/{period_s:g} Hz, fewer "
            f"than {LEAST_LINES} of them excited; take a longer --period or a wider --band"
        )
    random = np.random.default_rng([seed, 0])
    left_out = np.arange(0, odd.size - GROUP + 1, GROUP)
    left_out = left_out + random.integers(0, GROUP, left_out.size)
    lines: IntArray = np.delete(odd, left_out).astype(np.int64)
    if lines.size > MOST_LINES:
        raise UsageError(
            f"--band and --period give {lines.size} excited lines, at most {MOST_LINES} are "
            "planned; take a shorter --period or a narrower --band"
        )
    return lines


def random_phase_runs(
    m: int,
    lines: IntArray,
    period_s: float,
    amplitude: float,
    *,
    of_peak: bool,
    realisations: int,
    inputs: Inputs,
    seed: int,
) -> tuple[Multisine, tuple[PlannedRun, ...]]:
    """Plan the runs of all realisations of an odd random-phase multisine.

    A realisation is the sum of sines of equal amplitude and random phase at odd multiples (lines)
    of the reciprocal period. In each group of :data:`GROUP` consecutive odd lines one, drawn at
    random, is left out, and all even lines are: a nonlinearity of odd order responds at those odd
    lines, one of even order at the even ones (detection lines). All realisations excite the same
    lines with the same power, so that all of them have the same best linear approximation; their
    phases differ. Of :data:`DRAWS` draws of the phases the one with the least peak is taken.

    With m joints and ``orthogonal`` inputs a realisation takes m runs: each joint has phases of its
    own, which a DFT matrix over the runs multiplies, so that the commands are a regular matrix at
    every line and the response of every joint to every command is identifiable.

    Source: Pintelon & Schoukens, System Identification, 2nd ed. (Wiley 2012), sections 2.7 and 4.3;
    Dobrowiecki, Schoukens & Guillaume, IEEE Trans. Instrum. Meas. 55 (2006) 1774-1780.

    Args:
        m: Driven joints.
        lines: Of :func:`odd_lines`.
        amplitude: Root mean square of each command, or the largest peak of all [rad].
        of_peak: Whether ``amplitude`` is the peak.

    Returns:
        What they share, and the runs: one a realisation, or m with orthogonal inputs.
    """
    random = np.random.default_rng([seed, 1])
    experiments = m if inputs == "orthogonal" else 1
    drawn = [
        _phases(experiments, lines, random, rotated=experiments > 1) for _ in range(realisations)
    ]
    unit_rms = float(np.sqrt(lines.size / 2))
    highest = max(float(peaks.max()) for _, peaks in drawn)
    size = amplitude / (highest if of_peak else unit_rms)
    shared = Multisine(lines, period_s, size, size * highest)
    omega = 2 * np.pi * lines / period_s
    turns = dft(experiments)
    runs: list[PlannedRun] = []
    for r, (phasors, peaks) in enumerate(drawn):
        for e in range(experiments):
            amplitudes = np.broadcast_to(size * phasors * turns[e][:, None], (m, lines.size))
            facts = {
                "kind": KIND,
                "realisation": str(r),
                "experiment": str(e),
                "crest_factor": f"{float(peaks.max()) / unit_rms:.4g}",
            }
            label = f"realisation{r:02d}" + (f"-experiment{e:02d}" if experiments > 1 else "")
            tones = tuple(
                Tone(float(w), np.ascontiguousarray(amplitudes[:, k])) for k, w in enumerate(omega)
            )
            runs.append(PlannedRun(label, np.zeros(m, dtype=np.complex128), facts, tones))
    return shared, tuple(runs)


def _phases(
    count: int, lines: IntArray, random: np.random.Generator, *, rotated: bool
) -> tuple[ComplexArray, FloatArray]:
    """Return phasors of modulus 1 of least peak, shape (count, k), and the peaks, shape (count,).

    Args:
        rotated: Whether runs multiply them by a constant phase: the peak is then that of the
            envelope, which holds for all of them.
    """
    length = int(2 ** np.ceil(np.log2(16 * int(lines[-1]))))
    best, peaks = np.zeros((count, lines.size), dtype=np.complex128), np.zeros(count)
    for j in range(count):
        phasors = np.exp(2j * np.pi * random.random((DRAWS, lines.size)))
        spectrum = np.zeros((DRAWS, length), dtype=np.complex128)
        spectrum[:, lines] = phasors * length
        analytic = np.fft.ifft(spectrum)
        peak = np.abs(analytic if rotated else analytic.real).max(axis=1)
        least = int(np.argmin(peak))
        best[j], peaks[j] = phasors[least], peak[least]
    return best, peaks


@dataclass(frozen=True)
class DecayingMode:
    """A decaying mode.

    Attributes:
        frequency_hz: Its natural frequency, |s| / 2 pi.
        damping: Damping ratio, -Re s / |s|.
        time_constant_s: -1 / Re s.
    """

    frequency_hz: float
    damping: float
    time_constant_s: float


def slowest_mode(robot: Robot, driven: Sequence[str]) -> DecayingMode:
    """Find the mode of the driven planes that decays slowest: how long a straight chain rings.

    What is measured without contact before the modes have died away is wrong. At small angles the
    chain moves across itself by y_0 + theta_0 x + the joints' bends, so its mass matrix is
    constant; with the servos linear (no Coulomb friction, no play, no saturation) the modes are the
    eigenvalues of

        M_eff q'' = k_g (th - q) + c_g (om - q')
        Jm om' = -kappa q - (b + Kt^2/R) om - k_g (th - q) - c_g (om - q'),   kappa = Kt V Kp / R

    with M_eff = M_qq - M_qb M_bb^-1 M_bq, the free body b eliminated. Ground and Coulomb friction
    only add damping.

    Args:
        driven: Names of the driven joints, at least one.
    """
    poles = np.concatenate(
        [
            _poles(robot, plane)
            for plane in Plane
            if any(joint.plane is plane and joint.name in driven for joint in robot.joints)
        ]
    )
    slowest = complex(poles[int(np.argmax(poles.real))])
    size = abs(slowest)
    return DecayingMode(size / (2 * np.pi), -slowest.real / size, -1 / slowest.real)


def transverse_mass(robot: Robot, plane: Plane) -> FloatArray:
    """Return the mass matrix of the free straight chain bending in one plane.

    Args:
        plane: The plane; joints of the other one are rigid.

    Returns:
        Of the joints of that plane once the free body is eliminated, shape (m, m) [kg m^2].
    """
    length = np.array([link.length for link in robot.links])
    mass = np.array([link.mass for link in robot.links])
    axis = 2 if plane is Plane.HORIZONTAL else 1
    inertia = np.array([link.inertia[axis] for link in robot.links])
    back = np.cumsum(length)  # from the head's front; only differences count
    centre = back - length / 2
    joints: IntArray = robot.joint_indices(plane)
    behind = (np.arange(len(length))[:, None] > joints[None, :]).astype(np.float64)
    # Columns: shift, turn about the front, bends; each link's centre across, and its angle.
    shift = np.column_stack(
        [np.ones_like(centre), centre, behind * (centre[:, None] - back[joints])]
    )
    turn = np.column_stack([np.zeros_like(centre), np.ones_like(centre), behind])
    whole = shift.T @ (mass[:, None] * shift) + turn.T @ (inertia[:, None] * turn)
    free = np.linalg.solve(whole[:2, :2], whole[:2, 2:])
    return whole[2:, 2:] - whole[2:, :2] @ free


def _poles(robot: Robot, plane: Plane) -> ComplexArray:
    """Return eigenvalues of (q, q', th, om), of the joints of one plane."""
    joints: list[Joint] = [joint for joint in robot.joints if joint.plane is plane]
    servos = [joint.servo for joint in joints]
    winding = np.array([servo.torque_constant / servo.resistance_ohm for servo in servos])
    kappa = np.diag(winding * [servo.supply_v * servo.proportional_gain for servo in servos])
    drag = np.diag(
        winding * [servo.torque_constant for servo in servos]
        + [servo.viscous_friction for servo in servos]
    )
    k = np.diag([servo.gear_stiffness for servo in servos])
    c = np.diag([servo.gear_damping for servo in servos])
    body = np.linalg.inv(transverse_mass(robot, plane))
    rotor = np.diag([1 / servo.rotor_inertia for servo in servos])
    none, unit = np.zeros_like(k), np.eye(len(k))
    matrix = np.block(
        [
            [none, unit, none, none],
            [-body @ k, -body @ c, body @ k, body @ c],
            [none, none, none, unit],
            [rotor @ (k - kappa), rotor @ c, -rotor @ k, -rotor @ (drag + c)],
        ]
    )
    return np.linalg.eigvals(matrix).astype(np.complex128)
