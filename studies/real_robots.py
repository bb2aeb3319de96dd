"""The page on recordings of real robots: its numbers and its pictures.

``python studies/real_robots.py DATA``: imports and analyses each public recording in ``DATA`` by
the commands that the page shows, fills their numbers into ``docs/real-robots.txt``, and writes
``docs/explanation/real-robots.md`` and its pictures, or elsewhere with ``-o``. With ``--quick`` it
makes no reports and so no pictures, which is half of the time.
"""

from __future__ import annotations

import argparse
import json
import math
import shlex
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
COMMANDS = """
import DATA/so101/coupled_joints -o so101.mcap
report so101.mcap -o so101.html --plots so101-plots
analyse so101.mcap -o so101.json
import DATA/so101/multisine -o multisine.mcap
report multisine.mcap -o multisine.html --plots multisine-plots
analyse multisine.mcap -o multisine.json
import DATA/go2/traj_0.pt -o go2.mcap
report go2.mcap -o go2.html --plots go2-plots
analyse go2.mcap -o go2.json
import DATA/arcsnake/linear_trajectory.candump.log -o bus.mcap --robot arcsnake-joint
report bus.mcap --start 3 --stop 10.5 -o bus.html --plots bus-plots
analyse bus.mcap --start 3 --stop 10.5 -o bus.json
import DATA/arcsnake/joint7_no_load.csv --columns joint.toml -o no-load.mcap
import DATA/arcsnake/joint7_load_jointonly.csv --columns joint.toml -o joint-only.mcap
import DATA/arcsnake/joint7_load_fullsegment_amp0.2pi.csv --columns joint.toml -o segment.mcap
import DATA/arcsnake/joint7_no_load.csv --columns motor.toml -o motor.mcap
analyse no-load.mcap -o no-load.json
analyse joint-only.mcap -o joint-only.json
analyse segment.mcap -o segment.json
analyse motor.mcap -o motor.json
"""
MAP = """delimiter = ","
[time]
column = "time"
unit = "s"
[[columns]]
column = "{column}"
joint = "joint07"
quantity = "position"
unit = "rad"
scale = {scale}
"""
PICTURES = {
    "so101-plots/segments.svg": "real-so101.svg",
    "multisine-plots/bode-figure-0.svg": "real-multisine.svg",
    "go2-plots/bode-figure-0.svg": "real-go2.svg",
    "bus-plots/bode-figure-0.svg": "real-bus.svg",
}


def run_all(data: Path, folder: Path, *, quick: bool) -> None:
    """Run the commands in a folder, all or those that give numbers."""
    (folder / "DATA").symlink_to(data.resolve())
    joint = MAP.format(column="s_pos", scale=1 / 22) + f"wrap = {4 * math.pi}\n"
    (folder / "joint.toml").write_text(joint)
    (folder / "motor.toml").write_text(MAP.format(column="m_pos", scale=1 / 22))
    for line in COMMANDS.strip().splitlines():
        if quick and line.startswith("report"):
            continue
        command = [sys.executable, "-m", "undulog", *shlex.split(line)]
        done = subprocess.run(  # noqa: S603 - the commands above
            command, cwd=folder, capture_output=True, text=True, check=False
        )
        if done.returncode:
            sys.exit(f"undulog {line}: {done.stderr}")


