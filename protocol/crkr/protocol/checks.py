"""Checks at the edge: what passes is float64, finite, of the right shape, read-only and nobody else's."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from typing import Any

import numpy as np
from crkr.protocol.codec import Array
from crkr.protocol.errors import Invalid

__all__ = ["choice", "finite_array", "flag", "integer", "number", "required", "text"]


def required(message: Mapping[str, Any], field: str) -> Any:
    """The field's value, or `Invalid` that names it."""
    if field not in message:
        raise Invalid(f"field {field!r} is required", details={"field": field})
    return message[field]


def finite_array(value: object, name: str, shape: tuple[int | None, ...], *, allow_nan: bool = False) -> Array:
    """A read-only float64 copy of `value` with the given shape (None: any size).

    Raises:
        Invalid: Another shape, not numbers, or not finite.
    """
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise Invalid(f"{name} must be an array of numbers: {error}", details={"field": name}) from error
    fits = array.ndim == len(shape) and all(want in (None, have) for want, have in zip(shape, array.shape, strict=True))
    if not fits:
        wanted = (
            "("
            + ", ".join("n" if size is None else str(size) for size in shape)
            + ("," if len(shape) == 1 else "")
            + ")"
        )
        raise Invalid(f"{name} must have shape {wanted}; got {array.shape}", details={"field": name})
    bad = np.isinf(array) if allow_nan else ~np.isfinite(array)
    if bad.any():
        index = tuple(int(i) for i in np.argwhere(bad)[0])
        raise Invalid(f"{name} must be finite; got {array[index]} at {list(index)}", details={"field": name})
    array.setflags(write=False)
    return array


def number(
    value: object,
    name: str,
    *,
    low: float = -math.inf,
    high: float = math.inf,
    above: float | None = None,
) -> float:
    """A finite number in [low, high], and greater than `above` where given; or `Invalid`."""
    if isinstance(value, bool) or not isinstance(value, int | float | np.integer | np.floating):
        raise Invalid(f"{name} must be a number; got {type(value).__name__}", details={"field": name})
    result = float(value)
    if not math.isfinite(result) or not low <= result <= high or (above is not None and result <= above):
        wanted = f"above {above}" if above is not None else f"in [{low}, {high}]"
        raise Invalid(f"{name} must be a finite number {wanted}; got {value}", details={"field": name})
    return result


def integer(value: object, name: str, *, low: int = 0, high: int = 2**62) -> int:
    """A whole number in [low, high]; or `Invalid`."""
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or not low <= value <= high:
        raise Invalid(f"{name} must be a whole number in [{low}, {high}]; got {value!r:.80}", details={"field": name})
    return int(value)


def flag(value: object, name: str) -> bool:
    """True or False; or `Invalid`."""
    if not isinstance(value, bool | np.bool_):
        raise Invalid(f"{name} must be true or false; got {value!r:.80}", details={"field": name})
    return bool(value)


def text(value: object, name: str, *, longest: int = 4096) -> str:
    """Text of at most `longest` characters; or `Invalid`."""
    if not isinstance(value, str) or len(value) > longest:
        raise Invalid(
            f"{name} must be text of at most {longest} characters; got {value!r:.80}", details={"field": name}
        )
    return value


def choice(value: object, name: str, options: Collection[str]) -> str:
    """One of the options; or `Invalid` that lists them."""
    if not isinstance(value, str) or value not in options:
        listed = ", ".join(repr(option) for option in options)
        raise Invalid(f"{name} must be one of {listed}; got {value!r:.80}", details={"field": name})
    return value
