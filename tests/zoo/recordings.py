"""Sessions of real robots, read from the folder of recordings as arrays; nobody here made them.

Of each there are commands and positions on common times. Files of several clocks are joined by
linear interpolation of the commands; what is held between two commands stays within a sample.
"""

import csv
import json
import re
import struct
import zipfile

import numpy as np

from support.paths import SHARED

from .adapter import Signals

RMD_COMMAND, RMD_POSITION = 0xA4, 0x92
"""First bytes of an RMD motor's position command and of a reply with its multi-turn position."""

HUNDREDTHS = np.radians(0.01)
"""Unit of both [rad]."""


def recordings():
    """Return readers of all recordings that are there: name to a function without arguments."""
    readers = {}
    for folder in sorted(SHARED.glob("so101/*/control.csv")):
        readers[f"so101/{folder.parent.name}"] = lambda path=folder.parent: sage(path)
    for path in sorted(SHARED.glob("g1_lerobot_v21/data/*/*.parquet")):
        readers[f"g1/{path.stem}"] = lambda path=path: lerobot(path)
    for path in sorted(SHARED.glob("go2/*.pt")):
        readers[f"go2/{path.stem}"] = lambda path=path: torch_arrays(path)
    for path in sorted(SHARED.glob("kuka/data.mat")):
        readers["kuka"] = lambda path=path: kuka(path)
    for path in sorted(SHARED.glob("arcsnake/*.candump.log")):
        readers[f"arcsnake/{path.name.split('.')[0]}"] = lambda path=path: rmd_frames(path)
    return readers


def sage(folder):
    """Return a session of two CSV files, whose vectors are strings in one cell."""
    names = tuple((folder / "joint_list.txt").read_text().split())

    def vectors(name, column):
        with (folder / name).open() as file:
            rows = list(csv.DictReader(file))
        t_s = np.array([float(row["timestamp"]) for row in rows]) * 1e-6
        return t_s, np.array([json.loads(row[column]) for row in rows])

    asked_s, asked = vectors("control.csv", "positions")
    t_s, positions = vectors("state_motor.csv", "positions")
    return _joined(names, t_s, positions, asked_s, asked)


def lerobot(path):
    """Return an episode of a LeRobot data set; times are made from the frame rate."""
    import pyarrow.parquet as pq

    facts = json.loads((path.parents[2] / "meta/info.json").read_text())
    table = pq.read_table(path, columns=["action", "observation.state"])
    asked, positions = (np.array(table[name].to_pylist(), float) for name in table.column_names)
    names = tuple(facts["features"]["action"]["names"][0])
    rate_hz = float(facts["fps"])
    t_s = np.arange(len(asked)) / rate_hz
    return Signals(names, t_s, asked, positions, frame_rate_hz=rate_hz)


def torch_arrays(path):
    """Return a session of four raw float32 arrays in a zip: time, position, velocity, command."""
    legs = ("FL", "FR", "RL", "RR")
    with zipfile.ZipFile(path) as archive:
        files = {name.rpartition("/")[2]: name for name in archive.namelist() if "/data/" in name}
        arrays = [np.frombuffer(archive.read(files[key]), "<f4").astype(float) for key in "0123"]
    t_s = arrays[0]
    positions, asked = (arrays[k].reshape(t_s.size, -1) for k in (1, 3))
    names = tuple(f"{leg}_{part}_joint" for leg in legs for part in ("hip", "thigh", "calf"))
    return Signals(names, t_s - t_s[0], asked, positions)


def kuka(path):
    """Return a trajectory of an industrial robot of six axes, by its motors' encoders."""
    from scipy.io import loadmat

    record = loadmat(path, squeeze_me=True, struct_as_record=False)["rec"]
    asked, positions = (
        np.radians(np.asarray(getattr(record, name), float)).T
        for name in ("ref_pos_deg", "act_pos_mot_deg")
    )
    names = tuple(f"A{k + 1}" for k in range(asked.shape[1]))
    return Signals(names, np.asarray(record.time_cont, float), asked, positions)


def rmd_frames(path):
    """Return the one motor of a candump log with directions: commands and multi-turn replies."""
    sent, replied = [], []
    pattern = re.compile(r"\((\d+\.\d+)\) \S+ \w+#([0-9A-F]{16}) ([TR])")
    for line in path.read_text().splitlines():
        match = pattern.match(line)
        if match is None:
            continue
        data = bytes.fromhex(match[2])
        if data[0] == RMD_COMMAND and match[3] == "T":
            sent.append((float(match[1]), struct.unpack("<i", data[4:])[0] * HUNDREDTHS))
        elif data[0] == RMD_POSITION and match[3] == "R":
            turns = int.from_bytes(data[1:], "little", signed=True)
            replied.append((float(match[1]), turns * HUNDREDTHS))
    (asked_s, asked), (t_s, positions) = np.array(sent).T, np.array(replied).T
    return _joined(("motor",), t_s, positions[:, None], asked_s, asked[:, None])


def _joined(names, t_s, positions, asked_s, asked):
    """Return signals on the times of the positions, within those of the commands."""
    both = (t_s >= asked_s[0]) & (t_s <= asked_s[-1])
    both &= np.concatenate([[True], np.diff(t_s) > 0])
    t_s, positions = t_s[both], positions[both]
    commands = np.stack([np.interp(t_s, asked_s, column) for column in asked.T], axis=1)
    return Signals(names, t_s - t_s[0], commands, positions)
