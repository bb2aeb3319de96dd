"""Part (e): the paper's own statements, each held against the conclusions."""

from __future__ import annotations

from dataclasses import dataclass

from .conclusions import Verdict


@dataclass(frozen=True)
class Statement:
    """A statement of the paper.

    Attributes:
        verdict: If all conclusions named hold.
        finding: What was found, on top of those conclusions.
        conclusions: Names of those that it rests on; the page elsewhere if there are none.
    """

    text: str
    verdict: str
    finding: str
    conclusions: tuple[str, ...] = ()


STATEMENTS = (
    Statement(
        "Segments move unequally: amplitude and phase of head, middle and tail differ.",
        "refined",
        "It holds for the joints' response to their commands, as the last figure of "
        "[the paper, figure by figure](explanation/paper.md) has it beside its null. Link "
        "positions, which the paper shows, differ by kinematics alone with every joint exactly on "
        "its command.",
        ("weak-servos", "boundary"),
    ),
    Statement(
        "The chain has open ends, and the first and the last have one neighbour (Eq. 1).",
        "supported",
        "The ends are what makes identical modules unequal: they mirror when the wave is reversed.",
        ("boundary",),
    ),
    Statement(
        "Weak servos and the load of the ground are why joints respond unequally.",
        "refined",
        "Near a bending mode inertia does as much, without a ground too.",
        ("weak-servos", "friction", "contact"),
    ),
    Statement(
        "Oscillators are coupled to their next neighbours (Eq. 1).",
        "refuted for what the body couples",
        "A generator may be built so; the body couples further, with both signs.",
        ("not-neighbours",),
    ),
    Statement(
        "The body may take part in coupling the rhythm generators (left open).",
        "refined",
        "It does, and alone it doesn't suffice: most patterns are left to themselves, one grows "
        "slowly, so explicit coupling has to supply the gap.",
        ("neutral", "never-alone"),
    ),
    Statement(
        "How heterogeneous couplings affect scalability and synchronisation is open.",
        "answered for this body",
        "P is measured open loop and gives it.",
        ("helps", "path", "body-and-path", "heterogeneity", "linear"),
    ),
    Statement(
        "The skin is rougher along the body than across.",
        "refuted for lateral undulation",
        "The robot's wheels, and lateral undulation, need μ_n > μ_t.",
        ("rough-across",),
    ),
    Statement(
        "The last figure compares lags of π/2 and π/3.",
        "refined",
        "Joints respond the more alike the larger the lag. Part of what link positions show is "
        "kinematics: [the null](explanation/paper.md#head-middle-and-tail-of-13-links) beside that "
        "figure.",
        ("short-waves",),
    ),
    Statement(
        "Contact is a spring and damper, F_n = -k p_z - d v_z for p_z < 0 (Eq. 7).",
        "refined",
        "Clamped at 0: ground doesn't pull ([physics](explanation/physics.md)).",
    ),
    Statement(
        "A chain of delay blocks makes the serpentine wave of Eq. 2.",
        "refined",
        "Equal at constant frequency and amplitude alone "
        "([delay blocks](explanation/paper.md#delay-blocks)).",
    ),
    Statement(
        "A~(d) = exp(k d) - A_max shrinks the amplitude near a wall.",
        "refined",
        "Ill-formed as printed; [adaptive control](explanation/control.md) has the bounded law "
        "that does.",
    ),
)


def lines(verdicts: list[Verdict]) -> list[str]:
    """Return the table of statements; a statement whose conclusions fail is open."""
    by_name = {one.conclusion.name: one for one in verdicts}
    rows = ["| the paper | verdict | with |", "|---|---|---|"]
    for one in STATEMENTS:
        named = [by_name[name] for name in one.conclusions]
        verdict = one.verdict if all(v.holds for v in named) else "open"
        with_ = " ".join([*(f"`{v.conclusion.name}`: {v.expression}." for v in named), one.finding])
        rows.append(f"| {one.text} | **{verdict}** | {with_} |")
    return rows
