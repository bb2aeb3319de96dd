"""Energies of each joint on the samples' own times, and their comparison with the twin's ledger.

E_net is the integral of torque times velocity, E_plus that of its positive part (a joint that
can't take energy back), E_abs that of its absolute value; E_el is the integral of motor voltage
times motor current, signed and clipped. Where the log has the powers themselves, accumulated within
each sampling interval (:class:`.PowerTopic`), their means are added up;
else sampled factors are multiplied, and what the two do within an interval is lost. Gaps are not
bridged: no time inside them counts.

The twin books energy in a ledger at its physics rate. Products of samples miss what happens
between them; a large difference gives a warning.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from undulog.capture import SessionView
from undulog.capture.common.arrays import FloatArray, IntArray
from undulog.capture.common.console import Warn
from undulog.capture.common.errors import DataError, LogError
from undulog.capture.common.process import in_threads
from undulog.capture.log.messages.definitions import PowerTopic
from undulog.capture.log.read.sample_times import Signal
from undulog.capture.robot.model import Robot

from ...common.estimate import Estimate
from ...common.remarks import Note
from ...estimators.demodulation import Weighed, cycle_sums, weigh
from ...estimators.intervals import around, t_factor
from ...estimators.series import Series, clean
from ...signals.columns import Columns
from ...signals.windows import Span
from ..artefacts.result import Artefact
from ..body.travel import GRAVITY, body_steps
from .result import Closure, Each, EnergyResult, JointCycles, Transport

TERMS = {
    "net": ("mechanical", "net_j", "mechanical_net"),
    "plus": ("mechanical", "plus_j", "mechanical_plus"),
    "abs": ("mechanical", "abs_j", "mechanical_abs"),
    "el": ("electrical", "net_j", "electrical_net"),
    "el_clipped": ("electrical", "plus_j", "electrical_plus"),
}
"""Energy to its kind, its attribute of :class:`Energy`, and its term in the ledger."""

GAP_SHARE = 0.01
"""More of the window without samples is worth a flag, or of power a warning."""

STEADY_SHARE = 0.2
"""A voltage that varies by less than this part of its mean is a supply's: a motor's follows the
duty, through zero and back in every cycle."""

LEDGER_TOPIC = "/energy_ledger"
TOLERANCE = 0.05
"""Difference, as a share of the absolute energy, that is worth a warning."""

LEAST_WAY = 0.01
"""Displacement in a cycle, over the body's length, below which a robot goes nowhere."""


@dataclass(frozen=True)
class Energy:
    """Energies of one power signal, cycle by cycle.

    Attributes:
        net_j: Integral of the power in each cycle [J], shape (c,).
        plus_j: Of its positive part [J], shape (c,).
        coverage: Fraction of the window that has samples.
        covered: Fraction of each cycle that has samples, shape (c,).
    """

    net_j: FloatArray
    plus_j: FloatArray
    coverage: float
    covered: FloatArray

    @property
    def abs_j(self) -> FloatArray:
        """Integral of the absolute power in each cycle, 2 plus - net [J], shape (c,)."""
        return 2 * self.plus_j - self.net_j


def integrate(
    powers: Sequence[Series], start_s: float, stop_s: float, cycles: int = 1
) -> list[Energy | None]:
    """Integrate powers over one window; those with the same times are weighed once.

    Args:
        powers: Powers [W], each on its own times.
        start_s: Start of the window [s].
        stop_s: Its end, not included [s].
        cycles: Parts of equal length that the window is cut into.

    Returns:
        The energies of each, or None where the window has no samples of it.
    """
    energies: list[Energy | None] = []
    last: Weighed | None = None
    for power in powers:
        part = power.between(start_s, stop_s)
        if part.count < 2:
            energies.append(None)
            continue
        if last is None or not np.array_equal(last.t_s, part.t_s):
            last = weigh(part.t_s, start_s, stop_s, cycles)
        work = last.weights * part.values
        net = cycle_sums(work, last.starts)
        plus = cycle_sums(np.maximum(work, 0.0, out=work), last.starts)
        energies.append(Energy(net, plus, last.coverage, last.covered))
    return energies


def add_up(net: Series, plus: Series, start_s: float, stop_s: float, cycles: int) -> Energy | None:
    """Add up mean powers over one window; each holds for one sampling interval about its time.

    Args:
        net: Mean powers [W], shape (n,).
        plus: Means of their positive parts [W], at the same times.
        start_s: Start of the window [s].
        stop_s: Its end [s].
        cycles: Parts of equal length that the window is cut into, c.

    Returns:
        The energies, or None where the window has no samples or the two differ in their times.
    """
    if stop_s <= start_s or net.count < 2 or not np.array_equal(net.t_s, plus.t_s):
        return None
    length_s = net.period_s
    begin = net.t_s - length_s / 2
    edges = np.linspace(start_s, stop_s, cycles + 1)
    last = np.maximum(np.searchsorted(begin, edges, side="right") - 1, 0)
    within = np.clip(edges - begin[last], 0.0, length_s)

    def of(values: FloatArray) -> FloatArray:
        before = np.concatenate(([0.0], np.cumsum(values)))[last] * length_s
        return np.diff(before + values[last] * within)

    time_s = of(np.ones(net.count))
    if not time_s.any():
        return None
    share = np.minimum(time_s * cycles / (stop_s - start_s), 1.0)
    return Energy(of(net.values), of(plus.values), float(share.mean()), share)


