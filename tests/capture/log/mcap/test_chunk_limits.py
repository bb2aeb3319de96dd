"""Chunks that hold more than they declare, or declare much: bounded memory, the rest is read."""

import json
import os
import resource

import pytest
from hostile_logs import EPOCH_NS, NS, HostileLog, joint_state, lz4_zeros, zeros

from support.processes import python
from support.read_back import messages_of

GIB = 1 << 30
MIB = 1 << 20
ROOM = 600 * MIB
"""Largest memory of a process that reads such a file, its own 120 MiB included [byte]."""


def ticks(start_s, count=50):
    return [
        (channel, t_ns, joint_state(t_ns, ["a", "b"], [tick / 100, 0.5]))
        for tick in range(count)
        for t_ns in [EPOCH_NS + start_s * NS + tick * 10_000_000]
        for channel in (1, 2)
    ]


def with_bomb(path, packed, size, *, whole=True, **options):
    """A good chunk, one that is not what it says, and a good one where the file is whole.

    Returns where the bytes of the second begin.
    """
    log = HostileLog()
    kind = log.schema()
    for topic in ("/joint_commands", "/joint_states"):
        log.channel(topic, kind)
    log.chunk(ticks(0))
    times, index = (EPOCH_NS + NS, EPOCH_NS + 2 * NS), {1: [(EPOCH_NS + NS, 0)]}
    cut = None if whole else len(packed) - 10
    at = log.chunk(packed=packed, size=size, times=times, index=index, cut=cut, **options)
    if whole:
        log.chunk(ticks(3))
    log.write(path, summary=whole)
    return at


def run(*commands, most=ROOM):
    """Run commands in a process of its own and give what each prints; none may fail.

    Its memory is held against a limit.
    """
    script = (
        "import contextlib, io, json, re, sys, undulog\n"
        "from pathlib import Path\n"
        "found = []\n"
        "for command in json.loads(sys.argv[1]):\n"
        "    with contextlib.redirect_stdout(io.StringIO()) as printed:\n"
        "        code = undulog.run(command)\n"
        "    found.append([code, printed.getvalue()])\n"
        # ru_maxrss would count what the process had before it became this program.
        "status = Path('/proc/self/status').read_text()\n"
        "used = 1024 * int(re.search(r'VmHWM:\\s+(\\d+)', status)[1])\n"
        "print(json.dumps([used, found]))\n"
    )

    def limited():
        resource.setrlimit(resource.RLIMIT_AS, (3 * GIB, 3 * GIB))

    listed = json.dumps([[str(word) for word in command] for command in commands])
    env = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
    used, outputs = json.loads(python(script, listed, preexec_fn=limited, env=env, code=0).stdout)
    assert used < most, f"{used / MIB:.0f} MiB"
    for command, (code, _) in zip(commands, outputs, strict=True):
        assert code == 0 or "check" in command, command
    return [printed for _, printed in outputs]


BOMBS = {
    "stated": lambda: (zeros(4 * GIB), 1000, {}),
    "unstated": lambda: (zeros(4 * GIB, stated=False), 1000, {}),
    "lz4": lambda: (lz4_zeros(GIB), 1000, {"compression": "lz4"}),
    "declared": lambda: (zeros(4 * GIB), 4 * GIB, {}),
    "300 MiB": lambda: (zeros(300 * MIB), 300 * MIB, {}),
}


@pytest.mark.slow
@pytest.mark.parametrize("whole", [True, False])
def test_chunks_that_expand_beyond_their_size_are_refused_and_the_rest_is_kept(tmp_path, whole):
    places = {}
    for kind, make in BOMBS.items():
        packed, size, options = make()
        path = tmp_path / f"{kind}.mcap"
        places[path] = with_bomb(path, packed, size, whole=whole, **options)
    printed = run(
        *(["log", "recover", path] for path in places),
        *(["log", "check", path, "--json"] for path in places),
        *(["analyse", path, "--json"] for path in places),
    )
    count = len(places)
    starts = [0, 3] if whole else [0]
    times = [t_ns for start in starts for _, t_ns, _ in ticks(start)]
    for k, (path, at) in enumerate(places.items()):
        assert "chunk" in printed[k], path
        recovered = messages_of(path.with_suffix(".recovered.mcap"))
        assert [message.log_time for _, _, message in recovered] == times, path
        health = json.loads(printed[count + k])
        if whole:
            assert health["verdict"] == "bad", path
            assert any(f"the chunk at byte {at} " in text for text in health["reasons"]), path
        assert any("chunk" in text for text in json.loads(printed[2 * count + k])["warnings"]), path


def test_the_error_names_the_option_that_reads_a_larger_chunk(tmp_path):
    path = tmp_path / "big.mcap"
    with_bomb(path, zeros(300 * MIB), 300 * MIB)
    command = ["log", "check", path, "--json"]
    refused, allowed = run(command, ["--max-chunk-mib", "300", *command], most=800 * MIB)
    option = "more than 256 MiB; --max-chunk-mib 300 reads it"
    assert any(option in text for text in json.loads(refused)["reasons"])
    assert not any("declares" in text for text in json.loads(allowed)["reasons"])


@pytest.mark.parametrize("wrong", ["", "0", "-1", "many", "1e9", "99999999999999999999"])
def test_a_chunk_limit_is_a_positive_whole_number(wrong, command):
    option = f"--max-chunk-mib={wrong}"
    assert "--max-chunk-mib" in command("log", "info", "x.mcap", option, code=2).err


IMAGE = (
    "std_msgs/Header header\nuint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\n"
    f"uint32 step\nuint8[] data\n{'=' * 80}\nMSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\n"
    f"string frame_id\n{'=' * 80}\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
)


@pytest.mark.slow
def test_constant_images_open_however_well_they_compress(tmp_path):
    """Black pictures, zero depth and an empty map compress 10,000 times and more."""
    log = HostileLog()
    kind = log.schema("sensor_msgs/msg/Image", IMAGE)
    sizes = {"/black": 3 * 640 * 480, "/depth": 2 * 640 * 480, "/map": 4000 * 4000}
    for topic in sizes:
        log.channel(topic, kind)
    stamps = [EPOCH_NS + k * NS // 10 for k in range(10)]
    plain = 0
    for channel, size in enumerate(sizes.values(), start=1):
        head = b"\x00\x01\x00\x00" + bytes(8) + b"\x01\0\0\0" + bytes(28)
        message = head + size.to_bytes(4, "little") + bytes(size)
        log.chunk([(channel, t_ns, message) for t_ns in stamps])
        plain += 10 * len(message)
    path = log.write(tmp_path / "images.mcap")
    assert plain / path.stat().st_size > 10_000
    facts, health, cut = run(
        ["log", "info", path, "--json"],
        ["log", "check", path, "--json"],
        ["log", "cut", path, "-o", tmp_path / "cut.mcap"],
    )
    assert [topic["messages"] for topic in json.loads(facts)["topics"]] == [10, 10, 10]
    assert not json.loads(facts)["warnings"]
    assert not any("decompress" in text for text in json.loads(health)["reasons"])
    assert "warning" not in cut
