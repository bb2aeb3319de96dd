"""Tables of sessions without one steady gait: gaits, frequency responses, tracking, free motion."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

from ..common.estimate import Estimate
from ..common.formats import degrees, scaled
from ..parts.free_motion.result import BodyWave, JointMotion, LocalWaveNumber
from ..parts.frequency_response.result import DIRECT, JointFrequencyResponse
from ..parts.gaits.result import GaitWindow
from ..parts.shown import Column, Ends, ShownNumber, Table, typical
from ..parts.tracking.result import JointTracking


def frequency_table(responses: Sequence[JointFrequencyResponse]) -> Table[JointFrequencyResponse]:
    """Return frequency responses in short: band, bandwidth, delay, distortion, repeatability."""

    def at_lowest(response: JointFrequencyResponse) -> Estimate:
        return Estimate(response.gain[0], response.gain_ci95[0])

    def agree(response: JointFrequencyResponse) -> str | None:
        return None if response.halves_agree is None else "{} of {}".format(*response.halves_agree)

    def model(response: JointFrequencyResponse) -> str:
        return (
            "group delay"
            if response.delay_model is None
            else "model {}/{}".format(*response.delay_model)
        )

    def excitation(response: JointFrequencyResponse) -> str:
        return (
            response.excitation
            if response.method == DIRECT
            else f"{response.excitation}, {response.method}"
        )

    def distortion(response: JointFrequencyResponse) -> Estimate:
        return scaled(Estimate(response.distortion), 100.0)

    columns: list[Column[JointFrequencyResponse]] = [
        Column("joint", "joint", lambda response: response.joint, kind="word"),
        Column("command", "command", excitation, kind="word", spare=2),
        Column("from Hz", "from [Hz]", lambda response: response.frequency_hz[0], (3, 4)),
        Column("to Hz", "to [Hz]", lambda response: response.frequency_hz[-1], (2, 3)),
        Column("gain there (95 %)", "gain at the lowest [1]", at_lowest, typical(4, 4)),
        Column("-3 dB Hz", "-3 dB [Hz]", lambda response: Estimate(response.bandwidth_hz), (2, 3)),
        Column(
            "delay ms (95 %)",
            "delay [ms]",
            lambda response: scaled(response.delay_s, 1e3),
            typical(2, 3),
        ),
        Column("is", "delay is", model, kind="word", spare=4),
        Column("distortion %", "distortion [%]", distortion, (2, 2), spare=3),
        Column("halves agree", "halves agree", agree, kind="word", spare=1),
    ]
    about = {
        "delay [ms]": "with the offset of the clocks",
        "distortion [%]": "nonlinear, of the response; a dash where it can't be separated from "
        "noise",
    }
    return Table(columns, responses, about=about)


def tracking_table(joints: Sequence[JointTracking]) -> Table[JointTracking]:
    """Return gain, lag and offset by joint."""

    def model(joint: JointTracking) -> str:
        poles = ("delay", "delay and a pole", "delay and two poles")[joint.poles]
        return f"{poles}, held" if joint.held else poles

    columns: list[Column[JointTracking]] = [
        Column("joint", "joint", lambda joint: joint.joint, kind="word"),
        Column("gain (95 %)", "gain [1]", lambda joint: joint.gain, typical(2, 4)),
        Column("lag ms (95 %)", "lag [ms]", lambda joint: scaled(joint.lag_s, 1e3), typical(2, 3)),
        Column(
            "offset deg (95 %)",
            "offset [deg]",
            lambda joint: degrees(joint.offset_rad),
            typical(2, 3),
        ),
        Column("model", "model", model, kind="word", spare=3),
        Column(
            "explained %", "explained [%]", lambda joint: 100 * joint.explained, (1, 2), spare=2
        ),
    ]
    about = {
        "gain [1]": "of slow motion, response over command",
        "lag [ms]": "of slow motion: delay and time constants, with the offset of the clocks",
        "offset [deg]": "mean of the position less that of the delayed command",
        "model": "what explains the motion; held: each command holds until the next",
    }
    return Table(columns, joints, about=about)


def gait_table(gaits: Sequence[GaitWindow]) -> Table[GaitWindow]:
    """Return the gaits of a session whose gait changes, a row each."""

    def gains(gait: GaitWindow) -> Ends | None:
        return _ends([joint.gain for joint in gait.joints], 3)

    def lags(gait: GaitWindow) -> Ends | None:
        return _ends([degrees(joint.lag_rad) for joint in gait.joints], 1)

    columns: list[Column[GaitWindow]] = [
        Column("gait from s", "from [s]", lambda gait: gait.start_s, (2, 2)),
        Column("to s", "to [s]", lambda gait: gait.stop_s, (2, 2)),
        Column("Hz (95 %)", "frequency [Hz]", lambda gait: gait.frequency_hz, typical(3, 4)),
        Column("cycles", "cycles", lambda gait: gait.cycles, (1, 1), spare=1),
        Column("wave", "wave", lambda gait: gait.wave, kind="word"),
        Column("gains", "gain, all joints [1]", gains),
        Column("lags °", "lag, all joints [°]", lags),
    ]
    return Table(columns, gaits)


def gait_joint_table(gaits: Sequence[GaitWindow]) -> Table[str]:
    """Return gain and lag of each joint in each gait, a row a joint; for the page."""
    joints = [{joint.joint: joint for joint in gait.joints} for gait in gaits]
    names = list(dict.fromkeys(name for by_name in joints for name in by_name))

    def gain(gait: int) -> Callable[[str], Estimate | None]:
        return lambda name: joints[gait][name].gain if name in joints[gait] else None

    def lag(gait: int) -> Callable[[str], Estimate | None]:
        return lambda name: degrees(joints[gait][name].lag_rad) if name in joints[gait] else None

    columns: list[Column[str]] = [Column("joint", "joint", lambda name: name, kind="word")]
    for k, gait in enumerate(gaits):
        when = f"{gait.start_s:.0f} to {gait.stop_s:.0f} s"
        columns += [
            Column(None, f"gain, {when} [1]", gain(k), typical(3, 4)),
            Column(None, f"lag, {when} [°]", lag(k), typical(2, 3)),
        ]
    return Table(columns, names)


def _ends(estimates: Sequence[Estimate], decimals: int) -> Ends | None:
    """Return the lowest and the highest value, or None where there is none."""
    values = [estimate.value for estimate in estimates if estimate.value is not None]
    if not values:
        return None
    return Ends(*(ShownNumber(Estimate(end), decimals) for end in (min(values), max(values))))


def motion_table(motions: Sequence[JointMotion]) -> Table[JointMotion]:
    """Return amplitude, offset and lag of joints that move without commands."""
    with_planes = any(motion.plane for motion in motions)
    angle, lag = typical(2, 4), "lag behind the one before"
    columns: list[Column[JointMotion]] = [
        Column("joint", "joint", lambda motion: motion.name, kind="word"),
        *(
            [Column("plane", "plane", lambda motion: motion.plane, kind="word")]
            if with_planes
            else []
        ),
        Column(
            "amplitude° (95 %)",
            "amplitude [°]",
            lambda motion: degrees(motion.amplitude_rad),
            angle,
        ),
        Column(
            "offset° (95 %)",
            "offset [°]",
            lambda motion: degrees(motion.offset_rad),
            angle,
            spare=1,
        ),
        Column(f"{lag}° (95 %)", f"{lag} [°]", lambda motion: degrees(motion.lag_rad), angle),
    ]
    return Table(columns, motions)


def local_waves_table(waves: Sequence[BodyWave]) -> Table[LocalWaveNumber]:
    """Return wave numbers between neighbouring joints, of waves whose phases are on no line."""
    columns: list[Column[LocalWaveNumber]] = [
        Column("from", "from", lambda part: part.joint, kind="word"),
        Column("to", "to", lambda part: part.next_joint, kind="word"),
        Column(
            "°/joint (95 %)",
            "local wave number [°/joint]",
            lambda part: degrees(part.wave_number),
            typical(2, 4),
        ),
    ]
    about = {
        "local wave number [°/joint]": "lag of a joint behind the one before it, over the joints "
        "between them; of phases that are on no line"
    }
    return Table(columns, [part for wave in waves for part in wave.local], about=about)


def wave_table(waves: Sequence[BodyWave]) -> Table[BodyWave]:
    """Return the waves along the body, one a plane."""

    def way(wave: BodyWave) -> str:
        first, last = wave.joints[0], wave.joints[-1]
        if wave.direction == "undecided":
            return f"undecided, {first} and {last}"
        return f"{first} to {last}" if wave.direction == "first-to-last" else f"{last} to {first}"

    def off(wave: BodyWave) -> float:
        return math.degrees(wave.deviation_rad)

    with_planes = any(wave.plane for wave in waves)
    angle, share = typical(2, 4), typical(3, 4)
    columns: list[Column[BodyWave]] = [
        *([Column("plane", "plane", lambda wave: wave.plane, kind="word")] if with_planes else []),
        Column("wave", "wave", way, kind="word"),
        Column(
            "°/joint (95 %)", "wave number [°/joint]", lambda wave: degrees(wave.wave_number), angle
        ),
        Column("waves (95 %)", "waves", lambda wave: wave.waves, share),
        Column("joints/s (95 %)", "speed [joints/s]", lambda wave: wave.speed, typical(2, 3)),
        Column("m/s", "speed [m/s]", lambda wave: wave.speed_m_s, share, spare=1),
        Column(
            "travelling (95 %)", "travelling index [1]", lambda wave: wave.travelling_index, share
        ),
        Column("off the line°", "off the line [°]", off, (1, 2), spare=2),
    ]
    about = {
        "wave number [°/joint]": "lag from joint to joint, of a line through the phases",
        "travelling index [1]": "1 of a travelling, 0 of a standing wave",
        "off the line [°]": "root mean square of the phases about the line",
    }
    return Table(columns, waves, about=about)