def power_of(first: Signal, second: Signal, origin_ns: int) -> Series:
    """Return the product of two signals as a power on the first one's times.

    Args:
        first: E.g. torque, or current.
        second: E.g. velocity, or voltage; interpolated where it was sampled at other times, but
            not across its gaps.
        origin_ns: Unix time that becomes 0 s.

    Returns:
        The power [W].
    """
    alike = np.array_equal(first.t_ns, second.t_ns)
    factor = second.values if alike else _interpolate(first.t_ns, second)
    return clean(first.name, first.t_ns, first.values * factor, origin_ns)


def _interpolate(t_ns: IntArray, signal: Signal) -> FloatArray:
    if not t_ns.size:
        return t_ns.astype(np.float64)
    series = clean(signal.name, signal.t_ns, signal.values, int(t_ns[0]))
    if series.count < 2:
        return np.full(t_ns.size, np.nan)
    t_s = (t_ns - t_ns[0]).astype(np.float64) * 1e-9
    values = series.at(t_s)
    values[(t_s < series.t_s[0]) | (t_s > series.t_s[-1])] = np.nan
    for k in series.gaps:
        values[(t_s > series.t_s[k]) & (t_s < series.t_s[k + 1])] = np.nan
    return values


@dataclass(frozen=True)
class Energies:
    """Energies of one joint.

    Attributes:
        mechanical: By torque and velocity; None if they were not recorded.
        electrical: By voltage and current; None likewise.
        sampled: Kinds that are products of samples, without changes within a sampling interval.
    """

    mechanical: Energy | None
    electrical: Energy | None
    sampled: frozenset[str] = frozenset()

    def per_cycle(self, name: str) -> FloatArray | None:
        """Return one of :data:`TERMS` in each cycle [J], shape (c,), or None."""
        kind, attribute, _ = TERMS[name]
        energy: Energy | None = getattr(self, kind)
        return None if energy is None else getattr(energy, attribute)


def joint_energies(
    session: SessionView, columns: Columns, artefacts: Iterable[Artefact], span: Span, warn: Warn
) -> dict[str, Energies]:
    """Return the energies of all joints; warn of powers with gaps or falsified by a sensor."""
    wrong = list(artefacts)
    false = {artefact.joint for artefact in wrong if artefact.falsifies("velocity", "effort")}
    false_el = {artefact.joint for artefact in wrong if artefact.falsifies("current", "voltage")}
    for joints, kind in ((false, "mechanical"), (false_el, "electrical")):
        if joints:
            named = ", ".join(name for name in columns.names if name in joints)
            warn(f"{named}: {kind} energies are null, since a sensor falsifies them")

    def of_joint(name: str) -> Energies:
        powers: dict[str, Series] = {}
        energies: dict[str, Energy | None] = {}
        window = span.start_s, span.stop_s, max(span.cycles, 1)
        for kind, (first, second), wrong in (
            ("mechanical", (columns.effort, columns.velocity), false),
            ("electrical", (columns.current, columns.voltage), false_el),
        ):
            if name in wrong:  # what accumulates powers goes by the same sensors
                continue
            energies[kind] = _accumulated(columns, kind, name, span.origin_ns, window)
            if energies[kind] is None and name in first and name in second:
                powers[kind] = power_of(first[name], second[name], span.origin_ns)
        energies |= zip(powers, integrate([*powers.values()], *window), strict=True)
        return Energies(energies.get("mechanical"), energies.get("electrical"), frozenset(powers))

    samples = sum(
        signal.t_ns.size for signal in (*columns.effort.values(), *columns.current.values())
    )
    measured = in_threads(of_joint, columns.names, samples, session.forget)
    result = dict(zip(columns.names, measured, strict=True))

    def has_gaps(energies: Energies) -> bool:
        both = energies.mechanical, energies.electrical
        return any(energy is not None and energy.coverage < 1 - GAP_SHARE for energy in both)

    if thin := [name for name, energies in result.items() if has_gaps(energies)]:
        warn(
            f"the power of {', '.join(thin)} has gaps, which are not bridged: energies count only "
            "the time that has samples"
        )
    return result


