"""What the page shows of a lag sweep or a multisine: key figures, and checks as questions."""

from __future__ import annotations

from ...experiment.sweep.coupling import NONLINEAR
from ...results import formats
from ...results.sweep import LinearCoupling
from .tables import Fact
from .trials import Trial
from .typeset import digits

AGREE = 0.1
"""Z by torques and Z behind the described servos are called one up to this relative difference."""


def sweep_facts(coupling: LinearCoupling) -> list[Fact]:
    """Key figures at the first tone.

    Args:
        coupling: Of a sweep.

    Returns:
        Six facts.
    """
    tone = coupling.tones[0]
    tones = ", ".join(f"{one.frequency_hz:.4g}" for one in coupling.tones)
    at = f"{tone.frequency_hz:.4g} Hz"
    what = "X" if tone.Z is None else "Z"
    of = f"of the off-diagonal energy of {what} at {at}"
    inverted = tone.inverted_condition if tone.Z is not None else tone.condition_number
    return [
        Fact(
            "Tone" if len(coupling.tones) == 1 else "Tones",
            f"{tones} Hz",
            {True: "in contact", False: "without contact", None: "contact unknown"}[
                coupling.contact
            ],
        ),
        Fact("Asymmetry", formats.percent(tone.asymmetry), f"of {what} at {at}; 0 is reciprocal"),
        Fact("Between neighbours", formats.percent(tone.within_1), of),
        Fact("Within two joints", formats.percent(tone.within_2), of),
        Fact("Within three joints", formats.percent(tone.within_3), of),
        Fact(
            "Condition number",
            "singular" if inverted is None else f"{inverted:.3g}",
            "of what is inverted; the errors grow by it",
        ),
    ]


def sweep_trials(coupling: LinearCoupling) -> list[Trial]:
    """What must hold for the matrices to mean something.

    Args:
        coupling: Of a sweep.

    Returns:
        Trials.
    """
    drift = coupling.drift_per_cycle
    settled = "no drift beyond noise" if drift == 0 else f"drift {digits(100 * drift)} % a cycle"
    trials = [
        Trial("Is every run settled?", settled, None, "no: settle longer" if drift else "yes"),
        _linear(coupling),
    ]
    for tone in coupling.tones:
        at = f"at {tone.frequency_hz:.4g} Hz"
        if tone.asymmetry.ci95 is not None:
            trials.append(
                Trial(
                    f"Does every pair of joints act on one another alike, {at}?",
                    f"asymmetry {formats.percent(tone.asymmetry)}",
                    None,
                    "no" if tone.asymmetry.ci95[0] > 0 else "a difference could not be shown",
                )
            )
        apart = tone.servo_difference
        if apart is not None:
            trials.append(
                Trial(
                    f"Do the described servos fit the torques, {at}?",
                    f"Z differs by {digits(100 * apart)} %",
                    None,
                    f"{'yes' if apart <= AGREE else 'no'}, {100 * AGREE:g} % is taken as one",
                )
            )
    return trials


def _linear(coupling: LinearCoupling) -> Trial:
    question = f"Is the chain linear for these motions, within {100 * NONLINEAR:g} %?"
    known = [one.distortion for one in coupling.tones if one.distortion is not None]
    if not known:
        return Trial(question, "records too short for lines beside the tones", None, "open")
    worst = max(known)
    verdict = "yes" if worst <= NONLINEAR else "no: take a smaller amplitude"
    return Trial(question, f"largest distortion {digits(100 * worst)} %", None, verdict)
