"""Dataclasses of a package that can be changed after they were made."""

import dataclasses
import importlib
import pkgutil


def mutable_dataclasses(package):
    """Return the names of a package's dataclasses that aren't frozen.

    Args:
        package: Its dotted name, or that of a module.
    """
    root = importlib.import_module(package)
    submodules = pkgutil.walk_packages(getattr(root, "__path__", []), f"{package}.")
    modules = [root, *(importlib.import_module(module.name) for module in submodules)]
    return {
        name
        for module in modules
        for name, var in vars(module).items()
        if isinstance(var, type)
        and dataclasses.is_dataclass(var)
        and var.__module__ == module.__name__
        and not var.__dataclass_params__.frozen
    }
