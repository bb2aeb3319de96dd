"""Robot descriptions: the shipped ones, and every kind of fault in others."""

import math

import cantools
import numpy as np
import pytest

from support.bus_robots import LINK
from undulog.capture import load_robot, robot_names
from undulog.capture.common.errors import RobotFileError, UsageError
from undulog.capture.robot import model
from undulog.capture.robot.description import parse_robot
from undulog.sim.drive.limits import missing_limits, safety_example

MINIMAL = f"""
name = "worm"
clock = "host"
joints = [{{ name = "joint01", plane = "horizontal" }}, {{ name = "joint02", plane = "vertical" }}]
{LINK}"""

DBC = """VERSION ""

BU_: a b

BO_ 291 state: 8 a
 SG_ angle : 0|16@1- (0.01,0) [0|0] "deg" b
 SG_ speed : 16|16@1- (1,0) [0|0] "deg/s" b
"""


def faults_of(text, databases=None):
    with pytest.raises(RobotFileError) as caught:
        parse_robot(text, "worm.toml", databases or {})
    return str(caught.value).splitlines()


def test_shipped_robots_are_listed():
    assert robot_names() == (
        "arcsnake-joint",
        "snake12-sts3215",
        "snake13",
        "snake13-planar",
        "snake25",
        "so101",
    )


def test_snake25_is_the_robot_of_the_paper():
    robot = load_robot("snake25")
    assert len(robot.links) == 26
    assert robot.joint_names == tuple(f"joint{i:02d}" for i in range(1, 26))
    planes = [joint.plane for joint in robot.joints]
    assert planes == [model.Plane.HORIZONTAL, model.Plane.VERTICAL] * 12 + [model.Plane.HORIZONTAL]
    lower, upper = robot.limits()
    assert set(-lower) == set(upper) == {math.pi / 6}
    (link,) = {(k.length, k.radius, k.mass, k.inertia) for k in robot.links}
    assert link == (0.06, 0.025, 0.1, (4e-5, 5e-5, 5e-5))
    assert {joint.servo for joint in robot.joints} == {model.Servo()}
    assert robot.joints[0].servo.resistance_ohm == 4.0
    kinds = [sensor.kind for sensor in robot.sensors]
    assert [kinds.count(kind) for kind in model.SensorKind] == [15, 1, 1, 1]
    assert {s.range_max for s in robot.sensors if s.kind is model.SensorKind.IR} == {1.5}
    axes = {s.name: "".join(s.axes) for s in robot.sensors if s.axes}
    assert axes == {"accelerometer": "xyz", "compass": "xy"}
    assert all({"link", "position"} <= set(sensor.assumed) for sensor in robot.sensors)
    topics = [f"/ir/{i:02d}" for i in range(1, 16)]
    assert [s.topic for s in robot.sensors] == [*topics, "/sonar", "/imu", "/compass"]
    assert robot.assumed == ("links", "servo", "bus")


def test_topics_are_those_of_the_log_contract():
    place = {"link": "link01", "position": (0, 0, 0), "rpy": (0, 0, 0)}
    assert model.Sensor("ir07", model.SensorKind.IR, **place).topic == "/ir/07"
    assert model.Sensor("sonar", model.SensorKind.SONAR, **place).topic == "/sonar"
    assert model.Sensor("rear", model.SensorKind.SONAR, **place).topic == "/sonar/rear"


def test_snake25_has_one_command_and_one_state_frame_a_servo():
    robot = load_robot("snake25")
    for name in robot.joint_names:
        signals = [signal for signal in robot.bus.signals if signal.target == name]
        kinds = {(f"{name}_command", model.Direction.TX), (f"{name}_state", model.Direction.RX)}
        assert {(s.message, s.direction) for s in signals} == kinds
        assert {s.quantity for s in signals} >= {model.Quantity.COMMAND, model.Quantity.POSITION}
    sensed = {(s.target, s.axis) for s in robot.bus.signals if not s.target.startswith("joint")}
    assert len(sensed) == 15 + 1 + 3 + 2
    database = cantools.database.load_string(robot.databases[0][1], "dbc", strict=True)
    assert len({message.frame_id for message in database.messages}) == 25 + 25 + 4 + 2
    assert not any(message.is_extended_frame for message in database.messages)


def test_snake13_has_six_joints_a_plane():
    robot = load_robot("snake13")
    assert (len(robot.links), len(robot.joints)) == (13, 12)
    assert [len(robot.joint_indices(plane)) for plane in model.Plane] == [6, 6]
    assert robot.clock is model.ClockDomain.SIMULATED


