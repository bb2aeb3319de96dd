"""JSON Schemas of the results, made from their dataclasses and the docstrings of these.

The schemas ship as files in ``analysis/results/schemas``; ``make schemas`` writes them. A test
holds them to the dataclasses, and real results to them. A key that is new leaves the version as it
is; a key that is removed, renamed or of another type raises it.
"""

from __future__ import annotations

import inspect
import re
from dataclasses import fields, is_dataclass
from enum import Enum
from types import NoneType, UnionType
from typing import Any, Union, cast, get_args, get_origin, get_type_hints

from undulog.analysis.common.estimate import Estimate
from undulog.analysis.parts.artefacts.result import Artefact
from undulog.analysis.parts.body.result import BodyPoint, BodyTravel, Serpenoid, ShapeMode
from undulog.analysis.parts.energy.result import Transport
from undulog.analysis.parts.episodes.result import EpisodesResult
from undulog.analysis.parts.free_motion.result import BodyWave, JointMotion, LocalWaveNumber
from undulog.analysis.parts.frequency_response.result import JointFrequencyResponse
from undulog.analysis.parts.gait.result import GaitFacts, GroupFacts
from undulog.analysis.parts.gaits.result import GaitWindow, JointInWindow
from undulog.analysis.parts.ground_contact.result import LinkContact
from undulog.analysis.parts.joints.result import JointResult
from undulog.analysis.parts.tracking.result import JointTracking
from undulog.analysis.results.analysis import KEYS_OF_THEIR_OWN, Analysis, interval_key
from undulog.analysis.results.comparison import Comparison
from undulog.analysis.results.experiment import Experiment
from undulog.analysis.results.oscillators import ClosedLoop

VERSION = 1

RESULTS: dict[str, tuple[type, str]] = {
    "analysis": (Analysis, "undulog analyse FILE --json"),
    "experiment": (Experiment, "undulog analyse FILE FILE ... --json"),
    "comparison": (Comparison, "undulog compare A B --json"),
    "episodes": (EpisodesResult, "undulog analyse DATASET --json"),
    "prediction": (ClosedLoop, "undulog predict FILE --eps EPS --json"),
}
"""Name of each result to its dataclass and the command that prints it."""

_FLAT = frozenset(
    {
        BodyPoint,
        GaitFacts,
        GaitWindow,
        GroupFacts,
        JointInWindow,
        JointResult,
        Transport,
        BodyTravel,
        BodyWave,
        JointFrequencyResponse,
        JointTracking,
        JointMotion,
        LinkContact,
        LocalWaveNumber,
        Serpenoid,
        ShapeMode,
    }
)
"""Records of a session whose estimates are two keys each, as :meth:`.Analysis.to_dict` has them."""

_DERIVED: dict[type, dict[str, Any]] = {
    Artefact: {"about": {"type": "string"}},
    BodyWave: {"direction": {"enum": ["first-to-last", "last-to-first", "undecided"]}},
}
_INTERVAL = {
    "description": "Low and high end of the 95 % interval.",
    "type": ["array", "null"],
    "items": {"type": "number"},
    "minItems": 2,
    "maxItems": 2,
}
_PLAIN: dict[Any, str] = {float: "number", int: "integer", str: "string", bool: "boolean"}
_ATTRIBUTES = re.compile(r"^Attributes:\n(.*?)(?=^\S|\Z)", re.MULTILINE | re.DOTALL)
_ENTRY = re.compile(r"^    (\w+): (.*?)(?=^    \w+: |\Z)", re.MULTILINE | re.DOTALL)
_ROLE = re.compile(r":\w+:`~?\.?([^`]*)`|``([^`]*)``")


def result_schema(name: str) -> dict[str, Any]:
    """Return the JSON Schema (draft 2020-12) of a result.

    Args:
        name: One of :data:`RESULTS`.
    """
    cls, command = RESULTS[name]
    writer = _Writer(flat=issubclass(cls, Analysis))
    root = writer.record(cls)
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "$id": f"urn:undulog:{name}:{VERSION}",
        "title": f"What {command} prints, version {VERSION}",
        **root,
        "$defs": dict(sorted(writer.definitions.items())),
    }


