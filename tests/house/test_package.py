"""One package name: what is built and installed, and that no module exists under two names."""

import ast
import csv
import json
import os
import re
import shutil
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

from support import processes
from support.paths import ROOT
from support.processes import tracked

FOLDERS = ("analysis", "capture", "replay", "sim")
BUILD = [sys.executable, "-m", "hatchling", "build"]


def run(*words, cwd=ROOT, fails=False, **environment):
    keep = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = processes.run(*words, cwd=cwd, env=keep | environment)
    assert (done.returncode != 0) == fails, done.stderr
    return done.stderr if fails else done.stdout


def record(wheel):
    with zipfile.ZipFile(wheel) as archive:
        (name,) = [n for n in archive.namelist() if n.endswith(".dist-info/RECORD")]
        return {row[0]: row[1] for row in csv.reader(archive.read(name).decode().splitlines())}


@pytest.fixture(scope="module")
def tree(tmp_path_factory):
    folder = tmp_path_factory.mktemp("tree") / "undulog"
    for path in tracked():
        copy = folder / path.relative_to(ROOT)
        copy.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(path, copy, follow_symlinks=False)
    return folder


@pytest.fixture(scope="module")
def wheel(tree):
    run(*BUILD, "-t", "wheel", "-d", tree.parent / "wheel", cwd=tree)
    return next((tree.parent / "wheel").glob("*.whl"))


@pytest.mark.nightly
def test_the_source_archive_holds_each_file_once_and_builds_the_same_wheel(tree, wheel):
    run(*BUILD, "-t", "sdist", "-d", tree.parent / "sdist", cwd=tree)
    with tarfile.open(next((tree.parent / "sdist").glob("*.tar.gz"))) as archive:
        members = archive.getmembers()
        assert all(member.isfile() for member in members)
        archive.extractall(tree.parent / "unpacked", filter="data")
    (unpacked,) = (tree.parent / "unpacked").iterdir()
    names = [str(Path(member.name).relative_to(unpacked.name)) for member in members]
    assert len(set(names)) == len(names)
    assert not [
        name for name in names if name.startswith(tuple(f"{folder}/" for folder in FOLDERS))
    ]
    run(*BUILD, "-t", "wheel", "-d", tree.parent / "again", cwd=unpacked)
    assert record(next((tree.parent / "again").glob("*.whl"))) == record(wheel)


def test_the_wheel_holds_every_file_of_the_packages(wheel):
    expected = {f"undulog/{path.relative_to(ROOT)}" for path in tracked(*FOLDERS)}
    roots = ("__init__.py", "__main__.py", "notebook.py", "py.typed")
    expected |= {f"undulog/{name}" for name in roots}
    assert {name for name in record(wheel) if not name.startswith("undulog-")} == expected


def test_a_tree_without_links_is_refused_when_it_is_built(tree, tmp_path):
    folder = tmp_path / "flat"
    shutil.copytree(tree, folder, symlinks=True)
    for name in FOLDERS:  # what git writes where links are not allowed
        (folder / "undulog" / name).unlink()
        (folder / "undulog" / name).write_text(f"../{name}")
    err = run(*BUILD, "-t", "wheel", "-d", tmp_path / "wheel", cwd=folder, fails=True)
    assert "undulog/analysis" in err
    assert "symbolic link" in err


@pytest.mark.slow
def test_an_installed_wheel_leaves_one_name_beside_modules_of_the_user(wheel, tmp_path):
    place, work = tmp_path / "site", tmp_path / "work"
    pip = [sys.executable, "-m", "pip", "install", "--no-deps", "--no-index", "--quiet"]
    run(*pip, "--no-compile", "--target", place, wheel)
    assert {p.name for p in place.iterdir() if ".dist-info" not in p.name} == {"bin", "undulog"}
    work.mkdir()
    for name in FOLDERS:
        (work / f"{name}.py").write_text("MINE = True\n")
    script = (
        "import analysis, capture, replay, sim, undulog.analysis, undulog.replay, undulog.sim\n"
        "from undulog.capture import Session\n"
        "assert analysis.MINE and capture.MINE and replay.MINE and sim.MINE\n"
        "print(Session.__module__, undulog.__file__)\n"
    )
    module, file = run(sys.executable, "-c", script, cwd=work, PYTHONPATH=f"{work}:{place}").split()
    assert module.startswith("undulog.capture.")
    assert file.startswith(str(place))


@pytest.mark.slow
@pytest.mark.parametrize("name", FOLDERS)
@pytest.mark.parametrize("how", [("-c",), ("-m", "pytest", "-q", "-p", "no:cacheprovider")])
def test_a_package_by_another_name_is_an_error(name, how, tmp_path):
    if how == ("-c",):
        err = run(sys.executable, "-c", f"import {name}", fails=True)
        assert f"ImportError: import undulog.{name} instead of {name}" in err
        return
    test = tmp_path / "test_names.py"
    test.write_text(
        "import pytest\ndef test():\n"
        f"    with pytest.raises(ImportError, match='undulog.{name}'):\n        import {name}\n"
    )
    run(sys.executable, *how, test)


def test_results_cross_to_a_spawned_process(tmp_path):
    script = tmp_path / "spawned.py"
    script.write_text(
        "import json, multiprocessing\n"
        "from undulog.analysis import Estimate\n"
        "from undulog.capture.common.errors import UsageError\n"
        "def work(value):\n"
        "    return type(value).__module__, value\n"
        "if __name__ == '__main__':\n"
        "    values = [Estimate(1.0, (0.9, 1.1)), UsageError('x')]\n"
        "    with multiprocessing.get_context('spawn').Pool(1) as pool:\n"
        "        back = pool.map(work, values)\n"
        "    same = [type(b) is type(a) for a, (_, b) in zip(values, back)]\n"
        "    print(json.dumps([[module for module, _ in back], same]))\n"
    )
    modules, same = json.loads(run(sys.executable, script))
    assert all(module.startswith("undulog.") for module in modules)
    assert same == [True, True]


def _imports(tree):
    names = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and not node.level:
            names += [f"{node.module}.{alias.name}" for alias in node.names]
    return names


@pytest.mark.nightly
def test_no_file_names_a_package_without_undulog_or_its_own_package_with_it():
    inside = []
    for path in tracked("*.py"):
        name = path.relative_to(ROOT)
        for imported in _imports(ast.parse(path.read_text())):
            first, *rest = imported.split(".")
            qualified = first == "undulog" and rest[:1] == [name.parts[0]]
            if (first in FOLDERS) or (qualified and name.parts[0] in FOLDERS):
                inside.append(f"{name}: {imported}")
    assert inside == []


MODULE = re.compile(
    r"(?<![\w./-])(?:from |import |[`\"']|:: |-m )"
    rf"(?P<name>(?:{'|'.join(FOLDERS)})(?:\.[a-z_]\w*)+)"
)


def test_no_text_or_string_names_a_module_without_undulog():
    named = []
    for path in tracked("*.py", "*.md", "*.ipynb", "*.toml", "*.service", ".ci", "Makefile"):
        if path.name == "CHANGELOG.md":
            continue
        for match in MODULE.finditer(path.read_text()):
            module = ROOT.joinpath(*match["name"].split(".")[:2])
            if module.is_dir() or module.with_suffix(".py").exists():
                named.append(f"{path.relative_to(ROOT)}: {match[0]}")
    assert named == []
