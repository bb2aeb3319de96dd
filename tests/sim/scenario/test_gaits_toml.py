"""The [gait] table: read strictly, every fault at once, and written back whole."""

import math
import tomllib

import pytest
import tomlkit
from hypothesis import given, settings
from hypothesis import strategies as st

from support.twin_runs import SNAKE13, check_keys, faults_of
from undulog.capture import load_robot
from undulog.capture.common.strict_table import Faults, StrictTable
from undulog.capture.robot.model import Plane
from undulog.sim import PlaneGait, Readings, Serpentine, Wave, parse_scenario
from undulog.sim.gait.delay_blocks import DelayBlocks, DelayLine
from undulog.sim.gait.oscillators import OscillatorChain, OscillatorChains, OscillatorKind
from undulog.sim.scenario.motion import gait_table, generator, read_gait

ROBOT = load_robot("snake13")  # 6 joints in each plane


def within(least, most):
    """A number as a file can have it: 0, or not much smaller than any length of the robot."""
    return st.floats(least, most).map(lambda number: 0.0 if abs(number) < 1e-12 else number)


positive = st.floats(1e-3, 25.0)
angle = within(-10.0, 10.0)
common = {
    "amplitude": st.floats(1e-3, 2.0),
    "frequency_hz": positive,
    "wave": st.sampled_from(Wave),
    "offset": angle,
    "phase": angle,
}


def numbers(count, most=100.0):
    number = within(-most, most)
    return number | st.lists(number, min_size=count, max_size=count).map(tuple)


def planes(part):
    return st.dictionaries(st.sampled_from(Plane), part, min_size=1).map(
        lambda waves: {plane: waves[plane] for plane in Plane if plane in waves}
    )


rate = st.floats(1e-3, 100.0)
chain = {
    **common,
    "lag": within(0.0, 7.0),
    "forward": numbers(5),
    "backward": numbers(5),
    "detuning": numbers(6),
    "start_phase": numbers(6),
    "approach_rate": rate,
    "feedback": within(0.0, 100.0),
    "feedback_bias": numbers(6),
    "kick_every_s": within(0.0, 10.0),
    "kick_size": within(0.0, 7.0),
    "kick_seed": st.integers(0, 2**31),
}
hopf = {"oscillator": st.just(OscillatorKind.HOPF), "attraction": rate}
hopf_chains = st.builds(OscillatorChain, **chain, **hopf)
ramp = within(0.0, 10.0)
gaits = st.one_of(
    st.builds(Serpentine, planes(st.builds(PlaneGait, **common, lag=within(0.0, 7.0))), ramp),
    st.builds(DelayBlocks, planes(st.builds(DelayLine, **common, delay_s=within(0.0, 10.0))), ramp),
    st.builds(OscillatorChains, planes(st.builds(OscillatorChain, **chain) | hopf_chains)),
)


def read(text, robot=ROBOT):
    faults = Faults()
    gait = read_gait(StrictTable(tomllib.loads(text), "gait", faults), robot)
    return gait, {fault.key: str(fault) for fault in faults.all()}


@pytest.mark.nightly
@given(gait=gaits)
@settings(max_examples=200, deadline=None)
def test_whatever_is_written_reads_back_the_same(gait):
    assert read(tomlkit.dumps(gait_table(gait))) == (gait, {})


@given(gait=gaits)
@settings(max_examples=30, deadline=None)
def test_whatever_can_be_read_can_be_run(gait):
    run = generator(gait, ROBOT)
    lower, upper = ROBOT.limits()
    for k in range(3):
        tick = run.step(k / 100, Readings.nothing(ROBOT))
        assert len(tick.values) == len(run.names)
        assert ((tick.command >= lower) & (tick.command <= upper)).all()


