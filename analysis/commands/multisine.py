"""Command ``plan multisine``: several frequencies at once, as tones or over a band."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

from undulog.capture.commands.sessions import CONTRACT, JointTopicOptions
from undulog.capture.common.errors import UsageError

from .plan import AMPLITUDE, Planned, check_tones, settling, without_contact, write_sessions

if TYPE_CHECKING:
    from undulog.capture import SessionView

    from ..plan.gait_base import BaseGait

_MOST_RUNS = 1000


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class BandOptions:
    """Random-phase multisines over a band.

    Attributes:
        period: After which the commands repeat [s]; the lines are multiples of its reciprocal.
        periods: Steady periods that are measured, after the settling time.
        realisations: Of the random phases.
        amplitude_is: Whether `--amplitude` is each command's root mean square or the largest peak.
        inputs: `same`: all joints have one command; `orthogonal`: each has its own in as many
            runs a realisation as joints are driven, which identify the response of every joint to
            every command.
        joint: Joints to drive, each named by an option of its own; those that the session drives
            if none is named.
        seed: Of the random numbers.
    """

    period: float = 10.0
    periods: int = 2
    realisations: int = 10
    amplitude_is: Literal["rms", "peak"] = "rms"
    inputs: Literal["same", "orthogonal"] = "same"
    joint: tuple[str, ...] = ()
    seed: int = 1


_DEFAULT = BandOptions()


def multisine(
    *,
    like: Path,
    output: Annotated[Path, Parameter(name=["--output", "-o"])],
    amplitude: float = AMPLITUDE,
    tones: int | None = None,
    band: tuple[float, float] | None = None,
    options: BandOptions = _DEFAULT,
    runs: int = 1,
    settle: float | None = None,
    measure: float | None = None,
    topics: JointTopicOptions = CONTRACT,
    json: bool = False,
) -> None:
    """Write the commands of multisines: many frequencies at once.

    With `--band`: odd random-phase multisines, which give the best linear approximation of each
    joint's response, with noise and nonlinear distortion apart. A period to settle, two that are
    measured, ten realisations of the phases. The joints stay around their offsets in that session.

    Example: `undulog plan multisine --like run.mcap --band 0.1 5 -o band`

    Without: coupling without contact at a few tones. As many runs as joints are driven; in each
    all joints move at all tones, with the phases of a DFT over the runs. The first tone is the
    gait's frequency, and none is another plus a whole number of the gait's, so that what a
    nonlinearity mixes shows beside the tones.

    Example: `undulog plan multisine --like run.mcap -o tones`

    Args:
        like: A session of a gait: its joints, offsets and frequency; with `--band` of any commands.
        output: Folder for the sessions.
        amplitude: Of the first tone of every command [rad]; the others fall with the square of
            the frequency, so that all of them need about the same torque. With `--band` of the
            whole command.
        tones: How many, 3 if not given.
        band: Lowest and highest frequency [Hz].
        runs: How often each of them is run.
        settle: Time before what is measured [s]; 5 time constants of the slowest body mode, at
            least 10 s, if not given; with `--band` one period.
        measure: Length of what is measured [s], rounded up to whole periods; 20 if not given.
        topics: Where commands and responses of that session are.
        json: Print one JSON object.
    """
    check_tones(amplitude, runs)
    if band is not None:
        if tones is not None or measure is not None:
            raise UsageError("--band takes --period and --periods; leave out --tones and --measure")
        numbers = (amplitude, runs, settle)
        _write_band(like, output, band, options, numbers=numbers, topics=topics, as_json=json)
        return
    if options != _DEFAULT:
        given = [one.name for one in fields(options) if getattr(options, one.name) != one.default]
        names = ", ".join(f"--{name.replace('_', '-')}" for name in given)
        raise UsageError(f"{names}: only with --band, the lowest and the highest frequency")
    tones = 3 if tones is None else tones
    if tones < 2:
        raise UsageError("--tones is at least 2; for one frequency there is plan lag-sweep")

    def design(base: BaseGait, session: SessionView) -> Planned:
        from ..plan import designs

        omega = designs.tones(base.omega, tones)
        planned = designs.multisine(len(base.driven), amplitude, omega, runs)
        period = designs.period_s(base.omega, tones)
        whole_s = math.ceil((20.0 if measure is None else measure) / period - 1e-6) * period
        return without_contact(base, session, planned, (amplitude, settle, whole_s))

    write_sessions("multisine", like, output, design, topics, as_json=json)


def _write_band(
    like: Path,
    output: Path,
    band_hz: tuple[float, float],
    options: BandOptions,
    *,
    numbers: tuple[float, int, float | None],
    topics: JointTopicOptions,
    as_json: bool,
) -> None:
    """Write odd random-phase multisines over a band."""
    from ..plan.random_phase import odd_lines, random_phase_runs

    amplitude, repeats, settle_s = numbers
    if options.periods < 1 or options.realisations < 1 or options.seed < 0:
        raise UsageError("--periods and --realisations are at least 1, --seed at least 0")
    if not math.isfinite(amplitude):
        raise UsageError("--amplitude is a finite number")
    lines = odd_lines(band_hz, options.period, options.seed)
    settle_s = options.period if settle_s is None else settle_s
    if not 0 <= settle_s < math.inf:
        raise UsageError("--settle is at least 0")

    def base_of(session: SessionView) -> BaseGait:
        from ..plan.gait_base import base_pose

        return base_pose(session, options.joint or None, 2 * math.pi / options.period)

    def design(base: BaseGait, session: SessionView) -> Planned:
        m = len(base.driven)
        count = options.realisations * repeats * (m if options.inputs == "orthogonal" else 1)
        if count > _MOST_RUNS:
            raise UsageError(
                f"{count} runs for {m} joints, at most {_MOST_RUNS}; take fewer --realisations or "
                "name joints by --joint"
            )
        shared, planned = random_phase_runs(
            m,
            lines,
            options.period,
            amplitude,
            of_peak=options.amplitude_is == "peak",
            realisations=options.realisations,
            inputs=options.inputs,
            seed=options.seed,
        )
        facts = {
            "period_s": f"{options.period:.12g}",
            "periods": str(options.periods),
            "lines": " ".join(map(str, shared.lines.tolist())),
            "realisations": str(options.realisations),
            "inputs": options.inputs,
            "rms_rad": f"{shared.rms:.6g}",
            "peak_rad": f"{shared.peak:.6g}",
            "seed": str(options.seed),
        }
        low, high = (line / options.period for line in (shared.lines[0], shared.lines[-1]))
        size = f"{shared.rms:.3g} rad RMS, peak {shared.peak:.3g} rad"
        notes = [f"{shared.lines.size} lines from {low:.4g} to {high:.4g} Hz, {size}"]
        needed_s, mode = settling(base, session)
        if mode and settle_s < needed_s:
            notes.append(
                f"Warning: without contact the slowest body mode needs {needed_s:g} s to settle; "
                f"{settle_s:g} s is less (--settle)"
            )
        if min(options.periods, options.realisations) < 2:
            notes.append(
                "Warning: one period or one realisation: distortion is not separable from noise"
            )
        measure_s = options.periods * options.period
        result = {"lines": shared.lines.tolist(), "period_s": options.period}
        return Planned(planned * repeats, settle_s, measure_s, facts, tuple(notes), result)

    write_sessions("multisine", like, output, design, topics, as_json=as_json, base_of=base_of)
