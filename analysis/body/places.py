"""Head, middle and tail across the mean heading, as seen and with perfectly tracking joints."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from undulog.capture.common.arrays import ComplexArray, FloatArray
from undulog.capture.robot.kinematics import link_poses, rotation_from_quaternion
from undulog.capture.robot.model import Plane, Robot

from ..estimators.harmonic import HarmonicFit, fit_at
from ..estimators.harmonic_moments import HarmonicModel
from ..estimators.intervals import around, t_factor
from ..estimators.series import Series
from ..estimators.spectrum import residual_noise
from ..response.gait import allowed_model
from ..results.analysis import BodyPoint
from ..results.estimate import Estimate
from ..signals.reading import DRAG_RATIO
from .null import free_chain, one_cycle, places, viscous_chain

PLACES = ("head", "middle", "tail")
TREND = 2
"""The mean path may bend: position across the heading gets a parabola beside the harmonics."""

_CHUNK = 8192


@dataclass(frozen=True)
class Track:
    """Positions of head, middle and tail, and the mean heading of the body.

    Attributes:
        t_s: Times [s], shape (n,).
        position: World positions of the three link centres [m], shape (n, 3, 3).
        heading: Horizontal unit vector of the mean direction from tail to head, shape (3,).
    """

    t_s: FloatArray
    position: FloatArray
    heading: FloatArray


def place_links(count: int) -> tuple[int, int, int]:
    """Indices of the head, the middle and the tail link.

    Args:
        count: Number of links; of an even number the front one of the two middle links.

    Returns:
        Three indices.
    """
    return 0, (count - 1) // 2, count - 1


def track(
    robot: Robot,
    t_s: FloatArray,
    head_position: FloatArray,
    head_quaternion: FloatArray,
    angles: Sequence[Series],
) -> Track:
    """Follow three links from the head's pose and the joint angles.

    Args:
        robot: The robot, m joints.
        t_s: Times of the poses [s], shape (n,).
        head_position: [m], shape (n, 3).
        head_quaternion: x, y, z, w, shape (n, 4).
        angles: Measured angle of every joint, in chain order, m of them; interpolated linearly to
            the times of the poses.

    Returns:
        The track at the times that all joints cover.
    """
    start = max([float(t_s[0]), *(float(one.t_s[0]) for one in angles)])
    stop = min([float(t_s[-1]), *(float(one.t_s[-1]) for one in angles)])
    inside = np.flatnonzero((t_s >= start) & (t_s <= stop))
    chosen = list(place_links(len(robot.links)))
    position = np.empty((inside.size, 3, 3))
    chord = np.zeros(3)
    for first in range(0, inside.size, _CHUNK):
        part = slice(first, first + _CHUNK)
        rows = inside[part]
        shape = np.stack([one.at(t_s[rows]) for one in angles], axis=-1)
        rotation = rotation_from_quaternion(head_quaternion[rows])
        centres, _ = link_poses(robot, head_position[rows], rotation, shape)
        position[part] = centres[:, chosen]
        chord += np.sum(centres[:, 0] - centres[:, -1], axis=0)
    chord[2] = 0.0
    size = float(np.linalg.norm(chord))
    heading = chord / size if size > 0 else np.array([1.0, 0.0, 0.0])
    return Track(t_s[inside], position, heading)


def observed(robot: Robot, plane: Plane, seen: Track, omega: float) -> tuple[BodyPoint, ...]:
    """Transverse amplitude and phase of head, middle and tail.

    Args:
        robot: The robot.
        plane: Plane of the motion: horizontal is seen to the left of the heading, vertical up.
        seen: Where the three links were.
        omega: Gait frequency [rad/s].

    Returns:
        Three points with intervals; a phase is relative to the head link, and its interval
        counts the noise of both as independent.
    """
    left = np.array([-seen.heading[1], seen.heading[0], 0.0])
    normal = left if plane is Plane.HORIZONTAL else np.array([0.0, 0.0, 1.0])
    across = seen.position @ normal
    series = [Series(place, seen.t_s, across[:, k]) for k, place in enumerate(PLACES)]
    fit = fit_at(series, omega, allowed_model(series, omega, TREND))
    noise = residual_noise(series, fit)
    size = np.abs(fit.fundamental)
    unit = np.divide(fit.fundamental, size, out=np.ones_like(fit.fundamental), where=size > 0)
    along, sideways = noise.along(unit), noise.along(1j * unit)
    links = place_links(len(robot.links))
    points: list[BodyPoint] = []
    for k, place in enumerate(PLACES):
        factor = t_factor(float(noise.dof[k]))
        half = factor * float(along[k]) ** 0.5
        amplitude = Estimate(
            float(size[k]), (max(0.0, float(size[k]) - half), float(size[k]) + half)
        )
        points.append(
            BodyPoint(
                place=place,
                link=robot.links[links[k]].name,
                amplitude_m=amplitude,
                phase_rad=_phase(fit, sideways, k, factor),
            )
        )
    return tuple(points)


def perfect_tracking(
    robot: Robot,
    plane: Plane,
    commands: dict[int, tuple[ComplexArray, float]],
    *,
    omega: float,
    cycles: int,
    drag_ratio: float = DRAG_RATIO,
) -> dict[str, tuple[BodyPoint, ...]]:
    """The same three points if every joint were exactly on its command.

    Args:
        robot: The robot.
        plane: The driven plane; joints of the other plane are straight.
        commands: By joint index: harmonics of the command (complex amplitudes) and its mean [rad].
        omega: Gait frequency [rad/s].
        cycles: Whole cycles over which the observed points were taken, at least one.
        drag_ratio: K = c_n / c_t of the viscous null.

    Returns:
        ``free`` (nothing touches the body), and for a horizontal gait ``viscous``: drag on the
        ground plane says nothing about links that move up and down. No intervals: a null is
        computed, not measured.
    """
    harmonics = max((len(parts) for parts, _ in commands.values()), default=1)
    amplitudes = np.zeros((len(robot.joints), harmonics), dtype=np.complex128)
    offsets = np.zeros(len(robot.joints))
    for joint, (parts, mean) in commands.items():
        amplitudes[joint, : len(parts)] = parts
        offsets[joint] = mean
    if plane is Plane.VERTICAL:
        # Pitch turns the nose down, so in the plane (forward, up) angles change their sign.
        amplitudes, offsets = -amplitudes, -offsets
    chains = {"free": free_chain(robot, plane)}
    if plane is Plane.HORIZONTAL:
        chains = {"viscous": viscous_chain(robot, drag_ratio)} | chains
    links = place_links(len(robot.links))
    result: dict[str, tuple[BodyPoint, ...]] = {}
    for name, chain in chains.items():
        motion = one_cycle(chain, amplitudes, offsets, omega)
        path = places(chain, motion, links, cycles)
        heading = np.sum(path[:, 0] - path[:, -1])
        across = np.imag(path * np.conj(heading) / np.abs(heading))
        t_s = np.linspace(0.0, 2 * np.pi * cycles / omega, path.shape[0], endpoint=False)
        series = [Series(place, t_s, across[:, k]) for k, place in enumerate(PLACES)]
        fit = fit_at(series, omega, HarmonicModel(harmonics=3, trend=TREND))
        result[name] = tuple(
            BodyPoint(
                place=place,
                link=robot.links[links[k]].name,
                amplitude_m=Estimate(float(np.abs(fit.fundamental[k]))),
                phase_rad=Estimate(_angle(fit.fundamental, k)),
            )
            for k, place in enumerate(PLACES)
        )
    return result


def _angle(fundamental: ComplexArray, k: int) -> float:
    return float(np.angle(fundamental[k] * np.conj(fundamental[0])))


def _phase(fit: HarmonicFit, sideways: FloatArray, k: int, factor: float) -> Estimate:
    if k == 0:
        return Estimate(0.0, (0.0, 0.0))
    power = np.abs(fit.fundamental) ** 2
    if not (power[0] > 0 and power[k] > 0):
        return Estimate()
    sine = factor * float(sideways[k] / power[k] + sideways[0] / power[0]) ** 0.5
    if sine >= 1:
        return Estimate()
    angle = _angle(fit.fundamental, k)
    return Estimate(angle, around(angle, float(np.arcsin(sine))))
