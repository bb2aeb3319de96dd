#!/usr/bin/env python3
"""Walk every way to install undulog, as far as this machine allows, and print a line for each.

Each line is ``ok``, ``not tried`` with the reason, or ``failed`` with the last line of the output;
the exit code is 1 if one failed. What is installed is the last commit, in a temporary folder. Words
on the command line choose steps by a part of their name: ``.ci/install_paths.py wheel container``.

Only the standard library is used, as nothing is installed yet.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from functools import partial
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PYTHONS = ("3.11", "3.12", "3.13")
PATIENCE_S = 1200

NEEDS_EXTRA = {
    "sim list": "sim",
    "sim show flat": "sim",
    "sim run flat -o made.mcap": "sim",
    "sim null flat -o made.json": "sim",
    "sim fit a.mcap -o made.toml": "sim",
    "sim serve flat --socketcand 0": "sim",
    "drive flat --on twin -o made.mcap": "sim",
    "record twin:flat -o made.mcap": "sim",
    "replay a.mcap --on twin -o made.mcap": "sim",
    "sweep a.toml -o made": "sim",
    "view a.mcap --save made.rrd": "replay",
    "view a.mcap --clip made.gif": "replay",
    "report a.mcap -o made.html": "report",
    "log export a.mcap -o made.parquet": "parquet",
    "import a.parquet -o made.mcap": "parquet",
    "import a.mf4 -o made.mcap --robot snake25": "mf4",
    "import bag -o made.mcap": "bags",
    "log info https://localhost/a.mcap": "remote",
    "catalog .": "catalog",
}
"""Command that the base install can't do, to the extra that it has to name."""

NEEDS_NONE = (
    "log info a.mcap",
    "log check a.mcap",
    "analyse a.mcap",
    "log cut a.mcap -o cut.mcap --stop 5",
    "log export a.mcap -o a-out.csv",
    "log export a.mcap --to rosbag2 -o rosbag2",
    "robot show snake25",
    "info",
)


KEPT_IN_CHROOT = ("PIP_CERT", "PIP_INDEX_URL", "http_proxy", "https_proxy")
"""Variables of the network, which a container build is given too."""

SIMULATE = "sim run flat --duration 10 --json -o a.mcap"


class NotTriedError(Exception):
    """A step that this machine can't walk; the text says why."""


class FailedError(Exception):
    """A step that went wrong.

    Attributes:
        output: All that the command printed.
    """

    output = ""


def run(*words: str | Path, code: int = 0, **options: object) -> str:
    """Run a command to its end and return what it printed on both streams.

    Raises:
        FailedError: If it ends with another exit code.
    """
    clean = {k: v for k, v in os.environ.items() if not k.startswith(("PYTHON", "VIRTUAL_ENV"))}
    env = clean | options.pop("env", {})  # type: ignore[operator]
    done = subprocess.run(  # noqa: S603 - our own commands
        [str(word) for word in words],
        check=False,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=PATIENCE_S,
        env=env,
        **options,  # type: ignore[call-overload]
    )
    if done.returncode != code:
        last = (done.stdout.strip().splitlines() or ["no output"])[-1]
        shown = " ".join(str(word) for word in words)
        error = FailedError(f"{shown}: exit code {done.returncode}: {last}")
        error.output = done.stdout
        raise error
    return done.stdout


def find_python(version: str) -> Path:
    """Return an interpreter of a version, from the path, pyenv or uv.

    Raises:
        NotTriedError: If there is none.
    """
    home = Path.home()
    names = [shutil.which(f"python{version}"), sys.executable]
    names += sorted(home.glob(f".pyenv/versions/{version}*/bin/python"))
    names += sorted(home.glob(f".local/share/uv/python/cpython-{version}*/bin/python"))
    ask = "import sys; print('%d.%d' % sys.version_info[:2], sys.executable)"
    for name in filter(None, names):
        try:
            actual, path = run(name, "-c", ask).split(maxsplit=1)
        except (FailedError, OSError, ValueError):
            continue
        if actual == version:
            return Path(path.strip())
    raise NotTriedError(f"no Python {version} on this machine")


def find_tool(name: str) -> str:
    """Return the path of a program, or raise NotTriedError."""
    if (path := shutil.which(name)) is None:
        raise NotTriedError(f"no {name} on the path")
    return path


