"""The numbers of an observation by name, and which of them distinguish situations."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final, final

import numpy as np
from gymnasium import Space, spaces

from crkr.protocol import Array, Invalid

__all__ = ["Observation", "rounded_box"]

GREATEST: Final = 1e300  # size of an observed number
MOST_NUMBERS: Final = 1000  # of all entries
MOST: Final = 64  # numbers of a two-dimensional entry; a larger one is an image
REPEATS: Final = 0.03  # an entry is redundant if earlier entries explain all but this share
QUIET: Final = 10.0  # times narrower than the widest entry: reset noise, which gets a longer length-scale


@final
@dataclass(frozen=True, slots=True)
class Observation:
    """The numbers of an observation that are the state.

    Attributes:
        names: Of the numbers, the state's order.
        places: Place of each number: keys of its entry, and index in the entry.
        axes: The specification's `state`.
    """

    names: tuple[str, ...]
    places: tuple[tuple[tuple[str, ...], int], ...]
    axes: tuple[dict[str, Any], ...]

    @classmethod
    def choose(
        cls, space: Space[Any], samples: Sequence[Any], chosen: Sequence[str | int] | None, name: str
    ) -> Observation:
        """Chooses the numbers that vary between resets and are not functions of others.

        Args:
            space: Of observations.
            samples: Observations at reset.
            chosen: Names of numbers or of entries, or positions in a vector; None leaves out redundant ones.
            name: Of the environment, for messages.

        Raises:
            Invalid: An entry is an image or not numeric, or a chosen name does not exist.
        """
        labels, places = _listed(space, chosen, name)
        if not 0 < len(labels) <= MOST_NUMBERS:
            raise Invalid(
                f"{name}: its observation has {len(labels)} numbers to choose from, but a state is a short vector; "
                f'name those to keep: gymnasium_skill({name!r}, state=["..."])'
            )
        values = np.array([[_at(sample, place) for place in places] for sample in samples])
        strange = ~(np.abs(values) < GREATEST).all(axis=0)
        if strange.any():
            raise Invalid(
                f"{name}: {labels[int(np.argmax(strange))]} is not a finite number below {GREATEST:g} after every reset"
            )
        kept = _telling(values) if chosen is None else list(range(len(places)))
        if not kept:  # always the same situation: a state that is constant
            return cls(
                labels[:1], places[:1], ({"name": labels[0], "low": values[0, 0] - 1, "high": values[0, 0] + 1},)
            )
        low, high = rounded_box(values[:, kept])
        shortest = np.max(high - low) / (4 * QUIET)
        axes = [
            {"name": labels[index], "low": least, "high": most, "lengthscale": float(max((most - least) / 4, shortest))}
            for index, least, most in zip(kept, low.tolist(), high.tolist(), strict=True)
        ]
        return cls(tuple(labels[index] for index in kept), tuple(places[index] for index in kept), tuple(axes))

    def state(self, observation: Any) -> Array:
        """The state (d,) of an observation."""
        return np.array([_at(observation, place) for place in self.places])


def rounded_box(values: Array) -> tuple[Array, Array]:
    """The smallest box of (n, d) values on a coarse grid, so that every machine finds the same."""
    low, high = values.min(axis=0), values.max(axis=0)
    width = np.where(high > low, high - low, 1.0)
    grid = 10.0 ** np.floor(np.log10(width) - 1.0)
    outward = np.floor(low / grid - 0.01), np.ceil(high / grid + 0.01)
    return np.round(outward[0] * grid, 12), np.round(outward[1] * grid, 12)


def _listed(
    space: Space[Any], chosen: Sequence[str | int] | None, name: str
) -> tuple[tuple[str, ...], tuple[tuple[tuple[str, ...], int], ...]]:
    """Names and places of all numbers, or of the chosen ones in the order of the choice."""
    entries = sorted(_entries(space, ()), key=lambda entry: entry[0] != ("desired_goal",))  # first what a trial is for
    found: list[tuple[str, tuple[str, ...], int]] = []
    for keys, leaf in entries:
        label = ".".join(keys) or "observation"
        if chosen is not None and not any(isinstance(one, int) or one.startswith(label) for one in chosen):
            continue
        found += [(text, keys, index) for index, text in enumerate(_numbers(leaf, label, name))]
    if chosen is not None:
        found = [entry for one in chosen for entry in _named(found, one, name)]
    return tuple(label for label, _, _ in found), tuple((keys, index) for _, keys, index in found)


def _entries(space: Space[Any], keys: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], Space[Any]]]:
    if isinstance(space, spaces.Dict):
        for key, inner in space.spaces.items():
            yield from _entries(inner, (*keys, str(key)))
    else:
        yield keys, space


def _numbers(leaf: Space[Any], label: str, name: str) -> list[str]:
    """Names of an entry's numbers."""
    shape = leaf.shape or ()
    if not isinstance(leaf, spaces.Box | spaces.Discrete | spaces.MultiDiscrete | spaces.MultiBinary):
        kind = f"of {type(leaf).__name__}"
    elif len(shape) > 1 and np.prod(shape) > MOST:
        kind = f"an image {shape}"
    else:
        return [label] if not shape else [f"{label}_{index}" for index in range(int(np.prod(shape)))]
    raise Invalid(
        f"{name}: observation {label!r} is {kind}, but a state is a short vector of numbers; name the entries to keep: "
        f'gymnasium_skill({name!r}, state=["..."]), or wrap the environment by gymnasium.wrappers.TransformObservation'
    )


def _named(
    found: list[tuple[str, tuple[str, ...], int]], one: str | int, name: str
) -> list[tuple[str, tuple[str, ...], int]]:
    if isinstance(one, int) and 0 <= one < len(found):
        return [found[one]]
    named = [entry for entry in found if one in (entry[0], ".".join(entry[1]) or "observation")]
    if not named:
        listed = ", ".join(dict.fromkeys(".".join(keys) or "observation" for _, keys, _ in found)) or "none of numbers"
        raise Invalid(f"{name} has no observation {one!r}; its entries: {listed}; their numbers are named ENTRY_INDEX")
    return named


def _at(observation: Any, place: tuple[tuple[str, ...], int]) -> float:
    keys, index = place
    for key in keys:
        observation = observation[key]
    return float(np.ravel(observation)[index])


def _telling(values: Array) -> list[int]:
    """Columns that vary and are not nearly a linear function of the columns before them."""
    kept: list[int] = []
    for column in range(values.shape[1]):
        own = values[:, column]
        if np.ptp(own) <= 1e-9 * (1.0 + np.abs(own).max()):
            continue
        known = np.column_stack([values[:, kept], np.ones(len(own))])
        fitted, *_ = np.linalg.lstsq(known, own, rcond=None)
        if np.std(own - known @ fitted) > REPEATS * np.std(own):
            kept.append(column)
    return kept
