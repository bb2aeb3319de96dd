"""Small whole tables, arrays, data sets and serial recordings, as other programs write them.

Each is written by the library of its format; packets of servos by the vendors' SDKs.
"""

import json
import struct
import zipfile

import numpy as np
import pyarrow as pa
from dynamixel_sdk import GroupSyncRead, GroupSyncWrite, Protocol2PacketHandler
from pyarrow import parquet
from scipy.io import savemat
from scservo_sdk import PacketHandler

from support.bus_robots import TWO_JOINTS
from support.serial_lines import Captured
from undulog.capture import SessionWriter
from undulog.capture.robot.description import parse_robot
from undulog.capture.robot.serial_servos import STATUS, dynamixel_packet, feetech_packet
from undulog.capture.sources.events import Tally
from undulog.capture.sources.serial_port import PacketClock

from .base import EPOCH_NS, PERIOD_NS, Base, files_below

ROWS = 300
T = np.arange(ROWS) * 0.01
Q = np.stack([np.sin(3 * T + k) for k in range(3)], axis=1)
ARRAYS = {"time": T, "dof_pos": Q, "des_dof_pos": Q + 0.01, "kp": np.ones(3)}
MOTORS = 'motors = [{ joint = "joint01", id = 1 }, { joint = "joint02", id = 2, scale = -1.0 }]\n'
ARMS = {
    "feetech": f'{TWO_JOINTS}[bus]\nfamily = "feetech"\nmodel = "sts3215"\n{MOTORS}',
    "dynamixel2": f'{TWO_JOINTS}[bus]\nfamily = "dynamixel2"\nmodel = "xm430"\n{MOTORS}',
}
"""Protocol to a robot with two servos of it."""


def foreign_bases(folder):
    """Write everything to a new folder."""
    return [*_tables(folder), *_serial(folder / "serial")]


MARKERS = ("nose", "neck", "mid", "tail")


def _tracks(folder):
    """Write tracks of markers along a body that bends: plain columns, and DeepLabCut's."""
    along = np.arange(len(MARKERS))
    x, y = T[:, None] * 20 + 30 * along, 10 * np.sin(9 * T[:, None] - along)
    plain = np.stack([x, y], axis=2).reshape(ROWS, -1)
    head = ",".join(f"{name}_{axis}" for name in MARKERS for axis in "xy")
    np.savetxt(folder / "tracks.csv", plain, "%.4f", ",", header=head, comments="")
    names, axes = np.repeat(MARKERS, 3), ("x", "y", "likelihood") * len(MARKERS)
    heads = [("scorer", ["DLC"] * len(names)), ("bodyparts", names), ("coords", axes)]
    lines = "\n".join(",".join([first, *rest]) for first, rest in heads)
    cells = np.stack([x, y, np.full_like(x, 0.9)], axis=2).reshape(ROWS, -1)
    numbered = np.column_stack([np.arange(ROWS), cells])
    np.savetxt(folder / "dlc.csv", numbered, "%.4f", ",", header=lines, comments="")


def _tables(folder):
    states, sets = folder / "states", (folder / "dataset", folder / "dataset21")
    for path in (states, *(dataset / "meta" for dataset in sets)):
        path.mkdir(parents=True)
    head = "time,joint1_pos,joint2_vel,joint3_cmd"
    np.savetxt(folder / "wide.csv", np.column_stack([T, Q]), "%.9g", ",", header=head, comments="")
    np.savetxt(folder / "bare.txt", np.column_stack([T, Q]), "%.6f")
    rows = [f"{T[i]:.2f};j{k};{Q[i, k]:.6f}" for i in range(ROWS) for k in range(3)]
    (folder / "long.csv").write_text("\n".join(["time;joint;angle", *rows]))
    cells = [f'{x * 1e6:.1f},"{v.tolist()}"' for x, v in zip(T, Q, strict=True)]
    vectors = "\n".join(["timestamp,positions", *cells])
    for name in ("states/state.csv", "states/control.csv", "commands.csv", "vector.csv"):
        (folder / name).write_text(vectors)
    (states / "joint_list.txt").write_text("a\nb\nc\n")
    (states / "event.csv").write_text("timestamp,event\n0,START\n")
    _tracks(folder)
    np.savez_compressed(folder / "run.npz", **ARRAYS)
    savemat(folder / "run.mat", ARRAYS, do_compression=True)
    savemat(folder / "plain.mat", ARRAYS)
    listed = {name: v.tolist() for name, v in ARRAYS.items() if len(v) == ROWS}
    parquet.write_table(pa.table(listed), folder / "run.parquet")
    write_tensors(folder / "run.pt", {"time": T, "dof_pos": Q})
    _dataset_v3(sets[0])
    _dataset_v21(sets[1])
    files = files_below(folder)

    def below(name):
        return tuple(path for path in files if path.startswith(f"{name}/"))

    names = ("wide.csv", "bare.txt", "long.csv", "vector.csv")
    bases = [Base("columns", name, files, (name,)) for name in names]
    bases += [Base("tracks", name, files, (name,)) for name in ("tracks.csv", "dlc.csv")]
    bases.append(Base("columns", "states", files, below("states")))
    bases.append(Base("apart", "states/state.csv", files, ("commands.csv", "states/state.csv")))
    names = ("run.npz", "run.mat", "plain.mat", "run.parquet", "run.pt")
    bases += [Base("arrays", name, files, (name,)) for name in names]
    sets = ((dataset.name, below(dataset.name)) for dataset in sets)
    return [*bases, *(Base("dataset", name, files, inside) for name, inside in sets)]


