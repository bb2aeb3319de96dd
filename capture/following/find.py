"""The joints of a session that do not follow their command, and when.

Each joint's response is fitted in windows of one cycle and compared with the response that all
joints have in common; its residual against its own usual response is searched for times at which
it leaves that response. What many joints do at the same time (a collision, a stop) is no fault of
one of them.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from itertools import combinations

import numpy as np
from scipy.special import bdtrc

from ..common.arrays import FloatArray, IntArray
from ..common.errors import DataError, LogError, MissingChannelError
from ..common.process import in_threads
from ..log.messages import COMMAND_TOPIC, RESPONSE_TOPIC
from ..log.read.facts import TIMES_FROM_FPS
from ..log.read.joint_messages import UNITS
from ..log.read.sample_times import LARGEST, Signal, longest_unbroken
from ..log.read.session_view import SessionView
from .excursions import Excursions, departures, find_excursions, find_holds
from .fault import Fault, Span, Symptom
from .kinds import fault_of, powerless, usual_effort
from .motion import (
    DEGREE,
    FEW_SAMPLES,
    MIN_SHARE,
    NO_RESPONSE,
    UNIT_SLACK,
    JointMotion,
    Judged,
    Samples,
    common_response,
    complex_median,
    judge,
    linearised,
    marked_spans,
    median_of,
    neighbours,
    own_response,
    robust_deviation,
    runs_of,
    whole_or,
    windowed_response,
)

# Share of a joint's samples that may be missing beyond what the joints have in common.
LOST_SHARE = 0.01
# Share of the fast samples that may repeat the one before, beyond what all joints do.
STALE_SHARE = 0.15
WRAP = 5.0  # a step so many times as large as the command's largest is no motion
SAME_TURN = 0.1  # steps of one counter differ by less than this, relative
# Turns of counters: of a shaft, of half and double shafts, of a servo's range, in raw units.
TURNS = (2 * np.pi, 4 * np.pi, np.pi, 300 * np.pi / 180, 360.0, 4096.0, 65536.0)
MOSTLY = 0.8

SILENT = 0.02  # a gap longer than this share of the record is a silence
# Chance of so many repeats by which a joint of many sessions is taken to repeat old values.
RARE = 1e-6
# More repeats in turn than this are a joint that stands or a sensor that froze, not old values.
LONGEST = 8
GAP = 1.8  # an interval of so many median ones lacks a sample
FAST = 0.5  # fast samples: the joint moves more than this share of its usual fast step
AROUND = 4  # samples on either side over which its motion is taken
SPIKE = 8.0  # robust standard deviations of the noise about the running median that make a spike
# A spike is also larger than so many of the command's largest steps: the median may be late.
SPIKE_STEPS = 3.0
SPIKE_SHARE = 0.1  # a spike is also larger than this share of the command's range
# A spike misses the cubic through those around it by this share of what it misses their median: one
# of two in a row by a third, the turning point of a vibration by a sixth.
SPIKE_ALONE = 0.3
SPIKES = 0.003  # share of the samples that may be spikes beyond what the joints have in common


def _record_faults(motions: Sequence[JointMotion]) -> dict[str, list[Symptom]]:
    """Find joints whose positions are missing or repeated more than the others'."""
    sampled = [each for each in motions if each.position.t_s.size > 2]
    result: dict[str, list[Symptom]] = {}
    largest = max((each.command.range for each in sampled), default=0.0)

    def counts(each: JointMotion) -> tuple[float, int, int, float]:
        moves = each.command.range > SPIKE_SHARE * largest
        return _lost(each), *_repeats(each), _spikes(each) if moves else 0.0

    found = in_threads(counts, sampled, sum(each.position.t_s.size for each in sampled))
    usual_lost = float(np.median([lost for lost, *_ in found] or [0.0]))
    usual_stale = float(np.median([repeats / of for _, repeats, of, _ in found if of] or [0.0]))
    usual_spikes = float(np.median([spiky for *_, spiky in found] or [0.0]))
    expected = min(STALE_SHARE + 2 * usual_stale, 1.0)
    for each, (missing, repeats, fast, spiky) in zip(sampled, found, strict=True):
        symptoms: list[Symptom] = []
        if spiky > SPIKES + 2 * usual_spikes:
            text = f"{100 * spiky:.2g} % of its samples are far from those around them"
            symptoms.append(Symptom("noisy", (), text))
        if missing > LOST_SHARE + 2 * usual_lost:
            text = f"{100 * missing:.2g} % of its samples missing"
            symptoms.append(Symptom("lost", _silences(each, missing), text))
        if bdtrc(repeats - 1, fast, expected) < RARE:
            text = f"{100 * repeats / fast:.2g} % of its fast samples repeat the one before"
            symptoms.append(Symptom("stale", (), text))
        if symptoms:
            result[each.name] = symptoms
    for each in motions:
        if each.position.t_s.size <= 2 < each.command.t_s.size and sampled:
            result[each.name] = [Symptom("lost", (), "no position was recorded")]
    return result