class _Writer:
    """Writes records; an estimate is two keys in those of a session, an object elsewhere."""

    def __init__(self, *, flat: bool) -> None:
        self.definitions: dict[str, Any] = {}
        self._names: dict[tuple[type, bool], str] = {}
        self._flat = flat

    def record(self, cls: type) -> dict[str, Any]:
        hints = get_type_hints(cls)
        described = _descriptions(cls)
        properties: dict[str, Any] = {}
        for field in fields(cls):
            if field.metadata == KEYS_OF_THEIR_OWN:
                continue
            about = {"description": described[field.name]} if field.name in described else {}
            if self._flat and cls in _FLAT and hints[field.name] is Estimate:
                properties[field.name] = about | {"type": ["number", "null"]}
                properties[interval_key(field.name)] = _INTERVAL
            else:
                properties[field.name] = about | self._type(hints[field.name])
        if self._flat:
            properties |= _DERIVED.get(cls, {})
        return {
            "description": _text(inspect.cleandoc(cls.__doc__ or "").partition("\n\n")[0]),
            "type": "object",
            "properties": properties,
            "required": sorted(properties),
        }

    def _type(self, hint: Any) -> dict[str, Any]:
        if hint is Any or hint in _PLAIN:
            return {} if hint is Any else {"type": _PLAIN[hint]}
        arguments = get_args(hint)
        origin = get_origin(hint)
        if origin in (Union, UnionType):
            return self._one_of(arguments)
        if origin is tuple:
            return self._array(arguments)
        if origin is dict:
            return {"type": "object", "additionalProperties": self._type(arguments[1])}
        if not (is_dataclass(hint) or issubclass(hint, Enum)):
            raise TypeError(f"a result has a field of {hint}, which has no JSON Schema here")
        return self._class(cast("type[Any]", hint))

    def _class(self, hint: type[Any]) -> dict[str, Any]:
        if issubclass(hint, Enum):
            return {"enum": [member.value for member in hint]}
        kinds = [self._reference(kind) for kind in _kinds(hint)]
        return kinds[0] if len(kinds) == 1 else {"anyOf": kinds}

    def _one_of(self, arguments: tuple[Any, ...]) -> dict[str, Any]:
        kinds = [self._type(argument) for argument in arguments if argument is not NoneType]
        if NoneType not in arguments:
            return {"anyOf": kinds}
        if len(kinds) == 1 and isinstance(kinds[0].get("type"), str):
            return kinds[0] | {"type": [kinds[0]["type"], "null"]}
        return {"anyOf": [*kinds, {"type": "null"}]}

    def _array(self, arguments: tuple[Any, ...]) -> dict[str, Any]:
        if len(arguments) == 2 and arguments[1] is Ellipsis:
            return {"type": "array", "items": self._type(arguments[0])}
        return {
            "type": "array",
            "prefixItems": [self._type(argument) for argument in arguments],
            "minItems": len(arguments),
            "maxItems": len(arguments),
        }

    def _reference(self, cls: type) -> dict[str, Any]:
        outside, self._flat = self._flat, self._flat or issubclass(cls, Analysis)
        key = (cls, self._flat and cls in _FLAT)
        if key not in self._names:
            self._names[key] = name = self._free_name(cls)
            self.definitions[name] = {}
            self.definitions[name] = self.record(cls)
        self._flat = outside
        return {"$ref": f"#/$defs/{self._names[key]}"}

    def _free_name(self, cls: type) -> str:
        """Return the name of a record, with that of its module where another record has it."""
        name = cls.__name__
        if name not in self.definitions:
            return name
        if any(record is cls for record, _ in self._names):
            return f"{name}Nested"
        return cls.__module__.rpartition(".")[2].title().replace("_", "") + name


def _kinds(cls: type[Any]) -> list[type[Any]]:
    """Return the record and those that refine it, the most special first."""
    refined = [kind for subclass in cls.__subclasses__() for kind in _kinds(subclass)]
    return [*refined, cls]


def _descriptions(cls: type) -> dict[str, str]:
    """Return what the docstrings of a record and its bases tell of each field."""
    described: dict[str, str] = {}
    for base in reversed(cls.__mro__):
        if section := _ATTRIBUTES.search(inspect.cleandoc(base.__doc__ or "")):
            described |= {name: _text(text) for name, text in _ENTRY.findall(section[1])}
    return described


def _text(text: str) -> str:
    plain = _ROLE.sub(lambda m: m[1] or m[2], " ".join(text.split()))
    return re.sub(r"\bNone\b", "null", plain)