def tensor(key, size, shape, strides, offset=0):
    """Return the opcodes that name one tensor of a storage; strides count numbers."""
    dims, steps = ("".join(f"I{n}\n" for n in numbers) for numbers in (shape, strides))
    return (
        f"ctorch._utils\n_rebuild_tensor_v2\n((Vstorage\nctorch\nDoubleStorage\n"
        f"V{key}\nVcpu\nI{size}\ntQI{offset}\n({dims}t({steps}tI00\n}}tR"
    ).encode()


def write_tensors(target, arrays):
    """Write the zip of ``torch.save`` to a file or stream, by the opcodes of its pickle."""
    text = b"\x80\x02}("
    with zipfile.ZipFile(target, "w") as archive:
        for name, array in arrays.items():
            strides = [n // array.itemsize for n in array.strides]
            text += f"V{name}\n".encode() + tensor(name, array.size, array.shape, strides)
            archive.writestr(f"run/data/{name}", array.tobytes())
        archive.writestr("run/data.pkl", text + b"u.")


def _info(folder, version, feature):
    info = {
        "codebase_version": version,
        "robot_type": "arm",
        "fps": 30,
        "total_episodes": 2,
        "features": {"action": feature, "observation.state": feature},
    }
    (folder / "meta" / "info.json").write_text(json.dumps(info))


def _frames(number):
    values = Q[number].astype(np.float32).tolist()
    frames = {"action": values, "observation.state": values, "timestamp": T[number]}
    frames |= {"frame_index": number % 150, "episode_index": number // 150, "index": number}
    return pa.table(frames | {"task_index": 0 * number})


def _dataset_v3(folder):
    _info(folder, "v3.0", {"dtype": "float32", "shape": [3], "names": ["a", "b", "c"]})
    data = folder / "data" / "chunk-000"
    data.mkdir(parents=True)
    parquet.write_table(_frames(np.arange(ROWS)), data / "file-000.parquet")
    tasks = pa.table({"task_index": [0], "__index_level_0__": ["reach"]})
    parquet.write_table(tasks, folder / "meta" / "tasks.parquet")


def _dataset_v21(folder):
    names = {"motors": ["pan.pos", "lift.pos", "jaw.pos"]}
    _info(folder, "v2.1", {"dtype": "float32", "shape": [3], "names": names})
    data = folder / "data" / "chunk-000"
    data.mkdir(parents=True)
    for episode in (0, 1):
        frames = _frames(np.arange(150) + 150 * episode)
        parquet.write_table(frames, data / f"episode_{episode:06d}.parquet")
    (folder / "meta" / "tasks.jsonl").write_text('{"task_index": 0, "task": "reach"}\n')
    entry = {"episode_index": 0, "tasks": ["reach"], "length": 150}
    (folder / "meta" / "episodes.jsonl").write_text(json.dumps(entry) + "\n")


# -- serial lines --------------------------------------------------------------------------


def packets(protocol, ticks=60):
    """Yield the packets of two servos that are commanded and asked in turn."""
    port = Captured()
    for tick in range(ticks):
        raw = [2048 + round(300 * np.sin(0.2 * tick + k)) for k in (0, 1)]
        if protocol == "feetech":
            sdk = PacketHandler(0)
            for servo, angle in zip((1, 2), raw, strict=True):
                sdk.writeTxOnly(port, servo, 42, 2, list(struct.pack("<H", angle)))
                yield port.take()
                sdk.readTx(port, servo, 56, 2)
                yield port.take()
                yield feetech_packet(servo, 0, struct.pack("<H", angle - 20))
            continue
        sdk = Protocol2PacketHandler()
        write, read = GroupSyncWrite(port, sdk, 116, 4), GroupSyncRead(port, sdk, 126, 10)
        for servo, angle in zip((1, 2), raw, strict=True):
            write.addParam(servo, list(struct.pack("<i", angle)))
            read.addParam(servo)
        write.txPacket()
        yield port.take()
        read.txPacket()
        yield port.take()
        for servo, angle in zip((1, 2), raw, strict=True):
            yield dynamixel_packet(servo, STATUS, bytes(1) + struct.pack("<hii", -9, 50, angle))


def _session(path, protocol):
    """Write what a recorder of a serial line writes: packets, raw and decoded."""
    robot = parse_robot(ARMS[protocol], "arm.toml", {})
    clock, tally = PacketClock(protocol, 1_000_000), Tally(lambda: 0)
    with SessionWriter(path, session_id="s", epoch_ns=EPOCH_NS, robot=robot) as writer:
        raw = writer.fd_frames("/serial/line")
        states = writer.joint_state("/joint_states", robot.joint_names, unit="rad")
        for tick, packet in enumerate(packets(protocol)):
            t_ns = EPOCH_NS + tick * PERIOD_NS
            raw.write(t_ns, clock.feed(packet, t_ns, tally))
            states.write(t_ns, np.sin([0.1 * tick, 0.1 * tick + 1]))


def _serial(folder):
    folder.mkdir()
    bases = []
    for protocol, robot in ARMS.items():
        (folder / "arm.toml").write_text(robot)
        (folder / "line.bin").write_bytes(b"".join(packets(protocol)))
        session = folder / f"{protocol}.mcap"
        _session(session, protocol)
        files = {name: (folder / name).read_bytes() for name in ("arm.toml", "line.bin")}
        names = ("line.bin", "line.bin", "arm.toml")
        bases.append(Base(f"{protocol} line", "line.bin", files, names))
        log = files | {session.name: session.read_bytes()}
        bases.append(Base("serial", session.name, log, (session.name,)))
    return bases
