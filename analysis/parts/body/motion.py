"""From a session to the motion of head, middle and tail with its perfect-tracking null."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from undulog.capture import SessionView
from undulog.capture.common.arrays import NS, BoolArray, ComplexArray, FloatArray
from undulog.capture.common.console import Warn
from undulog.capture.common.errors import DataError, LogError
from undulog.capture.robot.kinematics import link_positions, rotation_from_quaternion
from undulog.capture.robot.model import Plane, Robot

from ...common.estimate import Estimate
from ...common.remarks import Note
from ...estimators.harmonic import HarmonicFit, HarmonicModel, fit_at
from ...estimators.intervals import around, t_factor
from ...estimators.series import Series
from ...estimators.spectrum import residual_noise
from ...response.fitting import GaitFit
from ...response.rhythm import allowed_model
from ...signals.columns import DRAG_RATIO, by_plane, drag_ratio
from ...signals.windows import Span
from .null import free_chain, one_cycle, places, viscous_chain
from .result import BodyPoint, BodyResult

PLACES = ("head", "middle", "tail")
TREND = 2
"""The mean path may bend: position across the heading gets a parabola beside the harmonics."""

_CHUNK = 8192

ODOMETRY_TOPIC = "/odom"

_CHILD = "child_frame_id"
_POSE = (
    *(f"pose.pose.position.{axis}" for axis in "xyz"),
    *(f"pose.pose.orientation.{axis}" for axis in "xyzw"),
)
_BENT_RAD = float(np.radians(2.0))
"""Joints that are not driven, but bent by more than this, make the planar null doubtful."""


@dataclass(frozen=True)
class BodyTrack:
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
    """Return the indices of the head, the middle and the tail link.

    Args:
        count: Number of links; of an even number the front one of the two middle links.
    """
    return 0, (count - 1) // 2, count - 1


class Poses(NamedTuple):
    """Poses of the head.

    Attributes:
        t_s: Times [s], shape (n,).
        position: [m], shape (n, 3).
        quaternion: Unit quaternions x, y, z, w, shape (n, 4).
    """

    t_s: FloatArray
    position: FloatArray
    quaternion: FloatArray


def track(robot: Robot, poses: Poses, angles: Sequence[Series]) -> BodyTrack:
    """Follow three links from the head's poses and the joint angles.

    Args:
        robot: The robot, m joints.
        angles: Measured angle of every joint, in chain order, m of them; interpolated linearly to
            the times of the poses.

    Returns:
        The track at the times that all joints cover.
    """
    chosen = list(place_links(len(robot.links)))
    times: list[FloatArray] = []
    places: list[FloatArray] = []
    chord = np.zeros(3)
    for at_s, centres in link_centres(robot, poses, angles):
        times.append(at_s)
        places.append(centres[:, chosen])
        chord += np.sum(centres[:, 0] - centres[:, -1], axis=0)
    chord[2] = 0.0
    size = float(np.linalg.norm(chord))
    heading = chord / size if size > 0 else np.array([1.0, 0.0, 0.0])
    if not times:
        return BodyTrack(np.zeros(0), np.zeros((0, 3, 3)), heading)
    return BodyTrack(np.concatenate(times), np.concatenate(places), heading)


def link_centres(
    robot: Robot, poses: Poses, angles: Sequence[Series]
) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Yield times and link centres, chunk by chunk.

    Args:
        angles: Measured angle of every joint, in chain order; interpolated linearly.

    Yields:
        Times that all joints cover [s], shape (k,), and centres [m], shape (k, links, 3).
    """
    t_s, position, quaternion = poses
    start = max([float(t_s[0]), *(float(angle.t_s[0]) for angle in angles)])
    stop = min([float(t_s[-1]), *(float(angle.t_s[-1]) for angle in angles)])
    inside = np.flatnonzero((t_s >= start) & (t_s <= stop))
    for first in range(0, inside.size, _CHUNK):
        rows = inside[first : first + _CHUNK]
        shape = np.stack([angle.at(t_s[rows]) for angle in angles], axis=-1)
        rotation = rotation_from_quaternion(quaternion[rows])
        yield t_s[rows], link_positions(robot, position[rows], rotation, shape)