class Paths:
    """The steps, and the folder they work in."""

    def __init__(self, work: Path) -> None:
        """Begin without a wheel."""
        self.work = work
        self._wheel: Path | None = None

    def steps(self) -> Iterator[tuple[str, Callable[[], str]]]:
        """Name every step and the function that walks it; that returns what it found."""
        yield "source: git clone, make demo", self.source
        yield "wheel and sdist: built from the clone", lambda: self.wheel().name
        for version in PYTHONS:
            yield f"base wheel by pip, Python {version}", partial(self.base, version)
        for version in PYTHONS:
            yield f"wheel[all] by pip, Python {version}", partial(self.everything, version)
        yield "base wheel by pipx", self.pipx
        yield "base wheel by uv tool", self.uv_tool
        for title, extra in (("base", ""), ("simulation", "sim")):
            yield f"{title} dependencies as wheels for aarch64", partial(self.aarch64, extra)
        yield "container: the steps of Containerfile", self.container

    def source(self) -> str:
        """Clone and make the demo."""
        clone = self.clone()
        run("make", f"PYTHON={find_python('3.11')}", "demo", cwd=clone)
        made = sorted(path.name for path in (clone / "out/demo").iterdir())
        return ", ".join(made)

    def clone(self) -> Path:
        """Return a clone of the last commit."""
        clone = self.work / "clone"
        if not clone.is_dir():
            run("git", "clone", "--quiet", "--no-hardlinks", ROOT, clone)
        return clone

    def environment(self, name: str, version: str = "3.11") -> Path:
        """Return the folder of programs of a virtual environment, a new one if there is none."""
        place = self.work / name
        if not place.is_dir():
            run(find_python(version), "-m", "venv", place)
        return place / "bin"

    def wheel(self) -> Path:
        """Return the wheel of the last commit."""
        if self._wheel is None:
            bin_ = self.environment("build")
            run(bin_ / "pip", "install", "--quiet", "hatchling")
            run(bin_ / "python", "-m", "hatchling", "build", "-d", "dist", cwd=self.clone())
            (self._wheel,) = (self.clone() / "dist").glob("*.whl")
        return self._wheel

    def base(self, version: str) -> str:
        """Install without extras; check what works, and that the rest names its extra."""
        bin_ = self.environment(f"base{version}", version)
        run(bin_ / "pip", "install", "--quiet", "--no-compile", self.wheel())
        self.check_base(bin_ / "undulog", self.work / f"work{version}")
        return f"{len(NEEDS_NONE)} commands work, {len(NEEDS_EXTRA)} name their extra"

    def check_base(self, undulog: Path, folder: Path) -> None:
        """Run commands that need no extra, and all kinds that need one."""
        folder.mkdir()
        ticks = range(1200)
        rows = (f"{0.01 * k:.2f},{0.3 * ((k % 100) / 50 - 1):.4f}\n" for k in ticks)
        (folder / "a.csv").write_text("time,joint01_position\n" + "".join(rows))
        run(undulog, "import", "a.csv", "-o", "a.mcap", cwd=folder)
        (folder / "a.mf4").write_bytes(b"MDF     4.10    ".ljust(64, b"\0"))
        (folder / "a.parquet").write_bytes(b"PAR1")
        (folder / "bag").mkdir()
        (folder / "bag/metadata.yaml").write_text("rosbag2_bagfile_information:\n")
        for words in NEEDS_NONE:
            run(undulog, *words.split(), cwd=folder)
        for words, extra in NEEDS_EXTRA.items():
            shown = run(undulog, *words.split(), code=2, cwd=folder)
            if f"the extra '{extra}' brings it: pip install " not in shown:
                raise FailedError(f"undulog {words} doesn't name the extra '{extra}': {shown}")
        home = {"HOME": str(folder)}
        run(undulog, "--install-completion", "--shell", "bash", cwd=folder, env=home)
        run(undulog, "record", "unit", "--install", "--folder", folder, cwd=folder)

    def everything(self, version: str) -> str:
        """Install with all extras; simulate, analyse, report, replay."""
        bin_ = self.environment(f"all{version}", version)
        run(bin_ / "pip", "install", "--quiet", f"{self.wheel()}[all]")
        folder = self.work / f"all-work{version}"
        folder.mkdir()
        undulog = bin_ / "undulog"
        shown = run(undulog, *SIMULATE.split(), cwd=folder)
        engine = json.loads(shown)["engine"]
        for words in (
            "analyse a.mcap --json -o a.json",
            "report a.mcap -o a.html",
            "view a.mcap --save a.rrd",
            "log export a.mcap -o a.parquet",
        ):
            run(undulog, *words.split(), cwd=folder)
        shutil.rmtree(bin_.parent)  # a gigabyte
        return f"simulated with {engine}, analysed, reported, shown"

    def pipx(self) -> str:
        """Install as an application of its own."""
        pipx, home = find_tool("pipx"), self.work / "pipx"
        places = {"PIPX_HOME": str(home), "PIPX_BIN_DIR": str(home / "bin")}
        run(pipx, "install", "--python", find_python("3.11"), self.wheel(), env=places)
        self.check_base(home / "bin/undulog", self.work / "pipx-work")
        return "installed"

    def uv_tool(self) -> str:
        """Install as a tool."""
        uv, home = find_tool("uv"), self.work / "uv"
        places = {"UV_TOOL_DIR": str(home), "UV_TOOL_BIN_DIR": str(home / "bin")}
        if index := os.environ.get("PIP_INDEX_URL"):  # uv has no settings of pip
            places |= {"UV_DEFAULT_INDEX": os.environ.get("UV_DEFAULT_INDEX", index)}
        command = (uv, "tool", "install", "--python", find_python("3.11"), self.wheel())
        try:
            run(*command, env=places)
        except FailedError as error:
            if "client error (Connect)" not in error.output:
                raise
            why = "uv reaches no registry; UV_DEFAULT_INDEX names another"
            raise NotTriedError(why) from error
        self.check_base(home / "bin/undulog", self.work / "uv-work")
        return "installed"

    def aarch64(self, extra: str) -> str:
        """Find a wheel for 64-bit ARM of every dependency: those of an extra, or the base."""
        project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
        lines = project["optional-dependencies"][extra] if extra else project["dependencies"]
        # PyBullet has no such wheel: MuJoCo takes its place there.
        requirements = [line.partition(";")[0] for line in lines if "pybullet" not in line]
        platforms = (
            f"--platform={name}_aarch64"
            for name in ("manylinux_2_28", "manylinux_2_27", "manylinux_2_17", "manylinux2014")
        )
        folder = self.work / f"aarch64-{extra}"
        pip = self.environment("build") / "pip"
        options = ("--quiet", "--only-binary=:all:", "--python-version=3.11", *platforms)
        run(pip, "download", *options, "-d", folder, *requirements)
        names = [path.name for path in folder.iterdir()]
        native = [name for name in names if "aarch64" in name]
        return f"{len(names)} wheels, {len(native)} of them for aarch64"

    def container(self) -> str:
        """Run the steps of the container file, in a container or in a Debian chroot."""
        dist = self.wheel().parent
        for engine in ("podman", "docker"):
            if (path := shutil.which(engine)) and _works(path):
                tag = "undulog-install-path"
                run(path, "build", "-f", "Containerfile", "-t", tag, ".", cwd=dist.parent)
                run(path, "run", "--rm", tag)
                return f"built with {engine}"
        if os.geteuid() != 0:
            raise NotTriedError("neither podman nor docker works, and a chroot needs root")
        debootstrap = find_tool("debootstrap")
        text = (ROOT / "Containerfile").read_text().replace("\\\n", " ")
        steps = re.findall(r"^(FROM|RUN|COPY|ENTRYPOINT) +(.*)$", text, re.MULTILINE)
        suite = next(value for word, value in steps if word == "FROM").partition(":")[2]
        root = self.work / "chroot"
        run(debootstrap, "--variant=minbase", suite.removesuffix("-slim"), root, *_mirror())
        (entry,) = (json.loads(value) for word, value in steps if word == "ENTRYPOINT")
        kept = {k: v for k, v in os.environ.items() if k in KEPT_IN_CHROOT}
        variables = {"PATH": "/usr/sbin:/usr/bin:/sbin:/bin", "HOME": "/root"} | kept
        inside = ("chroot", root, "env", "-i", *(f"{k}={v}" for k, v in variables.items()))
        for word, value in steps:
            if word == "COPY":
                source, target = value.split()
                (root / target[1:]).mkdir(parents=True, exist_ok=True)
                for path in dist.parent.glob(source):
                    shutil.copy(path, root / target[1:])
            elif word == "RUN":
                _hand_on_network(root)  # each time: installing certificates replaces ours
                run(*inside, "/bin/sh", "-c", value)
        run(*inside, *entry, "--help")
        return "its steps in a Debian chroot; not tried as an image (no podman or docker)"


