"""CSV logs by a column map: real joint recordings, and every kind of fault."""

import math
import re

import numpy as np
import pytest

from support.imported import open_mapped
from support.paths import ARCSNAKE
from undulog.capture import Session, load_robot
from undulog.capture.common.errors import FaultyFileError, ImportFormatError, UsageError
from undulog.capture.common.process import StopRequest
from undulog.capture.exchange import column_map
from undulog.capture.exchange.frame_log import RELATIVE_EPOCH_NS
from undulog.capture.exchange.registry.registry import format_of
from undulog.capture.exchange.table_import import import_tables

GEAR = 22
JOINT7 = f"""
[time]
column = "time"
unit = "s"

[[columns]]
column = "s_pos"
joint = "joint01"
quantity = "position"
unit = "rad"
wrap = {4 * math.pi!r}
scale = {1 / GEAR!r}

[[columns]]
column = "torque"
joint = "joint01"
quantity = "current"
unit = "A"
"""


def load(source, tmp_path):
    (tmp_path / "map.toml").write_text(JOINT7)
    robot = load_robot("arcsnake-joint")
    columns = column_map.read_column_map(tmp_path / "map.toml", robot)
    tables = open_mapped(source, columns)
    return import_tables(tables, tmp_path / "run.mcap", robot=robot, column_map=columns)


@pytest.mark.skipif(not ARCSNAKE.exists(), reason=f"the ArcSnake data are not at {ARCSNAKE}")
@pytest.mark.parametrize(
    ("name", "period", "amplitude"),
    [
        ("joint7_no_load.csv", 10.25, 0.3 * math.pi),
        ("joint7_load_jointonly.csv", 10.25, 0.3 * math.pi),
        ("joint7_load_fullsegment_amp0.2pi.csv", 16.35, 0.2 * math.pi),
    ],
)
def test_the_arcsnake_joint_becomes_a_smooth_slow_sine(name, period, amplitude, tmp_path):
    raw = np.genfromtxt(ARCSNAKE / name, delimiter=",", names=True)
    assert np.abs(np.diff(raw["s_pos"])).max() > 12  # it does wrap around
    report = load(ARCSNAKE / name, tmp_path)
    assert report.verdict == "good"
    with Session.open(report.output) as session:
        angle = session.joints("/joint_states").signal("joint01")
        current = session.joints("/joint_current").signal("joint01")
        assert session.attachments["columns.toml"].decode().startswith('delimiter = ","')
    np.testing.assert_array_equal(angle.t_ns - RELATIVE_EPOCH_NS, np.rint(raw["time"] * 1e9))
    np.testing.assert_allclose(current.values, raw["torque"])
    # Smooth: no step is more than the joint can do in one sample, and the sine that the authors
    # drove (its amplitude is in a file's name) is all but 0.2 % of the variance.
    assert np.abs(np.diff(angle.values)).max() < 0.01
    t = (angle.t_ns - angle.t_ns[0]) * 1e-9
    wave = [np.sin(2 * np.pi * t / period), np.cos(2 * np.pi * t / period)]
    parts, (misfit,), *_ = np.linalg.lstsq(np.stack([t**0, t, *wave], axis=1), angle.values)
    assert misfit < 0.002 * np.var(angle.values) * len(t)
    assert np.hypot(*parts[2:]) == pytest.approx(amplitude, rel=0.005)
    # Whole periods of the wrap, and nothing else, were added to the cells.
    added = (angle.values * GEAR - raw["s_pos"]) / (4 * np.pi)
    np.testing.assert_allclose(added, np.rint(added), atol=1e-9)


def csv_file(tmp_path, text):
    path = tmp_path / "log.csv"
    path.write_text(text)
    return path


def run(tmp_path, text, *options, time="s", **more):
    robot = load_robot("snake13")
    columns = column_map.column_map_from_options((f"t=time:{time}", *options), robot)
    tables = open_mapped(csv_file(tmp_path, text), columns)
    return import_tables(tables, tmp_path / "run.mcap", robot=robot, column_map=columns, **more)