def _wraps(each: JointMotion) -> list[Symptom]:
    """Find the steps of a counter that wraps around.

    They have one size, are both up and down or again and again, and are larger than the command
    ever moves between two samples and than half of its range.
    """
    samples = each.position
    if samples.t_s.size < 16:
        return []
    step = np.diff(samples.values)
    large = np.abs(step) > max(WRAP * each.largest_step, 0.5 * each.command.range)
    sizes = np.abs(step[large])
    if not 2 <= sizes.size <= 0.2 * step.size:
        return []
    turn = float(np.median(sizes))
    near = np.abs(sizes / turn - 1) < SAME_TURN
    known = min(abs(turn / size - 1) for size in TURNS) < SAME_TURN
    # A counter that wraps comes back: up and down steps cancel but for one.
    balance = abs(float(np.sum(np.sign(step[large]))))
    if np.mean(near) < MOSTLY or not known or balance > max(1.0, 0.2 * sizes.size):
        return []
    return [Symptom("wrapped", (), f"{sizes.size} steps of {np.degrees(turn):.0f} degrees")]


def _lost(each: JointMotion) -> float:
    """Share of the samples that are missing or not finite."""
    samples = each.position
    step = np.diff(samples.t_s)
    usual = samples.period_s
    gaps = step[step > GAP * usual]
    absent = float(np.sum(np.round(gaps / usual) - 1)) if gaps.size else 0.0
    # A record of one message per servo may end early: what lacks at the ends counts, too.
    if (commanded := each.command.t_s).size:
        edges = max(0.0, samples.t_s[0] - commanded[0]) + max(0.0, commanded[-1] - samples.t_s[-1])
        absent += max(0.0, edges / usual - 2.0)
    return absent / (samples.t_s.size + absent)


def _spikes(each: JointMotion) -> float:
    """Share of the samples that lie alone, far from the running median of five."""
    values = each.position.values
    if values.size < 4 * AROUND:
        return 0.0
    away = np.abs(values - _median_of_five(values))
    a, b, _, d, e = _fives(values)
    alone = np.abs(values - (4 * (b + d) - a - e) / 6) > SPIKE_ALONE * away
    noise = robust_deviation(np.diff(values, 2), 0.0) / 6**0.5
    far = away > max(
        SPIKE * noise, SPIKE_STEPS * each.largest_step, SPIKE_SHARE * each.command.range
    )
    return float(np.count_nonzero(far & alone)) / values.size


def _fives(values: FloatArray) -> FloatArray:
    """Return each value with two before and two behind it, shape (5, n); the ends are held."""
    return np.lib.stride_tricks.sliding_window_view(np.pad(values, 2, mode="edge"), 5).T


def _median_of_five(values: FloatArray) -> FloatArray:
    """Return the running median; the ends are held. SciPy's would take longer to import."""
    a, b, c, d, e = _fives(values)
    low = np.maximum(np.minimum(a, b), np.minimum(d, e))
    high = np.minimum(np.maximum(a, b), np.maximum(d, e))  # of four without least and greatest
    return np.maximum(np.minimum(c, low), np.minimum(np.maximum(c, low), high))


def _silences(each: JointMotion, missing: float) -> tuple[Span, ...]:
    """Return the gaps if a few long ones hold most missing samples; else none."""
    t_s = each.position.t_s
    step = np.diff(t_s)
    length = float(t_s[-1] - t_s[0])
    long = np.flatnonzero(step > SILENT * length)
    if not long.size or float(step[long].sum()) < MOSTLY * missing * length:
        return ()
    return tuple(zip(t_s[long].tolist(), t_s[long + 1].tolist(), strict=True))