def test_arcsnake_databases_load_strictly_and_share_one_identifier():
    robot = load_robot("arcsnake-joint")
    assert robot.bus.databases == ("rmd-x8-request.dbc", "rmd-x8-reply.dbc")
    databases = [cantools.database.load_string(text, "dbc") for _, text in robot.databases]
    assert [[m.frame_id for m in database.messages] for database in databases] == [[0x14B]] * 2


@pytest.mark.parametrize("name", ["arcsnake-joint", "snake13", "snake25"])
def test_a_robot_is_whole_again_from_what_a_session_carries(name):
    robot = load_robot(name)
    assert parse_robot(robot.toml, "session.mcap", dict(robot.databases)) == robot


def test_a_description_may_leave_out_what_has_a_default():
    robot = parse_robot(MINIMAL, "worm.toml", {})
    assert [link.name for link in robot.links] == ["link01", "link02", "link03"]
    assert robot.joints[0].servo == model.Servo()
    assert (robot.description, robot.sensors, robot.bus, robot.assumed) == ("", (), None, ())


def test_entries_override_the_defaults():
    more = "upper = 1.0, servo = { stall_torque = 0.25 }"
    text = MINIMAL.replace('plane = "vertical"', f'plane = "vertical", {more}')
    robot = parse_robot(text + "[defaults.servo]\nsupply_v = 12\n", "worm.toml", {})
    assert (robot.joints[0].upper, robot.joints[1].upper) == (math.pi / 6, 1.0)
    assert robot.joints[1].servo == model.Servo(supply_v=12.0, stall_torque=0.25)


def test_all_faults_are_listed_at_once():
    text = """
name = "my robot"
clok = "host"
joints = [
  { name = "joint01", plane = "horizontl", upper = -1.0 },
  { name = "joint01", plane = "vertical", speed = 3 },
]

[defaults.link]
length = 0.06
radius = "thick"
mass = -0.1
inertia = [4e-5, 5e-5, 1e-4]

[defaults.joint]
max_velocity = true

[defaults.sonar]
range_max = 4.0

[[sensors]]
name = "ir01"
kind = "ir"
link = "link9"
position = [0.0, 0.0]
range_min = 2.0
range_max = 1.5
field_of_view = 0.1
assumed = ["postion"]
"""
    assert faults_of(text) == FAULTS.splitlines()


FAULTS = """worm.toml: 16 faults in this robot description
  name: found "my robot"; valid: a name of letters, digits, _ and -, beginning with a letter
  clock: found nothing; valid: host, device, simulated
  joints[0].plane: found "horizontl"; valid: horizontal, vertical (did you mean horizontal?)
  defaults.joint.max_velocity: found true; valid: a finite number > 0
  joints[0].upper: found -1; valid: more than lower = -0.523599
  joints[1].speed: found an unknown key; valid: name, plane, lower, upper, max_velocity, servo, sits
  defaults.link.radius: found "thick"; valid: a finite number > 0
  defaults.link.mass: found -0.1; valid: a finite number > 0
  defaults.link.inertia: found [4e-05, 5e-05, 0.0001]; valid: moments of which none exceeds the \
sum of the other two
  sensors[0].link: found "link9"; valid: link01, link02, link03 (did you mean link03?)
  sensors[0].position: found [0.0, 0.0]; valid: an array of 3 finite numbers
  sensors[0].range_max: found 1.5; valid: more than range_min = 2
  sensors[0].assumed[0]: found "postion"; valid: link, position, rpy, range_min, range_max, \
field_of_view (did you mean position?)
  defaults.sonar: found a table; valid: leave it out: no sensor is of kind sonar
  joints and sensors: found 2 times joint01; valid: every name once
  clok: found an unknown key; valid: defaults, name, description, serial, clock, assumed, chain, \
joints, links, sensors, bus, safety, safety_of (did you mean clock?)
"""


BUS = """
[bus]
databases = ["worm.dbc"]
bitrate = 500_000
signals = [
  { message = "state", signal = "angle", direction = "rx", target = "joint01", quantity = "position", unit = "deg" },
]
"""  # noqa: E501  TOML has inline tables on one line
ENTRY = BUS.splitlines()[5]


def test_a_bus_map_is_read():
    robot = parse_robot(MINIMAL + BUS, "worm.toml", {"worm.dbc": DBC, "other.dbc": "?"})
    (signal,) = robot.bus.signals
    assert (signal.message, signal.signal, signal.target) == ("state", "angle", "joint01")
    assert (signal.direction, signal.quantity) == (model.Direction.RX, model.Quantity.POSITION)
    assert robot.databases == (("worm.dbc", DBC),)


