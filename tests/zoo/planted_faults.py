"""All faults and kinds of the bench, by name: each module adds its own, the twin is a kind."""

from importlib import import_module

from .healthy import KINDS, draw, record
from .planted import FAULTS, Fault, plant

for _module in ("kinds", "dynamics", "planted_stops", "planted_responses", "planted_motion"):
    import_module(f".{_module}", __package__)

__all__ = ["FAULTS", "KINDS", "Fault", "draw", "plant", "record"]
