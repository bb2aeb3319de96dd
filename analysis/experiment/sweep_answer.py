"""A lag sweep or multisine in words: one sentence, and the lines below it."""

from __future__ import annotations

from collections.abc import Iterable

from ..results import formats
from ..results.coupling import Coupling
from ..results.sweep import LinearCoupling, Route, ToneCoupling

_TOLD = {
    Route.TORQUE: "Z from torques",
    Route.SERVO: "Z from H and the servo's parameters",
    Route.ROW_SCALED: "H^-1, which is Z up to a factor for each row",
}


def sweep_answer(coupling: Coupling) -> str:
    """Answer from the coupling.

    Args:
        coupling: Of a sweep.

    Returns:
        One sentence without its full stop, intervals in square brackets.
    """
    if not isinstance(coupling, LinearCoupling):
        return f"coupling not identifiable from these runs: {coupling.why}"
    first = coupling.tones[0]
    where = {True: " in contact", False: " without contact", None: ""}[coupling.contact]
    told = f"coupling{where} at {first.frequency_hz:.4g} Hz"
    if first.asymmetry.value is None:
        return f"{told}: H can't be inverted"
    return (
        f"{told}: {formats.percent(first.within_1)} of it is between neighbours, "
        f"{formats.percent(first.within_2)} within two joints; "
        f"asymmetry {formats.percent(first.asymmetry)} ({_TOLD[first.route]})"
    )


def sweep_detail(coupling: LinearCoupling) -> Iterable[str]:
    """What stands below the answer.

    Args:
        coupling: Of a sweep.

    Yields:
        Sentences.
    """
    for tone in coupling.tones:
        yield _tone(tone)
    yield from sweep_checks(coupling)


def sweep_checks(coupling: LinearCoupling) -> Iterable[str]:
    """What was checked of all tones together.

    Args:
        coupling: Of a sweep.

    Yields:
        Sentences.
    """
    yield f"{coupling.route_why[0].upper()}{coupling.route_why[1:]}."
    settled = (
        "settled"
        if coupling.drift_per_cycle == 0
        else f"NOT settled, drift {100 * coupling.drift_per_cycle:.2g} % per cycle"
    )
    beside = (
        "energy beside the tones unknown"
        if coupling.sideband_energy.value is None
        else f"energy beside the tones {_little(coupling.sideband_energy.value)} of theirs"
    )
    yield f"Checks: {settled}; {beside}. Valid {coupling.validity}."


def sweep_method(coupling: LinearCoupling) -> str:
    """How the numbers were made.

    Args:
        coupling: Of a sweep.

    Returns:
        A sentence in lower case, with its full stop.
    """
    return (
        f"{coupling.plan}, {coupling.runs} runs of {len(coupling.joints)} joints: H = Y C^-1 at "
        f"each tone, C as held by the servos ({1000 * coupling.hold_s:.3g} ms late); elements' "
        "intervals one by one at 95 % from the noise beside each tone (Student's t), those of "
        "indices at least 95 %; all matrices with --json."
    )


def _little(share: float) -> str:
    """A share that may be next to nothing."""
    return "less than 0.001 %" if share < 1e-5 else f"{100 * share:.2g} %"


def _tone(tone: ToneCoupling) -> str:
    cond = [f"C {tone.command_condition:.3g}"]
    if tone.condition_number is not None:
        cond.append(f"H {tone.condition_number:.3g}")
    if tone.route is Route.TORQUE and tone.inverted_condition is not None:
        cond.append(f"Y {tone.inverted_condition:.3g}")
    text = f"{tone.frequency_hz:.4g} Hz: condition numbers {', '.join(cond)}"
    if tone.asymmetry.value is not None:
        of = "X = H^-1" if tone.Z is None else "Z"
        bands = ", ".join(
            f"{formats.percent(share)} within {k}"
            for k, share in enumerate((tone.within_1, tone.within_2, tone.within_3), start=1)
        )
        text += f"; {of}: asymmetry {formats.percent(tone.asymmetry)}, off-diagonal energy {bands}"
    if tone.servo_difference is not None:
        text += (
            f"; Z behind the described servos is {formats.number(100 * tone.servo_difference, 1)} "
            "% off"
        )
    if tone.distortion is not None:
        text += f"; distortion {100 * tone.distortion:.2g} %"
    return f"{text}."