def _accumulated(
    columns: Columns, kind: str, name: str, origin_ns: int, window: tuple[float, float, int]
) -> Energy | None:
    """Return the energy by the powers that the log has themselves, or None."""
    topics = (PowerTopic[kind.upper()], PowerTopic[f"{kind.upper()}_PLUS"])
    net, plus = (columns.powers[topic].get(name) for topic in topics)
    if net is None or plus is None:
        return None
    mean, positive = (clean(name, signal.t_ns, signal.values, origin_ns) for signal in (net, plus))
    return add_up(mean, positive, *window)


def energy_result(
    session: SessionView,
    columns: Columns,
    energies: Mapping[str, Energies],
    span: Span,
    *,
    transport: Transport,
    closure: Closure | None,
    warn: Warn,
) -> EnergyResult:
    """Return the energies cycle by cycle; warn if E_el comes from the supply's voltage."""
    shift_s = (span.origin_ns - session.start_ns) * 1e-9
    edges = np.linspace(span.start_s, span.stop_s, max(span.cycles, 1) + 1) + shift_s
    joints = [
        JointCycles(
            name,
            **{f"{term}_j": _each(energy.per_cycle(term)) for term in TERMS},
            coverage=_each(None if energy.mechanical is None else energy.mechanical.covered),
            el_coverage=_each(None if energy.electrical is None else energy.electrical.covered),
        )
        for name, energy in energies.items()
    ]
    if (source := electrical_source(session, columns)) == "supply":
        warn(
            f"{columns.topics['voltage']} stays as it is while the joints work, so it is the "
            "supply's, not the motors': E_el is an upper bound"
        )
    return EnergyResult(
        tuple(edges[:-1].tolist()),
        tuple(edges[1:].tolist()),
        tuple(joints),
        source,
        transport,
        closure,
        _unknown(energies.values()),
    )


def electrical_source(session: SessionView, columns: Columns) -> str | None:
    """What electrical energy is made of.

    Returns:
        ``simulated``, ``motor``, ``supply``, or None where current or voltage was not recorded.
    """
    both = [name for name in columns.voltage if name in columns.current]
    if not both:
        return None
    if "scenario" in session.metadata.get("undulog", {}):
        return "simulated"
    return "supply" if _all_steady(columns.voltage[name].values for name in both) else "motor"


def _unknown(energies: Iterable[Energies]) -> str | None:
    """What the log leaves open, in one sentence."""
    sampled = frozenset[str]().union(*(energy.sampled for energy in energies))
    factors = {"mechanical": "torque and velocity", "electrical": "voltage and current"}
    parts = [f"{kind} energies are products of sampled {factors[kind]}" for kind in sorted(sampled)]
    if not parts:
        return None
    return (
        f"{' and '.join(reversed(parts))}: what these do within a sampling interval is not in the "
        "log, so the error is unknown"
    )


def _all_steady(voltages: Iterable[FloatArray]) -> bool:
    for values in voltages:
        finite = values[np.isfinite(values)]
        if finite.size and np.ptp(finite) > STEADY_SHARE * abs(float(finite.mean())):
            return False
    return True


def _each(values: FloatArray | None) -> Each:
    return None if values is None else tuple(values.tolist())


def check_ledger(
    session: SessionView, energies: Iterable[Energies], span: Span, warn: Warn
) -> Closure | None:
    """Compare the joints' energies with the ledger's over the same window, and close its balance.

    Args:
        warn: Called where they differ by more than ``TOLERANCE``.

    Returns:
        The closure, or None where the session has no ledger.
    """
    try:
        booked = booked_energies(session, span)
    except (DataError, LogError) as error:
        warn(f"{LEDGER_TOPIC} can't be read: {error}")
        return None
    if booked is None:
        return None
    totals = whole_robot(energies)
    off: dict[str, float] = {}
    for name, (kind, _, term) in TERMS.items():
        if name in totals and term in booked:
            off[name] = totals[name] - booked[term]
            scale = max(totals["abs" if kind == "mechanical" else "el_abs"], abs(booked[term]))
            if name in ("net", "el") and abs(off[name]) > TOLERANCE * scale:
                warn(
                    f"{kind} energy is {totals[name]:.4g} J from the samples but "
                    f"{booked[term]:.4g} J in the twin's ledger ({LEDGER_TOPIC}): samples once a "
                    "control cycle miss what happens within it"
                )
    whole = booked.get("mechanical_abs", 0.0)

    def share(energy_j: float | None) -> float | None:
        return None if energy_j is None or whole <= 0 else energy_j / whole

    return Closure(
        mechanical_balance=share(booked.get("mechanical_residual")),
        electrical_balance=share(booked.get("electrical_residual")),
        **{name: share(off.get(name)) for name in TERMS},
    )