def _repeats(each: JointMotion) -> tuple[int, int]:
    """Count the samples during fast motion that repeat the one before, and all of them."""
    values = each.position.values
    step = np.abs(np.diff(values))
    moved = step[step > 0]
    if moved.size < 10 or values.size < 4 * AROUND:
        return 0, 0
    # Its own motion over a few samples: a joint that stands repeats its values rightly.
    travel = np.abs(values[2 * AROUND :] - values[: -2 * AROUND]) / (2 * AROUND)
    travel = np.pad(travel, (AROUND, AROUND - 1), mode="edge")
    fast = travel > max(2 * float(moved.min()), FAST * float(np.percentile(travel, 95)))
    if np.count_nonzero(fast) < 20:
        return 0, 0
    repeated = step == 0
    # A joint that stands repeats, too, and for longer.
    for first, stop in runs_of(repeated):
        if stop - first > LONGEST:
            repeated[first:stop] = False
    return int(np.count_nonzero(fast & repeated)), int(np.count_nonzero(fast))


OFF = 0.3  # relative deviation of H from the common response that makes a joint a candidate
NEAR = 0.2  # relative deviation below which the other joint's command explains it


def _swapped_pairs(judged: Sequence[Judged], common: complex) -> dict[str, str]:
    """Find pairs of joints that carry out each other's command, by name, both ways."""
    candidates = [
        each
        for each in judged
        if (each.follows.any() or each.opposite.any()) and abs(each.ratio / common - 1) > OFF
    ]
    partner: dict[str, str] = {}
    for first, second in combinations(candidates, 2):
        names = first.motion.name, second.motion.name
        if partner.keys() & names:
            continue
        if _explains(second, first, common) and _explains(first, second, common):
            partner |= {names[0]: names[1], names[1]: names[0]}
    return partner


def _explains(commanded: Judged, measured: Judged, common: complex) -> bool:
    """Return whether one joint's command gives the other's position by the common response."""
    r = windowed_response(
        commanded.motion.command, measured.motion.position, commanded.response.period_s
    )
    if not r.valid.any():
        return False
    ratio = complex_median(r.ratio[r.valid])
    return abs(ratio / common - 1) < NEAR and float(np.median(r.explained[r.valid])) > 0.8


DRIVEN_SHARE = 0.01  # a joint whose command moves less than this share of the largest is held still
# A command that moves less than this is held still, whatever the others do [rad].
MIN_COMMAND_RAD = 1e-3
SHORTEST_S = 2.0  # a shorter record is not judged [s]
# Explained share of its neighbours beside which a joint that follows nothing stands out.
ORDERLY = 0.8
RARELY = 0.1  # a joint that follows in less than this share of its windows does not follow


def joints_not_following(motions: Sequence[JointMotion]) -> tuple[Fault, ...]:
    """Find the joints that do not follow their command.

    Returns:
        At most one fault a joint, in chain order. Joints whose command does not move are not
        judged.
    """
    samples = sum(each.command.t_s.size + each.position.t_s.size for each in motions)
    motions = in_threads(linearised, motions, samples)
    largest = max((each.command.range for each in motions), default=0.0)
    least = max(DRIVEN_SHARE * largest, MIN_COMMAND_RAD)
    driven = [each for each in motions if each.command.range > least and _lasts(each)]
    responses = in_threads(lambda each: each.response, driven, samples)
    own = [own_response(each) for each in responses]
    common = common_response(own)
    # What noise makes of a joint that stands still is no response for its neighbours.
    own = [
        each if each is not None and abs(each) > NO_RESPONSE * abs(common) else None for each in own
    ]
    judged = [
        judge(each, r, common_response(neighbours(own, k)))
        for k, (each, r) in enumerate(zip(driven, responses, strict=True))
    ]
    symptoms: dict[str, list[Symptom]] = {each.name: [] for each in motions}
    for each, wrapped in zip(driven, in_threads(_wraps, driven, samples), strict=True):
        symptoms[each.name] += wrapped
    explained = [median_of(each.explained[each.valid]) for each in responses]
    for k, each in enumerate(judged):
        found = symptoms[each.motion.name]
        if not found:
            found += powerless(judged, k)
        if not found:
            near = np.array(neighbours(explained, k))
            found += _from_windows(each, median_of(near[~np.isnan(near)], 1.0))
        if not found:
            found += find_holds(each.motion, each.response, each.still, loaded=each.loaded)
    for name, partner in _swapped_pairs(judged, common).items():
        symptoms[name] = [Symptom("swapped", (), f"carries out the command of {partner}")]
    for name, departed in _from_residuals(judged, symptoms).items():
        symptoms[name] += departed
    for name, lacking in _record_faults(motions).items():
        known = {each.name for each in symptoms[name]}
        if not known & {"still", "held", "wrapped"}:
            symptoms[name] += [each for each in lacking if each.name not in known]
    by_name = {each.motion.name: each for each in judged}
    stands = any(each.name in ("still", "held") for own in symptoms.values() for each in own)
    usual = usual_effort(judged if stands else ())
    return tuple(
        fault_of(each, by_name.get(each.name), symptoms[each.name], usual)
        for each in motions
        if symptoms[each.name]
    )