def _hand_on_network(root: Path) -> None:
    """Copy name servers and certificates into a chroot, as a container engine hands them on."""
    for place in ("/etc/resolv.conf", "/etc/ssl/certs/ca-certificates.crt"):
        if Path(place).is_file():
            (root / place[1:]).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(place, root / place[1:])


def _mirror() -> list[str]:
    """Return the mirror that this Debian uses, if it says."""
    for path in Path("/etc/apt/sources.list.d").glob("*.sources"):
        if match := re.search(r"^URIs: *(\S+)", path.read_text(), re.MULTILINE):
            return [match[1]]
    return []


def _works(engine: str) -> bool:
    try:
        run(engine, "info")
    except (FailedError, OSError):
        return False
    return True


def main(words: list[str]) -> int:
    """Walk the chosen steps; return the exit code."""
    failed = 0
    with ExitStack() as stack:
        folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="undulog-install-"))
        for name, step in Paths(Path(folder)).steps():
            if words and not any(word in name for word in words):
                continue
            start = time.monotonic()
            try:
                verdict, note = "ok", step()
            except NotTriedError as why:
                verdict, note = "not tried", str(why)
            except (FailedError, OSError, subprocess.TimeoutExpired, ValueError) as error:
                verdict, note, failed = "failed", str(error), 1
            spent = time.monotonic() - start
            print(f"{verdict:<9}  {name}: {note} ({spent:.0f} s)", flush=True)  # noqa: T201
    return failed


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