def test_the_defaults_are_those_of_the_manual():
    gait, faults = read(f'kind = "oscillators"\n{WAVE}lag = 0.5\n')
    assert (gait.planes, faults) == ({Plane.VERTICAL: OscillatorChain(0.3, 0.5, 0.5)}, {})
    wave = gait.planes[Plane.VERTICAL]
    assert (wave.oscillator, wave.forward, wave.backward) == ("phase", 5.0, 5.0)
    assert (wave.approach_rate, wave.attraction, wave.feedback) == (4.0, 5.0, 0.0)
    gait, _ = read(f'kind = "delay-blocks"\n{WAVE}delay_s = 0.1\n')
    assert gait == DelayBlocks({Plane.VERTICAL: DelayLine(0.3, 0.5, 0.1)}, 2.0)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (
            """
            kind = "delay-blocks"
            ramp_s = -1
            [horizontal]
            amplitude = -0.1
            frequency_hz = 26
            delay_s = 11
            lag = 0.5
            """,
            "ramp_s amplitude frequency_hz delay_s lag",
        ),
        (
            """
            kind = "oscillators"
            ramp_s = 1.0
            [horizontal]
            amplitude = 0
            frequency_hz = 0.5
            lag = -1
            oscillator = "phase"
            attraction = 1.0
            forward = [1, 2, 3]
            backward = [1, 2, 101, 4, nan]
            detuning = "fast"
            start_phase = [0, 0, 0, 0, 0, "x"]
            approach_rate = 0
            feedback = 1.0
            feedback_bia = 0.1
            """,
            (
                "ramp_s amplitude lag attraction forward backward[2] backward[4] detuning "
                "start_phase[5] approach_rate feedback_bia"
            ),
        ),
        ('kind = "serpentin"\n[horizontal]\nlag = 1.0', "kind"),
        ('kind = "oscillators"', "horizontal"),
        ('kind = "oscillators"\nhorizontal = 3', "horizontal amplitude frequency_hz lag"),
    ],
)
def test_all_faults_are_listed_at_once(text, expected):
    _, faults = read(text)
    check_keys({key.removeprefix("gait.").removeprefix("horizontal.") for key in faults}, expected)
    if text.endswith("horizontal = 3"):
        assert "a table" in faults["gait.horizontal"]


WAVE = "[vertical]\namplitude = 0.3\nfrequency_hz = 0.5\n"


@pytest.mark.parametrize(
    ("text", "key", "complaint"),
    [
        ('kind = "oscilators"', "kind", "did you mean oscillators?"),
        (f"{WAVE}forward = [1, 2]", "vertical.forward", "an array of 2"),
        (f"{WAVE}forward = [1, 2]", "vertical.forward", "a number, or an array of 5"),
        (f"{WAVE}backward = -200", "vertical.backward", ">= -100 and <= 100"),
        (f"{WAVE}feedback_bias = true", "vertical.feedback_bias", "a finite number"),
    ],
)
def test_faults_give_what_would_be_right(text, key, complaint):
    kind = "" if text.startswith("kind") else 'kind = "oscillators"\n'
    _, faults = read(f"{kind}{text}\nlag = 0")
    assert complaint in faults[f"gait.{key}"]


def test_a_plane_that_the_robot_lacks():
    _, faults = read(f'kind = "delay-blocks"\n{WAVE}delay_s = 0', load_robot("snake13-planar"))
    assert "snake13-planar has no vertical joints" in faults["gait.vertical"]


def test_a_whole_scenario_names_the_gaits_faults_among_others():
    text = SNAKE13.replace("2.0", "-1").replace("[gait", '[gait]\nkind = "oscillators"\n[gait')
    check_keys(faults_of(f"{text}detuning = [1.0]"), "duration_s gait.horizontal.detuning")


def test_a_scenario_of_each_kind_reads_back():
    head = 'description = "x"\nrobot = "snake13"\nduration_s = 1\n[gait]\n'
    wave = "[gait.horizontal]\namplitude = 0.3\nfrequency_hz = 0.5\n"
    for kind, rest in (
        ("serpentine", "lag = 0.5"),
        ("delay-blocks", "delay_s = 0.1"),
        ("oscillators", f"lag = 0.5\nstart_phase = [0, 1, 0, 0, 0, {math.pi}]"),
    ):
        scenario = parse_scenario(f'{head}kind = "{kind}"\n{wave}{rest}', "x.toml")
        assert parse_scenario(scenario.toml(), "y.toml").gait == scenario.gait
