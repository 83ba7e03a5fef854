"""Inputs of Zenoh: the files named in a configuration file, and an environment variable."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from crkr.protocol.errors import Invalid

__all__ = ["FILE_SETTINGS", "is_panic", "named_files", "refusing_panics"]

_TLS: Final = "root_ca_certificate listen_certificate listen_private_key connect_certificate connect_private_key"
FILE_SETTINGS: Final = (
    *(f"transport/link/tls/{name}" for name in _TLS.split()),
    "transport/auth/usrpwd/dictionary_file",
)


def named_files(configuration: Path, setting: Callable[[str], str]) -> dict[str, str]:
    """The files' absolute paths by setting; a relative one starts at the configuration's folder.

    Zenoh itself starts at the working directory, so a robot's file would work in one folder only.

    Args:
        configuration: The configuration file.
        setting: Gives the JSON of one of its settings, "null" where it has none.

    Raises:
        Invalid: A file is missing.
    """
    named = {name: json.loads(setting(name)) for name in FILE_SETTINGS}
    paths = {name: (configuration.parent / path).absolute() for name, path in named.items() if path}
    for name, path in paths.items():
        if not path.is_file():
            raise Invalid(
                f"Zenoh configuration {configuration} names a file that is not there: "
                f"{name.rpartition('/')[2]} {str(path)!r}"
            )
    return {name: str(path) for name, path in paths.items()}


def is_panic(error: BaseException) -> bool:
    """Whether a Rust library panicked; its error is not an `Exception`."""
    return type(error).__name__ == "PanicException"


@contextmanager
def refusing_panics() -> Iterator[None]:
    """Context that opens a session. Zenoh panics if it cannot read ZENOH_RUNTIME.

    Raises:
        Invalid: Zenoh panicked.
    """
    try:
        yield
    except BaseException as error:
        if not is_panic(error):
            raise
        given = os.environ.get("ZENOH_RUNTIME")
        cause = "" if given is None else f"; look at ZENOH_RUNTIME, which is {given!r:.100}, or unset it"
        raise Invalid(f"Zenoh did not start{cause}: {error!s:.300}") from error