SENSOR = """
[[sensors]]
name = "compass"
kind = "compass"
link = "link01"
position = [0, 0, 0]
axes = ["x", "y"]
"""
COMPASS = SENSOR + BUS.replace("joint01", "compass").replace("position", "magnetic_field").replace(
    '"deg"', '"uT"'
)


# what is replaced, by what, and the fault
BUS_FAULTS = r"""
"state" | "sate" | signals[0].message: found "sate"; valid: state (did you mean state?)
"angle" | "angel" | signals[0].signal: found "angel"; valid: a signal of state: angle, speed (did you mean angle?)
"rx" | "in" | signals[0].direction: found "in"; valid: tx, rx
"joint01" | "joint03" | signals[0].target: found "joint03"; valid: joint01, joint02, {joint} (did you mean joint02?)
"position", unit = "deg" | "range", unit = "m" | signals[0].quantity: found "range"; valid: what joint01 has: command, position, velocity, effort, current, voltage, temperature
"deg" | "dgr" | signals[0].unit: found "dgr"; valid: for position: rad, mrad, deg, rev (did you mean deg?)
"deg" | "deg", scale = 0 | signals[0].scale: found 0; valid: a finite number other than 0
"deg" | "deg", axis = "x" | signals[0].axis: found "x"; valid: leave it out: the target has no axes
"worm.dbc" | "../worm.dbc" | databases: ../worm.dbc: found no such file; valid: the name of a DBC file that lies beside the description
500_000 | 0 | bitrate: found 0; valid: a whole number >= 1
["worm.dbc"] | ["worm.dbc", "again.dbc"] | databases: again.dbc: found a second message state; valid: message names that are unique in all databases together
"deg" | "deg", unknown = 32768 | signals[0].unknown: found 32768; valid: a raw number of 16 bits, -32768 to 32767
"""  # noqa: E501  a fault is a line
ONCE = "one entry a signal, target and quantity"
BEYOND = (
    "signals[0].out_of_range: found 5; valid: leave it out: only a range has it\n"
    "signals[0].unknown: found -40000; valid: a whole number >= -32768"
)
CASES = [
    *(line.split(" | ") for line in BUS_FAULTS.strip().splitlines()),
    [ENTRY, f"{ENTRY}\n{ENTRY}", f"signals[1].signal: found a repeated entry; valid: {ONCE}"],
    ['"deg"', '"deg", unknown = -40000, out_of_range = 5', BEYOND],
    [BUS, COMPASS, "signals[0].axis: found nothing; valid: x, y"],
]


@pytest.mark.parametrize(("old", "new", "faults"), CASES)
def test_faults_of_a_bus_map(old, new, faults):
    lines = faults_of(MINIMAL + BUS.replace(old, new), {"worm.dbc": DBC, "again.dbc": DBC})
    assert lines[1:] == [f"  bus.{fault}" for fault in faults.split("\n")]


def test_a_faulty_database_is_one_fault_and_not_one_a_signal():
    first, fault = faults_of(MINIMAL + BUS, {"worm.dbc": DBC.replace("16|16", "60|16")})
    assert first == "worm.toml: 1 fault in this robot description"
    misfit = "The signal speed does not fit in message state."
    assert fault == f"  bus.databases: worm.dbc: found {misfit}; valid: a DBC without overlaps"


def test_syntax_errors_name_the_place():
    (_, fault) = faults_of('name = "worm\n')
    assert "line 1" in fault


def test_unequal_numbers_of_links_and_joints():
    text = MINIMAL.replace("joints =", 'links = [{ name = "link01" }]\njoints =')
    assert "  links: found 1; valid: 3, one more than joints" in faults_of(text)


def test_a_robot_file_finds_its_databases_beside_it(tmp_path):
    (tmp_path / "worm.toml").write_text(MINIMAL + BUS)
    (tmp_path / "worm.dbc").write_bytes(DBC.replace('"deg"', '"°"').encode("cp1252"))
    assert "°" in load_robot(tmp_path / "worm.toml").databases[0][1]


def test_an_unknown_robot_is_wrong_usage():
    with pytest.raises(UsageError, match=r"no robot 'snak25'.*did you mean snake25\?"):
        load_robot("snak25")


def test_a_file_that_is_not_text(tmp_path):
    path = tmp_path / "worm.toml"
    path.write_bytes(b"name = '\xff'")
    with pytest.raises(RobotFileError, match="not UTF-8"):
        load_robot(path)