def _lasts(motion: JointMotion) -> bool:
    """Return whether command and position overlap for long enough to be compared."""
    command, position = motion.command.t_s, motion.position.t_s
    if min(command.size, position.size) < FEW_SAMPLES:
        return False
    return min(command[-1], position[-1]) - max(command[0], position[0]) >= SHORTEST_S


def _from_windows(each: Judged, coherence: float) -> list[Symptom]:
    """Find the symptom of all windows of a joint, given its neighbours' coherence."""
    r = each.response
    valid = int(np.count_nonzero(r.valid))
    follows = np.count_nonzero(each.follows) / max(valid, 1)
    gain = abs(each.ratio) / abs(each.common)
    if (unit := _unit_factor(each, gain)) is not None:
        # A joint that hardly moves may as well stand still, but for what its neighbours do to it.
        name = "scaled" if gain > 1 else "slight"
        return [Symptom(name, (), f"moves {unit} times as far as the other joints")]
    if np.count_nonzero(each.opposite) > 0.5 * valid:
        spans = whole_or(marked_spans(r, each.opposite), r)
        return [Symptom("opposite", spans, f"gain {-abs(each.ratio):.2f}")]
    if not valid or follows >= RARELY:
        return []  # its departures are found sample by sample
    if np.count_nonzero(each.still) > 0.5 * valid:
        return [Symptom("still", (), "")]
    if not each.opposite.any() and coherence > ORDERLY and not each.loaded:
        return [Symptom("incoherent", (), "moves, but not with its command")]
    return []


def _unit_factor(each: Judged, gain: float) -> str | None:
    """Return the factor between degrees and radians that a gain shows, in words."""
    follows, valid = np.count_nonzero(each.follows), np.count_nonzero(each.response.valid)
    if follows < MIN_SHARE * valid or gain <= 0:
        return None
    for factor, text in ((DEGREE, "180/pi"), (1 / DEGREE, "pi/180")):
        if abs(np.log(gain / factor)) < np.log(UNIT_SLACK):
            return text
    return None


def _from_residuals(
    judged: Sequence[Judged], symptoms: Mapping[str, Sequence[Symptom]]
) -> dict[str, list[Symptom]]:
    """Find the times at which a joint leaves its usual response, and no other joint does."""
    kept = [each for each in judged if each.has_usual and not symptoms[each.motion.name]]
    samples = sum(each.motion.position.t_s.size for each in kept)

    def of_joint(each: Judged) -> Excursions:
        return find_excursions(each.motion, each.response, each.follows, each.ratio, each.offset)

    excursions = in_threads(of_joint, kept, samples)
    spans = [found.spans_s for found in excursions]
    alone = [[not _shared(span, spans, k) for span in own] for k, own in enumerate(spans)]
    return {
        each.motion.name: departures(each.response, found, own, loaded=each.loaded)
        for each, found, own in zip(kept, excursions, alone, strict=True)
    }


def _shared(span: Span, spans: Sequence[Sequence[Span]], own: int) -> bool:
    """Return whether another joint departs at the same time, as after a contact of the body."""
    return any(
        start < span[1] and stop > span[0]
        for k, other in enumerate(spans)
        if k != own
        for start, stop in other
    )


MOST_JOINTS = 2000
"""Of a session whose joints are judged; a file that claims more of them describes no robot."""

QUANTITIES = ("command", "position", "velocity", "effort", "current", "reference")