def test_columns_of_several_joints_and_quantities(tmp_path):
    report = run(
        tmp_path,
        "t,a2,a1,v2,cmd,T\n0.00,20,10,1,5,293.15\n0.01,,11,,6,\n0.02,,,,7,294.15\n",
        "a2=joint02.position:deg",
        "a1=joint01.position:deg,scale=-2,offset=1",
        "v2=joint02.velocity:rpm",
        "cmd=joint03.command:deg",
        "T=joint02.temperature:K",
    )
    assert report.samples == {"/joint_commands": 3, "/joint_states": 2, "/joint_temperature": 2}
    missing = {"a2": 2, "a1": 1, "v2": 2, "T": 1}
    assert report.notes == [f"column {c!r}: {n} cells without a value" for c, n in missing.items()]
    with Session.open(tmp_path / "run.mcap") as session:
        states = session.joints("/joint_states")
        assert states.names == ("joint01", "joint02")
        np.testing.assert_allclose(states.values[0], np.radians([-19, -21]))
        np.testing.assert_allclose(states.values[1], [math.radians(20)])  # no cell, no sample
        velocity = session.joints("/joint_states", "velocity")
        np.testing.assert_allclose(velocity.values[1], [2 * math.pi / 60])
        assert np.isnan(velocity.values[0]).all()
        temperature = session.joints("/joint_temperature").signal("joint02")
        np.testing.assert_allclose(temperature.values, [20, 21])
        assert (temperature.t_ns - RELATIVE_EPOCH_NS).tolist() == [0, 20_000_000]
        assert session.joints("/joint_commands").names == ("joint03",)


def test_velocity_without_position_has_its_own_topic(tmp_path):
    assert run(tmp_path, "t,v\n0,1\n", "v=joint01.velocity:rad/s").samples == {"/joint_velocity": 1}


def test_unix_times_are_kept_to_the_nanosecond(tmp_path, opened):
    run(tmp_path, "t,a\n1717639553.000000123,1\n1717639553.000000124,1\n", "a=joint01.position:rad")
    t_ns = opened(tmp_path / "run.mcap").joints("/joint_states").t_ns[0].tolist()
    assert t_ns == [1717639553_000000123, 1717639553_000000124]


def test_unwrapping_passes_over_gaps(tmp_path, opened):
    run(tmp_path, "t,a\n0,170\n1,\n2,-170\n3,-150\n", "a=joint01.position:deg,wrap=360,scale=0.5")
    values = opened(tmp_path / "run.mcap").joints("/joint_states").values[0]
    np.testing.assert_allclose(np.degrees(values[~np.isnan(values)]), [85, 95, 105])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("t,a\n0,1\n1,x\n", "log.csv: row 3, column 'a': 'x' is not a number"),
        ("t,a\n0,1\n1,inf\n", "log.csv: row 3, column 'a': 'inf' is not a finite number"),
        ("t,a\nnow,1\n", "log.csv: row 2, column 't': 'now' is not a time"),
        ("t,a\nnan,1\n", "log.csv: row 2, column 't': 'nan' is not a time"),
        ("t,a\n1,1\n0.5,1\n", "log.csv: row 3, column 't': time goes back, from 1"),
        ("t,a\n0,1,2\n", "log.csv: row 2 has 3 cells, the header 2"),
        ("t,A1,b\n0,1,2\n", "log.csv: has no column 'a'; it has t, A1, b"),
        ("t,a,a\n0,1,2\n", "log.csv: has 2 columns 'a'; it has t, a, a"),
        ("t,a\n", "log.csv: has no rows below its header"),
        ("", "log.csv: is no table: it is empty"),
    ],
)
def test_faults_of_a_log_name_file_row_and_column(text, message, tmp_path):
    with pytest.raises(ImportFormatError, match=re.escape(message)):
        run(tmp_path, text, "a=joint01.position:rad")
    assert not (tmp_path / "run.mcap").exists()


@pytest.mark.parametrize("line", [3, 60, 17_000])
@pytest.mark.parametrize(
    ("cells", "message"),
    [
        ("{t},x", "column 'a': 'x' is not a number"),
        ("{t},1e300", "column 'a': '1e+300' is not a finite number, or beyond 1e+200"),
        ("now,1", "column 't': 'now' is not a time"),
        ("-1,1", "column 't': time goes back, from"),
        ("{t},1,2", "has 3 cells, the header 2"),
    ],
)
def test_a_fault_names_its_row_wherever_it_is(line, cells, message, tmp_path):
    rows = [f"{k},{k % 7}" for k in range(1, 17_100)]
    rows[line - 2] = cells.format(t=line - 1)
    text = "t,a\n" + "\n".join(rows) + "\n"
    with pytest.raises(ImportFormatError, match=rf"row {line}[ ,].*{re.escape(message)}"):
        run(tmp_path, text, "a=joint01.position:rad")