def observed(robot: Robot, plane: Plane, seen: BodyTrack, omega: float) -> tuple[BodyPoint, ...]:
    """Transverse amplitude and phase of head, middle and tail.

    Args:
        plane: Plane of the motion: horizontal is seen to the left of the heading, vertical up.
        seen: Where the three links were.
        omega: Gait frequency [rad/s].

    Returns:
        Three points with intervals; a phase is relative to the head link, and its interval
        counts the noise of both as independent.
    """
    left = np.array([-seen.heading[1], seen.heading[0], 0.0])
    across = seen.position @ (left if plane is Plane.HORIZONTAL else np.array([0.0, 0.0, 1.0]))
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
        low, high = around(float(size[k]), factor * float(along[k]) ** 0.5)
        amplitude = Estimate(float(size[k]), (max(0.0, low), high))
        phase = _phase(fit, sideways, k, factor)
        points.append(BodyPoint(place, robot.links[links[k]].name, amplitude, phase))
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
    """Return the same three points if every joint were exactly on its command.

    Args:
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
        path = places(chain, one_cycle(chain, amplitudes, offsets, omega), links, cycles)
        heading = np.sum(path[:, 0] - path[:, -1])
        across = np.imag(path * np.conj(heading) / np.abs(heading))
        t_s = np.linspace(0.0, 2 * np.pi * cycles / omega, path.shape[0], endpoint=False)
        series = [Series(place, t_s, across[:, k]) for k, place in enumerate(PLACES)]
        waves = fit_at(series, omega, HarmonicModel(harmonics=3, trend=TREND)).fundamental
        sizes = np.abs(waves).tolist()
        result[name] = tuple(
            BodyPoint(place, robot.links[link].name, Estimate(size), Estimate(_angle(waves, k)))
            for k, (place, link, size) in enumerate(zip(PLACES, links, sizes, strict=True))
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


def body_motion(
    session: SessionView,
    responses: Mapping[str, Series],
    gait: GaitFit | None,
    span: Span,
    warn: Warn,
) -> BodyResult | None:
    """Head, middle and tail across the mean heading, beside their null.

    Args:
        responses: Measured joint angles by name, on the analysed stretch.
        gait: The fitted gait, or None.
        span: Whole cycles to look at.
        warn: Told why there is no result, or what makes it doubtful.

    Returns:
        The result, or None.
    """
    try:
        robot, fitted, plane = _fit_for_null(session, responses, gait)
        poses = head_poses(session, robot.links[0].name, span)
        seen = track(robot, poses, [responses[name] for name in robot.joint_names])
        fit = fitted.fit
        commands = {
            robot.joint_names.index(name): (fit.amplitudes[k], float(fit.trend[k, 0]))
            for k, name in enumerate(fitted.driven)
        }
        ratio = drag_ratio(session)
        null = perfect_tracking(
            robot, plane, commands, omega=fit.omega, cycles=span.cycles, drag_ratio=ratio
        )
        result = BodyResult(plane.value, observed(robot, plane, seen, fit.omega), null)
    except (DataError, LogError) as error:
        warn(Note(f"no body motion (head, middle, tail): {error}"))
        return None
    bent = [
        name
        for name in robot.joint_names
        if name not in fitted.driven and abs(float(responses[name].values.mean())) > _BENT_RAD
    ]
    if bent:
        text = f"{', '.join(bent)} are bent though not driven: the body's null takes them straight"
        warn(Note(text))
    return result


def _fit_for_null(
    session: SessionView, responses: Mapping[str, Series], gait: GaitFit | None
) -> tuple[Robot, GaitFit, Plane]:
    robot = session.robot
    if robot is None:
        raise DataError("the session has no robot description")
    if ODOMETRY_TOPIC not in session.channels:
        raise DataError(f"the session has no head pose on {ODOMETRY_TOPIC}")
    if gait is None or not gait.driven:
        raise DataError("no gait drives the joints")
    unknown = [n for n in robot.joint_names if n not in responses or responses[n].count < 2]
    if unknown:
        raise DataError(f"no angles of {', '.join(unknown)}")
    if gait.others:
        raise DataError("joints have several frequencies, and the null has one")
    planes = by_plane(robot, gait.driven)
    if len(planes) > 1:
        raise DataError("both planes are driven, and the null is planar")
    return robot, gait, Plane(next(iter(planes)))


def head_poses(session: SessionView, head: str, span: Span, beyond: int = 0) -> Poses:
    """Return the head's poses within a window.

    Args:
        head: Name of the head link.
        beyond: So many more before and after it, to interpolate at its ends.

    Returns:
        The poses, their times from the window's origin.

    Raises:
        DataError: If there are none, too few, of another link, or without an orientation.
    """
    start_ns = span.origin_ns + round(span.start_s * NS)
    stop_ns = span.origin_ns + round(span.stop_s * NS)
    logged = session.arrays({ODOMETRY_TOPIC: [_CHILD, *_POSE]})[ODOMETRY_TOPIC]
    i, j = np.searchsorted(logged.t_ns, (start_ns, stop_ns))
    inner = slice(max(int(i) - beyond, 0), int(j) + beyond)
    t_ns, fields = logged.t_ns[inner], logged.values
    if not t_ns.size or not set(_POSE) <= set(fields):
        raise DataError(f"{ODOMETRY_TOPIC} has no poses within the analysed window")
    children = {str(name) for name in set(fields[_CHILD][inner].tolist())} - {""}
    if children - {head}:
        raise DataError(
            f"{ODOMETRY_TOPIC} gives the pose of {', '.join(sorted(children))}, not of the head "
            f"link {head}"
        )
    pose = np.stack([fields[name][inner].astype(np.float64) for name in _POSE])
    inside: BoolArray = np.all(np.isfinite(pose), axis=0)
    inside[1:] &= np.diff(t_ns) > 0
    if np.count_nonzero(inside) < 16:
        raise DataError(f"{ODOMETRY_TOPIC} has fewer than 16 poses within the analysed window")
    if not np.all(inside):
        pose, t_ns = pose[:, inside], t_ns[inside]
    length = np.sqrt(np.einsum("ij,ij->j", pose[3:], pose[3:]))
    if np.any(length < 0.5):
        raise DataError(f"{ODOMETRY_TOPIC} holds orientations that are not unit quaternions")
    t_s = (t_ns - span.origin_ns).astype(np.float64) * 1e-9
    return Poses(t_s, pose[:3].T, (pose[3:] / length).T)