def faults_in_session(session: SessionView) -> tuple[Fault, ...]:
    """Find the joints of a session that do not follow their command.

    Returns:
        The faults, in chain order, times from the session's start; none where the session lacks
        commands or states. Of a session with breaks the longest unbroken stretch is looked at.

    Raises:
        DataError: If a topic has more than :data:`MOST_JOINTS`.
    """
    session = session.with_joints()
    quantities = {
        "command": (COMMAND_TOPIC, "position"),
        **{field: (RESPONSE_TOPIC, field) for field in UNITS},
        "current": ("/joint_current", "position"),
    }
    columns: dict[str, dict[str, Signal]] = {}
    for quantity, (topic, field) in quantities.items():
        if topic not in session.channels:
            continue
        try:
            signals = session.joints(topic, field)
        except (MissingChannelError, DataError, LogError):
            continue  # the health check itself reports a channel that can't be read
        if (count := len(signals.names)) > MOST_JOINTS:
            why = f"{topic} has {count} joints; at most {MOST_JOINTS} are judged"
            raise DataError(f"{session.path}: {why}")
        columns[quantity] = {name: signals.signal(name) for name in signals.names}
    if "command" not in columns or "position" not in columns:
        return ()
    both = (*columns["command"].values(), *columns["position"].values())
    whole = longest_unbroken(one.t_ns for one in both)
    if whole is None:
        return ()
    window_ns = (whole.start_ns, whole.last_ns + 1) if whole.others else None
    motions = motions_of(session, columns, columns["command"], window_ns)
    return () if times_made(session) else joints_not_following(motions)


def times_made(session: SessionView) -> bool:
    """Whether times were made from a frame rate, so that no joint can be judged by its lag.

    A frame holds what was sampled at times of its own, commands and positions alike.
    """
    return TIMES_FROM_FPS in session.metadata.get("undulog", {})


def motions_of(
    session: SessionView,
    columns: Mapping[str, Mapping[str, Signal]],
    names: Iterable[str],
    window_ns: tuple[int, int] | None = None,
) -> list[JointMotion]:
    """Take the recorded signals of joints, times from the session's start.

    Args:
        columns: ``command``, ``position`` and whichever of ``velocity``, ``effort``, ``current``
            and ``reference`` there are, to signals by joint name.
        window_ns: Half-open window [Unix ns]; None for all.

    Returns:
        The joints that have a command; a joint without positions has an empty record.
    """
    robot = session.robot
    limits = {} if robot is None else {j.name: (j.lower, j.upper) for j in robot.joints}
    empty = Samples(np.zeros(0), np.zeros(0))
    motions: list[JointMotion] = []
    for name in names:
        times = _Times(session.start_ns, window_ns)
        found = {key: times.samples(columns.get(key, {}).get(name)) for key in QUANTITIES}
        if (command := found["command"]) is None:
            continue
        motions.append(
            JointMotion(
                name=name,
                command=command,
                position=found["position"] or empty,
                velocity=found["velocity"],
                effort=found["effort"] or found["current"],
                reference=found["reference"],
                limits=limits.get(name),
            )
        )
    return motions


class _Times:
    """The sampling times of one joint; those that several quantities share are converted once."""

    def __init__(self, origin_ns: int, window_ns: tuple[int, int] | None) -> None:
        self._origin_ns = np.int64(origin_ns)
        self._window_ns = window_ns
        self._known: dict[int, tuple[slice, IntArray, FloatArray]] = {}

    def samples(self, signal: Signal | None) -> Samples | None:
        """The samples that are no larger than LARGEST, at increasing times; None without any."""
        if signal is None:
            return None
        part, t_ns, t_s = self._converted(signal.t_ns)
        values = signal.values[part]
        possible = np.abs(values) <= LARGEST
        if not possible.all():
            t_ns, t_s, values = t_ns[possible], t_s[possible], values[possible]
        if t_ns.size > 1 and (np.diff(t_ns) <= 0).any():
            first = np.unique(t_ns, return_index=True)[1]
            t_s, values = t_s[first], values[first]
        return Samples(t_s, values) if t_s.size else None

    def _converted(self, t_ns: IntArray) -> tuple[slice, IntArray, FloatArray]:
        if id(t_ns) not in self._known:
            part = slice(None)
            if self._window_ns is not None:
                part = slice(*np.searchsorted(t_ns, self._window_ns).tolist())
            inside = t_ns[part]
            t_s = (inside - self._origin_ns).astype(np.float64) * 1e-9
            self._known[id(t_ns)] = part, inside, t_s
        return self._known[id(t_ns)]
