"""Extras: their packages, and the command that installs them."""

import tomllib

from packaging.requirements import Requirement

from support.paths import ROOT
from undulog.capture.common.extras import (
    EXTRAS,
    extra_of,
    extra_packages,
    install_command,
    missing_package,
)

DECLARED = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]


def test_the_extras_are_those_of_the_project_and_all_is_all_of_them():
    assert set(EXTRAS) == set(DECLARED) - {"all"}
    (every,) = DECLARED["all"]
    assert Requirement(every).extras == set(EXTRAS)


def test_packages_of_an_extra_are_those_that_this_python_needs():
    for extra in EXTRAS:
        requirements = [Requirement(line) for line in DECLARED[extra]]
        here = {
            r.name.replace(".", "-")
            for r in requirements
            if r.marker is None or r.marker.evaluate()
        }
        assert set(extra_packages(extra)) == here


def test_the_command_names_packages_for_a_shell():
    assert install_command("numba") == "pip install 'numba>=0.65'"
    assert install_command("cluster") == "pip install 'dask[distributed]>=2025.1'"
    assert install_command("none-such", "x") == "pip install x"


def test_a_failed_import_is_traced_to_its_extra():
    def failed(name):
        return ModuleNotFoundError(f"No module named {name!r}", name=name)

    wrapped = RuntimeError("x")
    wrapped.__cause__ = failed("pyarrow.parquet")
    assert missing_package(wrapped) == "pyarrow"
    assert missing_package(failed("json")) is None
    assert (extra_of("pyarrow"), extra_of("pyarrow", "catalog")) == ("parquet", "catalog")
    assert (extra_of("pyarrow", "sweep"), extra_of("pyarrow", "sim")) == ("parquet", "parquet")
