"""The named axes of a task: states, goals and measured outcomes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final, final

from crkr.protocol.checks import choice, number, text
from crkr.protocol.errors import Invalid

__all__ = ["GoalDimension", "OutcomeEntry", "StateDimension"]

AIMS: Final = ("equal", "at_least", "at_most")


def _given(entry: Mapping[str, Any], field: str, where: str) -> Any:
    """The required field's value; the error names the coordinate that lacks it."""
    if field not in entry:
        raise Invalid(f"field {field!r} is required in {where}", details={"field": f"{where}.{field}"})
    return entry[field]


def _box(entry: Mapping[str, Any], where: str) -> tuple[float, float]:
    return number(_given(entry, "low", where), f"{where}.low"), number(_given(entry, "high", where), f"{where}.high")


def _name(entry: object, where: str) -> tuple[Mapping[str, Any], str, str]:
    if not isinstance(entry, Mapping):
        raise Invalid(f"{where} must be a map with a name; got {type(entry).__name__}")
    name = text(_given(entry, "name", where), f"{where}.name", longest=64)
    if not name:
        raise Invalid(f"{where}.name must not be empty")
    return entry, name, text(entry.get("unit", ""), f"{where}.unit", longest=32)


@final
@dataclass(frozen=True, slots=True)
class StateDimension:
    """One coordinate of the state; its range scales distances and refuses nothing.

    Attributes:
        name: Field's name, unique in the spec.
        unit: Unit of the values, e.g. "m".
        low: Usual minimum [unit].
        high: Usual maximum [unit].
        lengthscale: Distance over which goals change [unit]; (high - low) / 4 unless given.
    """

    name: str
    unit: str
    low: float
    high: float
    lengthscale: float

    @classmethod
    def from_dict(cls, entry: object, where: str) -> StateDimension:
        """Reads one entry of a spec's `state`; raises `Invalid`."""
        entry, name, unit = _name(entry, where)
        low, high = _box(entry, where)
        if not low < high:
            raise Invalid(f"{where} ({name}) needs low < high; got [{low}, {high}]")
        lengthscale = number(entry.get("lengthscale", (high - low) / 4), f"{where}.lengthscale", above=0.0)
        return cls(name, unit, low, high, lengthscale)


@final
@dataclass(frozen=True, slots=True)
class GoalDimension:
    """One meta-parameter; its bounds are hard and inclusive.

    Attributes:
        name: Field's name, unique in the spec.
        unit: Unit of the values, e.g. "rad".
        low: Smallest goal allowed [unit].
        high: Largest goal allowed [unit].
        scale: Typical difference between good goals [unit]; (high - low) / 4 unless given, 1 if low = high.
    """

    name: str
    unit: str
    low: float
    high: float
    scale: float

    @classmethod
    def from_dict(cls, entry: object, where: str) -> GoalDimension:
        """Reads one entry of a spec's `goal`; raises `Invalid`."""
        entry, name, unit = _name(entry, where)
        low, high = _box(entry, where)
        if low > high:
            raise Invalid(f"{where} ({name}) needs low <= high; got [{low}, {high}]")
        usual = (high - low) / 4 or 1.0  # a single value has no scale
        scale = number(entry.get("scale", usual), f"{where}.scale", above=0.0)
        return cls(name, unit, low, high, scale)


@final
@dataclass(frozen=True, slots=True)
class OutcomeEntry:
    """One signed number that a skill can measure after a trial.

    Attributes:
        name: Field's name, unique in the spec.
        unit: Unit of the values, e.g. "m".
        target: What a perfect trial measures [unit].
        tolerance: Deviation from the target that still succeeds [unit].
        group: Entries of one group are observed together.
        aim: "equal" to the target; "at_least" or "at_most" where more or less is as good, as with a clearance.
    """

    name: str
    unit: str
    target: float
    tolerance: float
    group: str
    aim: str = "equal"

    @classmethod
    def from_dict(cls, entry: object, where: str) -> OutcomeEntry:
        """Reads one entry of a spec's `outcome`; raises `Invalid`."""
        entry, name, unit = _name(entry, where)
        target = number(entry.get("target", 0.0), f"{where}.target")
        tolerance = number(_given(entry, "tolerance", where), f"{where}.tolerance", above=0.0)
        group = text(entry.get("group", name), f"{where}.group", longest=64)
        aim = choice(entry.get("aim", "equal"), f"{where}.aim", AIMS)
        return cls(name, unit, target, tolerance, group, aim)
