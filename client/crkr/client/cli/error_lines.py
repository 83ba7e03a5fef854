"""Expected errors of a command become one line on standard error and an exit status."""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable
from contextlib import suppress
from importlib.util import find_spec
from typing import Final

import typer

from crkr.client.cli.standard_streams import READER_GONE, discard_output
from crkr.protocol import CrkrError, printable

__all__ = ["guarded", "later_python", "reason_missing", "require"]

# Import name -> extras that install it; the command's own extra is preferred, else the first.
_EXTRAS: Final = {
    "PIL": ("sim",),
    "av": ("film",),
    "botorch": ("rivals",),
    "clarabel": ("sim", "gymnasium"),
    "coal": ("sim",),
    "gymnasium": ("gymnasium",),
    "joblib": ("experiments",),
    "matplotlib": ("sim",),
    "mujoco": ("sim", "gymnasium"),
    "nevergrad": ("rivals",),
    "numba": ("fast",),
    "onnx": ("onnx",),
    "optuna": ("rivals",),
    "pinocchio": ("sim",),
    "psycopg": ("postgres",),
    "prometheus_client": ("server",),
    "pyarrow": ("export",),
    "ray": ("ray",),
    "rerun": ("dashboard",),
    "ribs": ("rivals",),
    "scipy": ("server", "mirror", "sim", "experiments"),
    "sklearn": ("experiments",),
    "stable_baselines3": ("rivals",),
    "starlette": ("web",),
    "uvicorn": ("web",),
}
_PYTHON: Final = (3, 11)  # of all parts but the client
_EXTRA_OF_PART: Final = {
    "client": "mirror",
    "server": "server",
    "sim_worker": "sim",
    "dashboard": "dashboard",
    "experiments": "experiments",
}


def guarded(function: Callable[..., object], command: str, module: str) -> Callable[..., object]:
    """Wraps a command: expected errors exit with status 1 (130 when interrupted); defects keep their traceback."""

    @functools.wraps(function)
    def run(*args: object, **kwargs: object) -> object:
        try:
            return function(*args, **kwargs)
        except CrkrError as error:
            raise _failed(error.message) from error
        except ModuleNotFoundError as error:
            if (error.name or "").split(".")[0] not in _EXTRAS:
                raise
            raise _failed(reason_missing(error, command, module)) from error
        except BrokenPipeError as error:  # the reader closed the output
            discard_output()
            raise typer.Exit(READER_GONE) from error
        except OSError as error:
            raise _failed(str(error)) from error
        except KeyboardInterrupt as error:
            with suppress(OSError):
                typer.echo("interrupted", err=True)
            raise typer.Exit(130) from error

    return run


def require(*packages: str) -> None:
    """Checks for packages that a child process will import, so that the command names the missing one.

    Raises:
        ModuleNotFoundError: For the first package that is not installed.
    """
    for package in packages:
        if find_spec(package) is None:
            raise ModuleNotFoundError(f"No module named {package!r}", name=package)


def later_python(command: str, module: str) -> str | None:
    """Why a command cannot run on this Python, which only the client's commands may; None if it can."""
    package, part = [*module.split("."), "", ""][:2]
    if sys.version_info >= _PYTHON or package != "crkr" or part == "client" or part not in _EXTRA_OF_PART:
        return None
    return f"crkr {command} needs Python 3.11 or newer; this is {sys.version_info[0]}.{sys.version_info[1]}"


def reason_missing(error: Exception, command: str, module: str) -> str:
    """Which extra to install for a command that lacks a package."""
    package = (getattr(error, "name", None) or "").split(".")[0]
    extras = _EXTRAS.get(package)
    if extras is None:
        return f"crkr {command} cannot be loaded: {error}"
    own = _EXTRA_OF_PART.get([*module.split("."), ""][1], "")
    extra = own if own in extras else extras[0]
    return f"crkr {command} needs the extra '{extra}': pip install 'crkr[{extra}]'"


def _failed(message: str) -> typer.Exit:
    with suppress(OSError):  # standard error may be closed
        typer.echo(f"error: {printable(message)}", err=True)
    return typer.Exit(1)