@pytest.mark.parametrize(
    ("text", "name", "value"),
    [
        (COMPASS.replace('"uT"', '"uT", axis = "y"'), "axis", "y"),
        (BUS.replace('"deg"', '"deg", unknown = -32768'), "unknown", -32768),
    ],
)
def test_further_fields_of_a_bus_signal(text, name, value):
    (signal,) = parse_robot(MINIMAL + text, "worm.toml", {"worm.dbc": DBC}).bus.signals
    assert getattr(signal, name) == value


@pytest.mark.parametrize("name", ["snake25", "snake13", "snake13-planar"])
def test_shipped_snakes_can_be_armed(name):
    robot = load_robot(name)
    assert missing_limits(robot) == ()
    assert robot.safety.on_fault is model.OnFault.RAMP_DOWN
    assert robot.safety.values("max_rate", robot.joint_names).tolist() == [4.0] * len(robot.joints)


def test_safety_of_one_joint_may_be_otherwise():
    text = """
[safety]
max_rate = 2.0
fault_after_s = 0.1
on_fault = "hold"

[safety_of.joint02]
max_rate = 1.0
max_current = 0.5
"""
    safety = parse_robot(MINIMAL + text, "worm.toml", {}).safety
    of = (("joint02", "max_rate", 1.0), ("joint02", "max_current", 0.5))
    assert safety == model.Safety(
        max_rate=2.0, fault_after_s=0.1, on_fault=model.OnFault.HOLD, of=of
    )
    names = ("joint01", "joint02")
    assert safety.values("max_rate", names).tolist() == [2.0, 1.0]
    np.testing.assert_array_equal(safety.values("max_current", names), [math.nan, 0.5])


def test_what_arming_lacks_is_named_with_an_example():
    bare = parse_robot(MINIMAL, "worm.toml", {})
    assert bare.safety is None
    always = ("max_rate", "ramp_rate", "max_tracking_error", "reply_timeout_s", "max_late_s")
    assert missing_limits(bare) == always  # it has no bus that tells currents
    arm = load_robot("arcsnake-joint")
    assert missing_limits(arm) == (*always, "max_current", "max_temperature")
    # The example is a whole table: with it nothing is missing.
    whole = parse_robot(f"{MINIMAL}\n{safety_example(missing_limits(bare))}", "worm.toml", {})
    assert missing_limits(whole) == ()
    # A limit that only one joint has is missing for the others.
    single = MINIMAL + "[safety]\n[safety_of.joint01]\nmax_rate = 1.0\n"
    assert "max_rate" in missing_limits(parse_robot(single, "worm.toml", {}))


def test_faults_of_safety_are_reported_together():
    text = """
[safety]
max_rate = 0.0
max_curent = 1.0
on_fault = "jump"

[safety_of.joint03]
max_rate = 1.0
"""
    text = "\n".join(faults_of(MINIMAL + text))
    assert "safety.max_rate: found 0.0; valid: a finite number > 0" in text
    assert "safety.max_curent: found an unknown key" in text
    assert 'safety.on_fault: found "jump"; valid: hold, ramp-down' in text
    assert "safety_of.joint03: found an unknown key" in text
    alone = MINIMAL + "[safety_of.joint01]\nmax_rate = 1.0\n"
    assert "safety_of: found a table; valid: leave it out" in "\n".join(faults_of(alone))


def test_requests_stand_in_the_bus_map():
    ask = 'BO_ 290 ask: 2 b\n SG_ what : 0|8@1+ (1,0) [0|0] "" a\n\n'
    dbc = DBC.replace("BO_ 291 state", f"{ask}BO_ 291 state")
    bus = BUS.partition("signals")[0]
    good = bus + 'polls = [{ message = "ask", signals = { what = 0x92 } }]\n'
    robot = parse_robot(MINIMAL + good, "worm.toml", {"worm.dbc": dbc})
    assert robot.bus.polls == (model.BusPoll("ask", (("what", 0x92),)),)
    valid = "valid: joint01, joint02, {joint} (did you mean joint02?)"
    bad = """
[[bus.polls]]
message = "aks"

[[bus.polls]]
message = "ask"
target = "joint09"
signals = { what = 256, wat = 1 }
"""
    assert faults_of(MINIMAL + bus + bad, {"worm.dbc": dbc})[1:] == [
        '  bus.polls[0].message: found "aks"; valid: ask, state (did you mean ask?)',
        f'  bus.polls[1].target: found "joint09"; {valid}',
        "  bus.polls[1].signals.what: found 256; valid: a raw number of 8 bits",
        "  bus.polls[1].signals.wat: found an unknown key; valid: what (did you mean what?)",
    ]