def values(folder: Path) -> dict[str, str]:
    """Return what the page's places are filled with."""
    results = {path.stem: json.loads(path.read_text()) for path in folder.glob("*.json")}
    arm = {joint["name"]: joint for joint in results["so101"]["joints"]}
    jaw = next(
        artefact
        for artefact in results["so101"]["artefacts"]
        if artefact["flag"] == "scale_mismatch"
    )
    tested = results["multisine"]["frequency_response"]
    halves = [response["halves_agree"] for response in tested]
    legs, (bus,) = results["go2"]["frequency_response"], results["bus"]["frequency_response"]
    filled = {
        "gait": f"{results['so101']['gait']['frequency_hz']:.4f}",
        "jaw": jaw["note"].split()[0],
        "multisine": table(response_row(response) for response in tested),
        "agreed": str(sum(pair[0] for pair in halves)),
        "of": str(sum(pair[1] for pair in halves)),
        "legs": table(response_row(response) for response in legs),
        "bus": row(response_row(bus)),
        "arm": table(arm_row(arm[name]) for name in arm),
        "first": results["so101"]["answer"]["sentence"],
    }
    for name in ("no-load", "joint-only", "segment", "motor"):
        (joint,) = results[name]["free_motion"]["joints"]
        filled[name] = interval(joint["amplitude_rad"], joint["amplitude_ci95"], 180 / math.pi, 2)
        low, high = results[name]["gait"]["frequency_ci95"]
        filled[f"{name}-hz"] = interval(results[name]["gait"]["frequency_hz"], (low, high), 1, 4)
    short = amplitude(results["motor"]) / amplitude(results["no-load"]) - 1
    filled["short"] = f"{-100 * short:.1f}"
    return filled


def amplitude(result: dict[str, Any]) -> float:
    """Return the amplitude of a session's only joint [rad]."""
    return result["free_motion"]["joints"][0]["amplitude_rad"]


def interval(value: float, ends: Any, factor: float, digits: int) -> str:
    """Return a value with its interval."""
    low, high = (f"{factor * end:.{digits}f}" for end in ends)
    return f"{factor * value:.{digits}f} [{low}, {high}]"


def row(cells: Any) -> str:
    """Return a row of a table."""
    return "| " + " | ".join(cells) + " |"


def table(rows: Any) -> str:
    """Return rows of a table."""
    return "\n".join(row(cells) for cells in rows)


def arm_row(joint: dict[str, Any]) -> tuple[str, ...]:
    """Return name, gain, lag, and what the dead band alone makes of them."""
    band = joint["dead_band"]
    alone = ("–", "–", "–")
    if band is not None:
        made = f"{band['gain_change']:.3f}, {math.degrees(band['lag_change_rad']):.1f}°"
        travel = f"{math.degrees(band['top']['travel_rad']):.1f}"
        alone = (band["kind"].replace("_", " "), travel, made)
    gain = interval(joint["gain"], joint["gain_ci95"], 1, 3)
    return (
        joint["name"],
        gain,
        interval(joint["lag_rad"], joint["lag_ci95"], 180 / math.pi, 1),
        *alone,
    )


def response_row(response: dict[str, Any]) -> tuple[str, ...]:
    """Return name, band, gain at its ends, bandwidth and delay of a frequency response."""
    band = f"{response['frequency_hz'][0]:.2f} to {response['frequency_hz'][-1]:.2f}"
    ends = f"{response['gain'][0]:.3f} to {response['gain'][-1]:.3f}"
    width = "–" if response["bandwidth_hz"] is None else f"{response['bandwidth_hz']:.2f}"
    delay = interval(response["delay_s"], response["delay_s_ci95"], 1e3, 1)
    spread = "–" if response["distortion"] is None else f"{100 * response['distortion']:.1f}"
    return response["joint"], band, ends, width, delay, spread


def main() -> None:
    """Write the page and its pictures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "data", type=Path, nargs="?", default=ROOT.parent / "shared/data", help="the recordings"
    )
    parser.add_argument("-o", dest="out", type=Path, default=DOCS, help="folder to write to")
    parser.add_argument("--quick", action="store_true", help="the page without its pictures")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        run_all(given.data, folder, quick=given.quick)
        (given.out / "images").mkdir(parents=True, exist_ok=True)
        (given.out / "explanation").mkdir(exist_ok=True)
        for plot, picture in () if given.quick else PICTURES.items():
            shutil.copy(folder / plot, given.out / "images" / picture)
        text = (DOCS / "real-robots.txt").read_text()
        commands = "\n".join(f"undulog {line}" for line in COMMANDS.strip().splitlines())
        for place, value in (values(folder) | {"commands": commands}).items():
            text = text.replace(f"@{place}@", value)
    (given.out / "explanation" / "real-robots.md").write_text(text)


if __name__ == "__main__":
    main()