def test_columns_that_a_map_names_are_taken_as_they_are(tmp_path, opened):
    """Not as those of a long table, nor as tracks; a column without a name doesn't matter."""
    text = "".join(f"{k},{k / 10},1,{k},{k + 1}\n" for k in range(6))
    given = ("a_x=joint01.position:rad", "id=joint02.position:rad")
    run(tmp_path, f",t,id,a_x,a_y\n{text}", *given)
    states = opened(tmp_path / "run.mcap").joints("/joint_states")
    np.testing.assert_array_equal(states.values, [[1.0] * 6, np.arange(6.0)][::-1])


def test_numbers_are_read_to_the_last_bit(tmp_path, opened):
    rng = np.random.default_rng(2)
    numbers = rng.integers(0, 2**63, 5000, dtype=np.int64).view(np.float64)
    numbers = numbers[np.abs(numbers) < 1e200]  # all other bits: exponents from -323 on
    text = "".join(f"{k},{value!r}\n" for k, value in enumerate(numbers.tolist()))
    run(tmp_path, f"t,a\n{text}", "a=joint01.position:rad")
    values = opened(tmp_path / "run.mcap").joints("/joint_states").values[0]
    np.testing.assert_array_equal(values, numbers)


def test_all_faults_of_a_map_are_listed(tmp_path):
    (tmp_path / "map.toml").write_text(MAP)
    with pytest.raises(FaultyFileError) as caught:
        column_map.read_column_map(tmp_path / "map.toml", load_robot("arcsnake-joint"))
    assert [str(fault) for fault in caught.value.faults] == MAP_FAULTS.splitlines()


MAP = """
delimiter = "|"
[time]
column = "t"
unit = "min"
[[columns]]
column = "a"
joint = "joint99"
quantity = "positon"
unit = "deg"
[[columns]]
column = "b"
joint = "joint01"
quantity = "velocity"
unit = "deg"
wrap = -1
gain = 2
"""
MAP_FAULTS = r"""delimiter: found "|"; valid: "," ";" "\t" " "
time.unit: found "min"; valid: s, ms, us, ns
columns[0].joint: found "joint99"; valid: joint01 (did you mean joint01?)
columns[0].quantity: found "positon"; valid: command, position, velocity, effort, current, voltage, temperature (did you mean position?)
columns[1].unit: found "deg"; valid: for velocity: rad/s, deg/s, rev/s, rpm (did you mean deg/s?)
columns[1].wrap: found -1; valid: a finite number > 0
columns[1].gain: found an unknown key; valid: column, joint, quantity, unit, table, wrap, scale, offset
"""  # noqa: E501  a fault is a line


@pytest.mark.parametrize(
    ("option", "message"),
    [
        ("a", "--map 'a' is not of the form COLUMN=time:UNIT or COLUMN=JOINT.QUANTITY:UNIT"),
        ("a=joint01:rad", "is not of the form"),
        ("a=joint01.position", "is not of the form"),
        ("a=joint01.position:rad,wrap", "'wrap' is not KEY=NUMBER"),
        ("a=joint01.position:rad,wrap=x", "'wrap=x' is not KEY=NUMBER"),
        ("a=joint1.position:rad", 'columns[0].joint: found "joint1"'),
        ("a=joint01.position:m", 'columns[0].unit: found "m"; valid: for position: rad'),
        ("a=joint01.range:m", 'columns[0].quantity: found "range"'),
    ],
)
def test_faults_of_options(option, message):
    with pytest.raises(UsageError, match=re.escape(message)):
        column_map.column_map_from_options(("t=time:s", option), load_robot("snake13"))


def test_options_and_file_say_the_same(tmp_path):
    robot = load_robot("snake13")
    given = ("t [s]=time:ms", "a=b=joint01.position:deg,wrap=360,scale=0.5,offset=-1")
    options = column_map.column_map_from_options(given, robot)
    assert options.columns[0].column == "a=b"
    (tmp_path / "map.toml").write_text(options.toml())
    assert column_map.read_column_map(tmp_path / "map.toml", robot) == options


def test_a_csv_of_can_frames_is_reported_from_others(tmp_path):
    header = "timestamp,arbitration_id,extended,remote,error,dlc,data\n"
    assert format_of(csv_file(tmp_path, header))[0].name == "can_csv"
    assert format_of(csv_file(tmp_path, "time,a\n"))[0].name == "csv"


def test_a_stopped_import_leaves_a_whole_file(tmp_path, opened):
    text = "t,a\n" + "".join(f"{i},1\n" for i in range(10_000))
    stop = StopRequest()
    stop.signal = 2
    report = run(tmp_path, text, "a=joint01.position:rad", time="ms", stop=stop)
    assert (report.complete, report.verdict) == (False, "degraded")
    assert opened(tmp_path / "run.mcap").warnings == []
