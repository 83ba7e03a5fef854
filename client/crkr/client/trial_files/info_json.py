"""A trial's `info` as JSON, without loss.

What JSON cannot express (bytes, arrays, numbers that are not finite) becomes {"$msgpack": base64 of its msgpack}.
"""

from __future__ import annotations

import base64
import binascii
import json
import math
from collections.abc import Mapping
from typing import Any, Final

from crkr.protocol import Invalid, pack, unpack
from crkr.protocol.checks import shown
from crkr.protocol.info import MAX_INFO_BYTES, MAX_INFO_DEPTH, check_info, restored_info

__all__ = ["info_from_json", "info_to_json", "reported_info"]

_ODD: Final = "$msgpack"


def info_to_json(info: Mapping[str, Any]) -> str:
    """One line of JSON."""
    return json.dumps({key: _plain(value) for key, value in info.items()}, ensure_ascii=False, allow_nan=False)


def info_from_json(text: str) -> dict[str, Any]:
    """Reads what `info_to_json` made, or any JSON object.

    Raises:
        Invalid: Not JSON, not an object, or invalid base64.
    """
    try:
        value = json.loads(text)
        if isinstance(value, dict):
            return {key: _restored(entry) for key, entry in value.items()}
    except (ValueError, RecursionError, binascii.Error) as error:
        raise Invalid(f"info must be JSON: {error}", details={"field": "info"}) from error
    raise Invalid(f"info must be a JSON object; got {shown(text)}", details={"field": "info"})


def reported_info(text: str) -> tuple[dict[str, Any], bool]:
    """The info of a row's JSON, and whether it had to be kept as bytes.

    Earlier versions accepted info that is refused now, e.g. nested hundreds deep. It becomes {"$msgpack": bytes}.

    Raises:
        Invalid: No version accepts it, or it is not a JSON object.
    """
    if not text:
        return {}, False
    info = restored_info(info_from_json(text))
    try:
        return check_info(info), False
    except Invalid as error:
        try:
            packed = pack(info)
        except Invalid:
            raise error from None
        if len(packed) > MAX_INFO_BYTES:
            raise
        return check_info({_ODD: packed}), True


def _plain(value: Any, depth: int = 1) -> Any:
    if depth <= MAX_INFO_DEPTH:  # deeper info, from an earlier version, becomes bytes
        if isinstance(value, Mapping) and _ODD not in value and all(isinstance(key, str) for key in value):
            return {key: _plain(entry, depth + 1) for key, entry in value.items()}
        if isinstance(value, list | tuple):
            return [_plain(entry, depth + 1) for entry in value]
    if value is None or isinstance(value, bool | int | str) or (isinstance(value, float) and math.isfinite(value)):
        return value
    return {_ODD: base64.b64encode(pack({_ODD: value})).decode()}


def _restored(value: Any) -> Any:
    if isinstance(value, list):
        return [_restored(entry) for entry in value]
    if not isinstance(value, dict):
        return value
    if value.keys() == {_ODD} and isinstance(value[_ODD], str):
        return unpack(base64.b64decode(value[_ODD], validate=True), depth=None).get(_ODD)
    return {key: _restored(entry) for key, entry in value.items()}
