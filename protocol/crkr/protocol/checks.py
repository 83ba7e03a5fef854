"""Checks of input: arrays that pass are read-only float64 copies, finite and of the right shape."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from typing import Any, Final

import numpy as np

from crkr.protocol.codec import Array, is_masked
from crkr.protocol.errors import Invalid, shown

__all__ = [
    "ROUNDING",
    "SINGLE_STEP",
    "choice",
    "cost_number",
    "depth",
    "entries",
    "finite_array",
    "flag",
    "integer",
    "number",
    "refuse_masked",
    "required",
    "shown",
    "text",
]

ROUNDING: Final = 1e-6  # of a range: a value this far outside is a rounding error and becomes the bound
SINGLE_STEP: Final = 2.0**-23  # of a number: the step from one float32 to the next
_SHORT: Final = 64


def refuse_masked(value: object, name: str, within: int = 2) -> None:
    """Raises `Invalid` for a masked array, or a list that holds one: numpy would use the masked values."""
    if is_masked(value):
        raise Invalid(f"{name} is a masked array; fill its gaps with NaN, or leave them out", details={"field": name})
    if within and isinstance(value, list | tuple):
        for entry in value:
            if not isinstance(entry, float | int):
                refuse_masked(entry, name, within - 1)


def required(message: Mapping[str, Any], field: str) -> Any:
    """The field's value; raises `Invalid`, which names the field."""
    if (type(message) is dict or isinstance(message, Mapping)) and field in message:
        return message[field]
    got = "" if isinstance(message, Mapping) else f" in a map; got {type(message).__name__}"
    raise Invalid(f"field {field!r} is required{got}", details={"field": field})


def entries(message: Mapping[str, Any], field: str) -> list[Any]:
    """The required field's value, a list; raises `Invalid`."""
    value = required(message, field)
    if not isinstance(value, list | tuple):
        raise Invalid(f"{field} must be a list; got {type(value).__name__}", details={"field": field})
    return list(value)


def depth(value: object, name: str) -> int:
    """Nesting depth of an array; raises `Invalid` where its rows differ in length."""
    try:
        return np.ndim(value)  # type: ignore[arg-type]  # whatever it is, numpy has an answer or a ValueError
    except (ValueError, RecursionError) as error:
        raise Invalid(f"{name} must be a regular array: {error}", details={"field": name}) from error


def _numbers(value: object, name: str) -> Array:
    """A float64 copy; None becomes NaN, and text, truth values and complex numbers are refused."""
    refuse_masked(value, name)
    raw = np.asarray(value)
    if raw.dtype.kind not in "iuf":
        given = raw.ravel().tolist() if raw.dtype.kind == "O" else [raw.dtype]
        strange = [entry for entry in given if entry is not None and (type(entry) is bool or not _is_real(entry))]
        if strange:
            raise TypeError(f"{shown(strange[0])} is not a number")
    return np.array(raw, dtype=np.float64)


def _is_real(value: object) -> bool:
    return isinstance(value, int | float | np.integer | np.floating)


def finite_array(value: object, name: str, shape: tuple[int | None, ...], *, allow_nan: bool = False) -> Array:
    """A read-only float64 copy of `value` with the given shape (None: any size).

    Raises:
        Invalid: Another shape, not numbers, or not finite.
    """
    if type(value) is np.ndarray and value.shape == shape and len(shape) == 1 and value.dtype == np.float64:
        vector: Array = value.copy()
        # The usual case. A finite sum has finite terms, and summing takes a fifth of numpy's time.
        if math.isfinite(sum(vector.tolist())) if len(vector) <= _SHORT else np.isfinite(vector).all():
            vector.setflags(write=False)
            return vector
    try:
        array = _numbers(value, name)
    except (TypeError, ValueError, OverflowError, RecursionError) as error:
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
    """A finite number in [low, high], and greater than `above` where given; raises `Invalid`."""
    if isinstance(value, bool) or not _is_real(value):
        raise Invalid(f"{name} must be a number; got {type(value).__name__}", details={"field": name})
    try:
        result = float(value)  # type: ignore[arg-type]  # it is a real number
    except OverflowError:  # a whole number beyond all floats
        result = math.inf
    if not math.isfinite(result) or not low <= result <= high or (above is not None and result <= above):
        wanted = f"in [{low}, {high}]" if above is None else f"above {above}, at most {high}"
        raise Invalid(f"{name} must be a finite number {wanted}; got {shown(value)}", details={"field": name})
    return result


def cost_number(value: object, name: str) -> float:
    """A cost in [0, 1]; a rounding error outside becomes the bound. Raises `Invalid`."""
    try:
        cost = number(value, name, low=-ROUNDING, high=1.0 + ROUNDING)
    except Invalid:
        return number(value, name, low=0.0, high=1.0)  # the message names the exact range
    return min(max(cost, 0.0), 1.0) + 0.0  # stores may lose the sign of -0.0


def integer(value: object, name: str, *, low: int = 0, high: int = 2**62) -> int:
    """A whole number in [low, high]; raises `Invalid`."""
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or not low <= value <= high:
        raise Invalid(f"{name} must be a whole number in [{low}, {high}]; got {shown(value)}", details={"field": name})
    return int(value)


def flag(value: object, name: str) -> bool:
    """True or False; raises `Invalid`."""
    if not isinstance(value, bool | np.bool_):
        raise Invalid(f"{name} must be true or false; got {shown(value)}", details={"field": name})
    return bool(value)


def text(value: object, name: str, *, longest: int = 4096) -> str:
    """Text of at most `longest` characters; raises `Invalid`."""
    if not isinstance(value, str) or len(value) > longest:
        raise Invalid(
            f"{name} must be text of at most {longest} characters; got {shown(value)}", details={"field": name}
        )
    if not value.isascii():
        try:
            value.encode()
        except UnicodeEncodeError as error:
            raise Invalid(f"{name} must be Unicode text; got {shown(value)}", details={"field": name}) from error
    return value


def choice(value: object, name: str, options: Collection[str]) -> str:
    """One of the options; raises `Invalid`, which lists them."""
    if not isinstance(value, str) or value not in options:
        listed = ", ".join(repr(option) for option in options)
        raise Invalid(f"{name} must be one of {listed}; got {shown(value)}", details={"field": name})
    return value
