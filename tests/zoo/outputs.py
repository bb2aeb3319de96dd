"""Outputs of undulog on a bag or on arrays: the only module here that imports it."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from html import unescape

import numpy as np

from undulog.analysis.compare.compare import Choices, compare_sessions
from undulog.analysis.present.page import render
from undulog.analysis.session.analyse import analyse_session
from undulog.analysis.signals.stretch import Options
from undulog.capture import Session
from undulog.capture.common.errors import UndulogError
from undulog.capture.judgement.judge import judge
from undulog.capture.judgement.motion import RecordedJoint, Samples
from undulog.capture.log.health.session_check import check_session
from undulog.replay.draw.drawing import markdown
from undulog.replay.samples.content import Content

from .robot import SECOND_TOPIC

OUTPUTS = ("answer", "log check", "compare", "page", "rerun")
EMPTY = Content(None, None, None, None, (), (), (), False, (), (), 0, False, ())


@dataclass(frozen=True)
class Named:
    """A joint that an output names as not following.

    Attributes:
        kinds: The kinds stated.
        since_s: Onset [s], None: from the beginning.
    """

    kinds: frozenset[str]
    since_s: float | None


@dataclass(frozen=True)
class Statement:
    """The statement of one output.

    Attributes:
        text: Its first statement; of ``log check`` the reasons.
        not_following: By joint name; None where the output has no structure.
        stands_out: Joint name to quantities; None likewise.
        undecided: Whether it says that no joint can be named.
        alike: Whether it claims that the joints move alike, or that two sessions are the same.
        error: What went wrong instead, or empty.
        changes: Joint name to the quantities that changed during the session.
    """

    text: str
    not_following: Mapping[str, Named] | None = None
    stands_out: Mapping[str, frozenset[str]] | None = None
    undecided: bool | None = None
    alike: bool = False
    error: str = ""
    changes: Mapping[str, frozenset[str]] = field(default_factory=dict)


def statements(path, healthy, *, second, outputs=OUTPUTS):
    """Return the statement of each output on a bag.

    Args:
        path: The bag.
        healthy: A healthy session of the same robot, for ``compare``; None: no comparison.
        second: Whether the bag has a second sensor.
        outputs: Names of the outputs.
    """
    options = Options(reference_topic=SECOND_TOPIC if second else None)
    try:
        results = _analysed(path, options, outputs)
    except UndulogError as error:
        names = {"answer", "page", "rerun"} & set(outputs)
        results = {name: Statement("", error=str(error)) for name in names}
    if "log check" in outputs:
        health = check_session(path)
        results["log check"] = Statement("\n".join(health.reasons), alike=health.verdict == "good")
    if "compare" in outputs and healthy is not None:
        results["compare"] = _compared(healthy, path, options)
    return results


def _analysed(path, options, outputs):
    results = {}
    with Session.open(path) as session:
        analysis = analyse_session(session, options)
        if "answer" in outputs:
            results["answer"] = structured(analysis.answer)
        if "page" in outputs:
            # Without signals and maps, whose drawing takes half of the time.
            results["page"] = Statement(_plain(_heading(render(analysis))))
        if "rerun" in outputs:
            text = markdown(session, analysis, notes=(), colors="", content=EMPTY, has_cycles=False)
            shown = re.sub(r"\\(.)", r"\1", text.split("\n\n")[0])  # as Markdown shows it
            results["rerun"] = Statement(shown)
    return results


def structured(answer):
    """Return the statement of an answer, with its lists."""
    quantities = {}
    for difference in answer.stand_out:
        quantities[difference.joint] = quantities.get(difference.joint, frozenset()) | {
            difference.quantity
        }
    undecided, alike = answer.undecided is not None, bool(answer.alike)
    named = _named(answer.not_following)
    changed = _changed(answer.changes)
    return Statement(answer.sentence, named, quantities, undecided, alike, changes=changed)


def detected(log):
    """Return the joints that do not follow by the detection alone, on arrays: no bag, no answer."""
    robot = log.robot
    sent = robot.sent()

    def samples(columns, j):
        if columns is None:
            return None
        kept = np.isfinite(columns[:, j])
        return Samples(robot.t_s[kept, j], columns[kept, j])

    logged = {"velocity": log.velocity, "effort": log.effort, "reference": log.second}
    # Effort is that of the true position, and so is a velocity of its own.
    outside = frozenset({"effort", *(["velocity"] if robot.channels.velocity == "true" else [])})
    motions = [
        RecordedJoint(
            name,
            Samples(robot.sent_s, sent[:, j]),
            samples(log.position, j),
            **{key: samples(columns, j) for key, columns in logged.items()},
            outside_loop=outside,
        )
        for j, name in enumerate(robot.names)
    ]
    judgement = judge(motions)
    named, changed = _named(judgement.faults), _changed(judgement.changes)
    return Statement(" ".join(named | changed), named, changes=changed)


def _named(faults):
    return {fault.joint: Named(frozenset(fault.kinds), fault.since_s) for fault in faults}


def _changed(changes):
    return {change.joint: frozenset({change.quantity}) for change in changes}


def _compared(healthy, path, options):
    try:
        with Session.open(healthy) as first, Session.open(path) as other:
            comparison = compare_sessions(first, other, Choices(session=options))
    except UndulogError as error:
        return Statement("", error=str(error))
    return Statement(comparison.answer, alike=comparison.verdict in {"same", "open"})


def _heading(page):
    match = re.search(r'<h1\b[^>]*\bid="answer"[^>]*>(.*?)</h1>', page, re.DOTALL)
    return "" if match is None else match[1]


def _plain(markup):
    """Text without tags, soft hyphens and zero-width spaces."""
    return re.sub("[\u00ad\u200b\u2060]", "", unescape(re.sub(r"<wbr[^>]*>|<[^>]*>", "", markup)))
