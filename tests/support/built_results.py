"""Results built by hand: a snake with weak servos, one joint, and a session without a gait."""

import dataclasses
import math

from undulog.analysis.common.answer import Shape
from undulog.analysis.common.estimate import Estimate, Provenance
from undulog.analysis.parts.comparison.answer import Facts, compose
from undulog.analysis.parts.comparison.examine import Findings
from undulog.analysis.parts.gait.result import GaitFacts, Window
from undulog.analysis.parts.heterogeneity.result import Index
from undulog.analysis.parts.joints.result import JointResult
from undulog.analysis.results.analysis import Analysis, BodyPoint, BodyResult, SessionFacts
from undulog.analysis.results.coupling import Coupling


def answered(analysis, shape=()):
    """Return the result with the answer to its numbers."""
    names = tuple(j.name for j in analysis.joints if j.gain.value is not None)
    findings = Findings(shape=tuple(shape), compared=names)
    facts = Facts(analysis.gait, analysis.joints, names, (), findings, analysis.warnings)
    return dataclasses.replace(analysis, answer=compose(facts))


def around(value, half):
    return Estimate(value, (value - half, value + half))


def driven_joint(name, place, plane="horizontal", flags=()):
    """``place`` runs from 0 at the head to 1 at the tail; late and weak in the middle."""
    inside = math.sin(math.pi * place)
    lag = math.radians(7.46 + 6.2 * inside)
    net = -0.016 + 0.424 * inside
    gain = around(1.07 - 0.14 * inside + 0.01 * math.cos(9 * place), 0.0042)
    plus = max(net, 0)
    energies = (net, plus + 0.05, abs(net) + 0.11, net * 1.9 + 0.2, plus * 2.1 + 0.25)
    fit = (0.4, gain, around(lag, math.radians(0.21)))
    return JointResult(name, plane, *fit, *energies, 0.998, 800, flags=tuple(flags))


def passive_joint(name, plane="vertical"):
    energies = (0.0021, 0.004, 0.0059, None, None)
    return JointResult(name, plane, None, Estimate(), Estimate(), *energies, 1.0, 800)


def provenance(path):
    versions, options = {"undulog": "0.1.0", "numpy": "2.4.6"}, {"harmonics": 1, "settle_s": None}
    return Provenance(f"undulog analyse {path}", versions, {path: "9f" * 32}, options)


START_NS = 1_767_225_600_000_000_000
PLACES = (("head", "link01"), ("middle", "link13"), ("tail", "link26"))


def points(values, name):
    """Return points of the body from amplitude [mm] and phase [degrees], with intervals."""
    return tuple(
        BodyPoint(place, name(link), around(mm * 1e-3, 0.6e-3), around(math.radians(deg), 0.03))
        for (place, link), (mm, deg) in zip(PLACES, values, strict=True)
    )


def exact(harmonic):
    return dataclasses.replace(
        harmonic,
        amplitude_m=Estimate(harmonic.amplitude_m.value),
        phase_rad=Estimate(harmonic.phase_rad.value),
    )


RECORD = "kicks of the phase and amplitude of one joint at a time: undulog plan phase-kicks -o DIR"


def make_snake(path="weak.mcap", rename=None, session_id="weak-servo-pi3-7f3a"):
    name = rename or (lambda text: text)
    labels = [name(f"joint{i + 1:02d}") for i in range(25)]
    flags = {12: ("saturated",)}
    joints = [
        passive_joint(label) if i % 2 else driven_joint(label, i / 24, flags=flags.get(i, ()))
        for i, label in enumerate(labels)
    ]
    body = BodyResult(
        plane="horizontal",
        observed=points(((52, 0), (35, -128), (30, 97)), name),
        null={"viscous": tuple(map(exact, points(((55, 0), (41, -117), (38, 110)), name)))},
    )
    contrast = (-0.1082, (-0.1134, -0.1030))
    indices = {
        "gain_cv": Index(0.0412, (0.0387, 0.0440), 0.0004, "1", "coefficient of variation of gain"),
        "lag_sd": Index(0.0371, (0.0352, 0.0391), 1e-7, "rad", "circular sd of lag"),
        "boundary_contrast_lag": Index(*contrast, None, "rad", "lag, ends minus middle"),
        "energy_gini": Index(0.44, None, None, "1", "Gini coefficient of E_abs"),
    }
    return answered(
        Analysis(
            session=SessionFacts(name(session_id), path, name("snake25"), START_NS, 16.0, "good"),
            gait=GaitFacts(
                frequency_hz=around(0.5, 0.0002),
                windows=(Window(8.0, 16.0, 4.0),),
                wave="head-to-tail",
                lag_per_joint_rad={"horizontal": math.pi / 3},
            ),
            joints=tuple(joints),
            body=body,
            heterogeneity=indices,
            coupling=Coupling(False, "one gait gives 13 numbers for 169 unknowns", RECORD),
            warnings=(
                "Boundary and modules can't be told apart by one direction; record the reverse.",
                name("E_el of joint02 is null: the session has no /joint_current of it."),
            ),
            provenance=provenance(path),
        ),
        [Shape("ends", "lag", "horizontal", 0, *contrast)],
    )


def make_still():
    nothing = Estimate()
    joints = tuple(
        JointResult(f"j{i}", None, None, nothing, nothing, None, None, None, None, None, 0.0, 0)
        for i in range(4)
    )
    return answered(
        Analysis(
            session=SessionFacts("ramp", "ramp.mcap", None, START_NS, 3.0, None),
            gait=GaitFacts(nothing),
            joints=joints,
            body=None,
            heterogeneity={"gain_cv": Index(*[None] * 3, "1", "coefficient of variation of gain")},
            coupling=Coupling(False, "no gait was found", "a periodic gait of at least 5 cycles"),
            warnings=("No gait: the commands are a ramp, no line stands out of their spectrum.",),
            provenance=provenance("ramp.mcap"),
        )
    )


def make_single():
    return answered(
        Analysis(
            session=SessionFacts("bench", "servo.mcap", "bench1", 0, 21.0, "degraded"),
            gait=GaitFacts(around(1.25, 0.001), (Window(1.0, 21.0, 25.0),)),
            joints=(driven_joint("servo", 0.5, plane=None),),
            body=None,
            heterogeneity={},
            coupling=Coupling(False, "one joint has nobody to be coupled to"),
            warnings=(),
            provenance=provenance("servo.mcap"),
        )
    )
