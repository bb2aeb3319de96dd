"""The command lines for each kind of file, and how often each of them comes."""

EDITS = [
    (3, "log info {file}"),
    (2, "log info {file} --json"),
    (3, "log check {file}"),
    (2, "log check {file} --json"),
    (4, "log recover {file} -o new.mcap"),
    (2, "log cut {file} --start 0.5 --stop 2 -o new.mcap"),
    (1, "log cut {file} --topics /joint_* --carry-state -o new.mcap"),
]
READS = [
    (3, "analyse {file}"),
    (3, "analyse {file} --json -o new.json"),
    (1, "log export {file} -o new.csv"),
    (1, "log export {file} -o new.log"),
    (0.5, "log export {file} -o new.blf"),
    (0.5, "log export {file} -o new.parquet"),
]
LISTEN = "--duration 200ms --quiet --floor 1MB --socket c.sock -o new.mcap"
COMMANDS = {
    "log": [
        *EDITS,
        *READS,
        (1, "log merge {file} gait0.mcap -o new.mcap"),
        (1, "log export {file} -o new.asc"),
        (0.5, "log export {file} -o frames.mcap"),
        (0.4, "report {file} -o new.html"),
        (1, "compare {file} gait0.mcap"),
        (0.7, "view {file} --save new.rrd"),
        (0.7, "drive {file} --on twin:scenario.toml --duration 0.1 -o new.mcap"),
        (0.5, "replay {file} --on twin:scenario.toml --duration 0.1 -o new.mcap"),
        (0.7, "plan lag-sweep --like {file} -o new --settle 1 --measure 2"),
        (0.5, "plan phase-kicks --like {file} -o new --settle 1 --measure 1"),
        (0.5, "plan multisine --like {file} -o new --settle 1 --measure 2"),
        (0.5, "plan reversal --like {file} -o new --settle 1 --measure 1"),
        (0.5, "predict {file} --eps 0.3"),
        (2, "api"),
    ],
    "unfinished": [*EDITS, *READS, (2, "api"), (6, "log recover {file} -o new.mcap --json")],
    "split": [*EDITS, *READS, (2, "api")],
    "trace": [
        (4, "import {file} -o new.mcap -r snake4.toml"),
        (1, "import {file} -o new.mcap -r snake4.toml --json"),
    ],
    "binary trace": [(1, "import {file} -o new.mcap -r snake4.toml")],
    "table": [(1, "import {file} -o new.mcap -r snake4.toml --columns columns.toml")],
    "columns": [
        (3, "import {file} -o new.mcap"),
        (1, "import {file} -o new.mcap --json --write-map new.toml --unit time=ms"),
    ],
    "apart": [(1, "import {file} -o new.mcap --commands commands.csv")],
    "tracks": [
        (4, "import {file} -o new.mcap --fps 120"),
        (1, "import {file} -o new.mcap --fps 120 --json --write-map new.toml"),
        (1, "import {file} -o new.mcap --fps 1e-300"),
        (1, "import {file} -o new.mcap"),
    ],
    "arrays": [(1, "import {file} -o new.mcap")],
    "dataset": [(2, "import {file} -o new"), (1, "import {file} -o new.mcap --episode 1")],
    **{
        kind: [
            (4, "import {file} -o new.mcap"),
            (1, "import {file} -o new.mcap --json"),
            (1, "import {file} -o new.mcap --response-topic /dynamic_joint_states"),
            (2, "log info {file}"),
            (1, "log info {file} --json"),
            (2, "log check {file}"),
            (2, "analyse {file}"),
            (1, "analyse {file} --json -o new.json"),
            (1, "report {file} -o new.html"),
            (1, "view {file} --save new.rrd"),
            (1, "api"),
        ]
        for kind in ("bag", "bag file", "database")
    },
    "serial": [
        *EDITS,
        *READS,
        (1, "log export {file} -o frames.mcap"),
        (1, "view {file} --save new.rrd"),
        (2, "api"),
    ],
    **{
        f"{protocol} line": [
            (1, f"record {LISTEN} 'serial:line?protocol={protocol}' -r arm.toml"),
            (1, f"record {LISTEN} 'serial:line?protocol={protocol}&baud=9600' --json"),
        ]
        for protocol in ("feetech", "dynamixel2")
    },
    "robot": [
        (2, "import {file} -o new.mcap -r snake4.toml"),
        (1, "sim run scenario.toml -o new.mcap"),
        (0.3, "record twin:scenario.toml --fast --quiet --floor 1MB --socket c.sock -o new.mcap"),
    ],
    "scenario": [
        (2, "sim run {file} -o new.mcap --duration 0.05"),
        (1, "drive {file} --on twin -o new.mcap --duration 0.05"),
    ],
    "plan": [(1, "drive {file} --on twin -o new.mcap")],
    "settings": [(1, "record --settings {file} --socket c.sock")],
    "result": [
        (1, "view {file} --save new.rrd --result result.json"),
        (1, "predict result.json --eps 0.3"),
        (1, "analyse {file} --null result.json"),
    ],
}
"""Kind to command lines and their weights; ``{file}`` is the base's file, faults in it."""

WEIGHTS = {
    "mutated": {
        "log": 10, "unfinished": 4, "split": 2, "trace": 6, "table": 2, "robot": 2, "scenario": 2,
        "plan": 1, "settings": 1, "result": 0.5,
    },
    "tables": {"columns": 4, "apart": 1, "tracks": 2},
    "arrays": {"arrays": 1},
    "datasets": {"dataset": 1},
    "bags": {"bag": 2, "bag file": 1},
    "binary": {"arrays": 5, "binary trace": 3, "database": 1},
    "serial": {"serial": 2, "feetech line": 1, "dynamixel2 line": 1},
}  # fmt: skip
"""Part of the campaign to its kinds, and how often each of them comes."""
