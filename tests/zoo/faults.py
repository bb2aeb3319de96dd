"""All faults of the zoo, by name: each module adds its own, in the order of the manual's table."""

from importlib import import_module

from .planting import FAULTS, Fault, plant

for _module in ("standing", "sensing", "responding", "combined"):
    import_module(f".{_module}", __package__)

__all__ = ["FAULTS", "Fault", "plant"]
