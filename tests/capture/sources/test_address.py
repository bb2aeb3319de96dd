"""Addresses, and the sources that they name."""

import pytest

from support.processes import python
from undulog.capture.common.errors import UsageError
from undulog.capture.robot.model import ClockDomain
from undulog.capture.sources.contract import open_source, open_sources, parse_address, schemes


@pytest.mark.parametrize(
    ("text", "name", "scheme", "rest", "options"),
    [
        ("can:socketcan:can0", "can0", "can", "socketcan:can0", {}),
        ("front=can:slcan:/tty0?x=5&y=1", "front", "can", "slcan:/tty0", {"x": "5", "y": "1"}),
        ("can:slcan:/dev/ttyACM0", "ttyACM0", "can", "slcan:/dev/ttyACM0", {}),
        ("can:slcan:/by-id/A.B_1-if0", "A_B_1_if0", "can", "slcan:/by-id/A.B_1-if0", {}),
        ("can:kvaser:0", "can0", "can", "kvaser:0", {}),
        ("can:pcan:PCAN_USBBUS1?fd=1", "PCAN_USBBUS1", "can", "pcan:PCAN_USBBUS1", {"fd": "1"}),
        ("unix:/run/user/1000/snake.sock", "snake", "unix", "/run/user/1000/snake.sock", {}),
        ("unix:/tmp/3.sock", "unix3", "unix", "/tmp/3.sock", {}),
        ("twin:weak-servo-pi3", "weak_servo_pi3", "twin", "weak-servo-pi3", {}),
        ("twin:my/own.toml", "own", "twin", "my/own.toml", {}),
        ("x=unix:/tmp/a=b.sock?clock=host", "x", "unix", "/tmp/a=b.sock", {"clock": "host"}),
        ("can:socketcan:can0?note=", "can0", "can", "socketcan:can0", {"note": ""}),
    ],
)
def test_an_address_is_taken_apart(text, name, scheme, rest, options):
    address = parse_address(text)
    assert (address.name, address.scheme, address.rest) == (name, scheme, rest)
    assert dict(address.options) == options
    assert address.text == text


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("can0", "is no source: expected .NAME=.SCHEME:REST"),
        ("", "is no source"),
        ("can:", "is no source"),
        (":x", "is no source"),
        ("front=", "is no source"),
        ("1st=can:socketcan:can0", "can't be called '1st'.*valid: a letter, then"),
        ("a-b=can:socketcan:can0", "can't be called 'a-b'"),
        ("=can:socketcan:can0", "can't be called ''"),
        ("can:socketcan:can0?bitrate", "'bitrate' is no option"),
        ("can:socketcan:can0?a=1&a=2", "option a is given twice"),
        ("can:socketcan:can0?a=1&&b=2", "'' is no option"),
    ],
)
def test_what_is_wrong_is_reported(text, match):
    with pytest.raises(UsageError, match=match):
        parse_address(text)


def test_schemes_are_those_installed():
    assert {"can", "twin", "unix"} <= set(schemes())
    with pytest.raises(UsageError, match=r"no kind of source 'cam'; valid: can.*did you mean can"):
        open_source(parse_address("cam:socketcan:can0"))


def test_two_sources_need_two_names(tmp_path):
    with pytest.raises(UsageError, match=r"are both called can0.*can0_2="):
        open_sources(["can:virtual:can0", f"unix:{tmp_path}/can0.sock"])
    sources = open_sources(["can:virtual:can0", f"other=unix:{tmp_path}/can0.sock"])
    assert [source.name for source in sources] == ["can0", "other"]
    assert sources[1].clock is ClockDomain.DEVICE
    assert not any(source.connected or source.finished for source in sources)
    with pytest.raises(UsageError, match="no source given"):
        open_sources([])


@pytest.mark.slow
@pytest.mark.parametrize("hidden", [("pybullet", "mujoco"), ("tomlkit",)])
def test_a_source_without_its_extra_names_it(hidden):
    code = (
        f"import sys; sys.modules |= dict.fromkeys({hidden!r})\n"
        "from undulog.capture.common.errors import MissingExtraError\n"
        "from undulog.capture.sources.contract import open_sources\n"
        "try:\n"
        "    open_sources(['twin:flat'])\n"
        "except MissingExtraError as error:\n"
        "    print(error)\n"
    )
    done = python(code)
    assert "the extra 'sim' brings it: pip install" in done.stdout, done.stderr