def booked_energies(session: SessionView, span: Span) -> dict[str, float] | None:
    """What the twin's ledger books over a window.

    Returns:
        Energies of the whole robot [J], by the ledger's terms; None where there is no ledger.

    Raises:
        DataError: If the ledger's topic can't be read.
        LogError: If the file can't.
    """
    if LEDGER_TOPIC not in session.channels:
        return None
    ledger = session.joints(LEDGER_TOPIC)
    booked: dict[str, float] = {}
    for name, t_ns, values in zip(ledger.names, ledger.t_ns, ledger.values, strict=True):
        term = clean(name, t_ns, values, span.origin_ns)
        if term.count > 1 and term.t_s[0] <= span.stop_s:
            # Cumulative, so that a difference is the energy of the window.
            late, early = (
                float(np.interp(t, term.t_s, term.values)) for t in (span.stop_s, span.start_s)
            )
            booked[name] = late - early
    return booked


def whole_robot(energies: Iterable[Energies]) -> Mapping[str, float]:
    """Return the energies of all joints together.

    Returns:
        Sums [J], by the names in :data:`TERMS`, with ``el_abs`` besides; those that no joint has
        are absent.
    """
    joints = list(energies)
    sums: dict[str, float] = {}
    for name, (kind, part, _) in {**TERMS, "el_abs": ("electrical", "abs_j", "")}.items():
        if measured := [energy for joint in joints if (energy := getattr(joint, kind)) is not None]:
            sums[name] = sum(float(getattr(energy, part).sum()) for energy in measured)
    return sums


def transport(
    session: SessionView,
    responses: Mapping[str, Series],
    energies: Mapping[str, Energies],
    span: Span,
    warn: Warn,
) -> Transport:
    """Cost of transport of a session.

    Args:
        responses: Measured joint angles that can be trusted, by name.
        energies: By joint name, in cycles.
        warn: Called with the reason why there is no value.

    Returns:
        The cost, or the reason why it is not applicable.
    """
    mass = None if session.robot is None else session.robot.total_mass
    distance = nothing = Estimate()
    reasons: list[str] = []

    def refuse(sentence: str) -> None:
        reasons.append(sentence.rpartition("no cost of transport: ")[2])

    steps = body_steps(session, responses, span, refuse)
    if steps is not None and session.robot is not None:
        distance = _distance(steps.forward_m)
        reasons += _goes_nowhere(steps.forward_m, distance, session.robot)
    if steps is None or reasons:
        why = "; ".join(reasons)
        warn(Note(f"cost of transport is not applicable: {why}"))
        return Transport(distance, mass, *[nothing] * 5, why=why)
    weighed = steps.mass_kg * GRAVITY * steps.forward_m
    sums = {
        name: in_all([energy.per_cycle(name) for energy in energies.values()]) for name in TERMS
    }
    kinds = dict.fromkeys(TERMS[name][0] for name, total in sums.items() if total is None)
    lacking = [f"no {kind} energy of some joints" for kind in kinds]
    if lacking:
        warn(Note(f"cost of transport is partly null: {' and '.join(lacking)}"))
    costs = [nothing if total is None else _ratio(total, weighed) for total in sums.values()]
    return Transport(distance, mass, *costs, why="; ".join(lacking))


def _distance(way: FloatArray) -> Estimate:
    """Net displacement, with the interval that its scatter over cycles gives."""
    half = t_factor(way.size - 1) * float(way.std(ddof=1)) * way.size**0.5
    total = float(way.sum())
    return Estimate(total, around(total, half))


def _goes_nowhere(way: FloatArray, distance: Estimate, robot: Robot) -> list[str]:
    """Why a displacement can't be divided by; empty where it can."""
    total = float(way.sum())
    least = LEAST_WAY * sum(link.length for link in robot.links) * way.size
    if total >= least and distance.ci95 is not None and distance.ci95[0] > 0:
        return []
    moved = f"the centre of mass moves by {1000 * total:.3g} mm in {way.size} cycles"
    return [f"{moved}, which does not differ significantly from 0"]


def in_all(energies_j: Sequence[FloatArray | None]) -> FloatArray | None:
    """Return the energy of all joints together in each cycle [J]; None if one is unknown."""
    measured = [energy_j for energy_j in energies_j if energy_j is not None]
    return np.sum(measured, axis=0) if measured and len(measured) == len(energies_j) else None


def _ratio(above: FloatArray, below: FloatArray) -> Estimate:
    """Return the ratio of two sums over cycles, with the interval of a ratio estimator.

    With r the ratio, var r = n / (n - 1) sum (a - r b)^2 / (sum b)^2 (Cochran, Sampling Techniques,
    1977, section 6.3).
    """
    n, total = above.size, float(below.sum())
    value = float(above.sum()) / total
    scatter = float(np.sum((above - value * below) ** 2))
    half = t_factor(n - 1) * (n / (n - 1) * scatter) ** 0.5 / abs(total)
    return Estimate(value, around(value, half))
