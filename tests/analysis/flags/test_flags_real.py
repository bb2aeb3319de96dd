"""A real joint whose reader was at fault: ArcSnake's joint 7, by both of its positions."""

import math
from pathlib import Path

import numpy as np
import pytest

from analysis.analyse import analyse_session
from analysis.stretch import Options
from capture import Session, SessionWriter

ARCSNAKE = Path(__file__).parents[3].parent / "shared" / "data" / "arcsnake"
EPOCH_NS = 1_735_689_600_000_000_000
GEAR = 22
RUNS = [
    ("joint7_no_load.csv", 10.25),
    ("joint7_load_jointonly.csv", 10.25),
    ("joint7_load_fullsegment_amp0.2pi.csv", 16.35),
]


def session_of(name, path):
    """The joint's angle by its motor (wrapped and unwrapped) and as its reader told it."""
    if not ARCSNAKE.exists():
        pytest.skip(f"the ArcSnake data are not at {ARCSNAKE}")
    raw = np.genfromtxt(ARCSNAKE / name, delimiter=",", names=True)
    channels = {
        "/wrapped": raw["s_pos"],
        "/motor": np.unwrap(raw["s_pos"], period=4 * math.pi) / GEAR,
        "/reader": raw["m_pos"] / GEAR,
    }
    with SessionWriter(path, session_id=name, epoch_ns=EPOCH_NS) as writer:
        opened = {t: writer.joint_state(t, ["joint7"], unit="rad", velocity=True) for t in channels}
        for k, t in enumerate(raw["time"]):
            t_ns = EPOCH_NS + round(t * 1e9)
            for topic, values in channels.items():
                opened[topic].write(t_ns, values[k : k + 1], raw["speed"][k : k + 1])
    return path


@pytest.mark.slow
@pytest.mark.parametrize(("name", "period"), RUNS)
def test_the_fault_of_the_reader_is_the_sensor_s(name, period, tmp_path):
    path = session_of(name, tmp_path / "joint7.mcap")

    def analysed(topic, reference=None):
        with Session.open(path) as session:
            options = Options(response_topic=topic, reference_topic=reference)
            return analyse_session(session, options)

    def of_sensors(result):
        return [one for one in result.artefacts if one.about == "sensor"]

    motor = analysed("/motor", "/motor")
    assert of_sensors(motor) == []
    assert motor.gait.frequency_hz.value == pytest.approx(1 / period, rel=0.01)

    (found,) = of_sensors(analysed("/reader", "/motor"))
    assert (found.flag, found.quantity) == ("scale_mismatch", "position")
    assert found.topic == "/reader"
    told = float(found.note.split(" ")[0])
    assert 0.87 < told < 0.91  # it tells about 10 % too little
    (first, last) = found.spans_s[0][0], found.spans_s[-1][1]
    with Session.open(path) as session:
        assert last - first > 0.95 * session.duration_s

    (found,) = of_sensors(analysed("/wrapped"))
    assert (found.flag, found.note) == ("wrapped", "turn of 12.57 rad")
    assert len(found.spans_s) >= 10
