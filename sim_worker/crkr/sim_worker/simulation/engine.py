"""Imports MuJoCo without OpenGL, whatever MUJOCO_GL says; only a renderer loads OpenGL."""

from __future__ import annotations

import importlib
import os
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any, Final

from crkr.protocol import Unsupported

__all__ = ["Rollout", "make_renderer", "mujoco"]

ASKED: Final = os.environ.get("MUJOCO_GL", "").strip().lower()
OFF: Final = ("disable", "disabled", "off", "false", "0")
ANY: Final = ("", "enable", "enabled", "on", "true", "1")
GLFW: Final = "mujoco.glfw"
BACKENDS: Final = {"egl": "mujoco.egl", "osmesa": "mujoco.osmesa", "glfw": GLFW, "glx": GLFW}


@contextmanager
def _without_opengl() -> Iterator[None]:
    """Hides MUJOCO_GL during the import, which would fail if its backend is missing."""
    before = os.environ.get("MUJOCO_GL")
    os.environ["MUJOCO_GL"] = "disable"
    try:
        yield
    finally:
        if before is None:
            del os.environ["MUJOCO_GL"]
        else:
            os.environ["MUJOCO_GL"] = before


with _without_opengl():
    import mujoco
    from mujoco.rendering.classic import gl_context
    from mujoco.rollout import Rollout


with suppress(Exception):  # for skills that draw by themselves; `make_renderer` reports errors
    if ASKED not in OFF:
        gl_context.GLContext = importlib.import_module(BACKENDS["glfw" if ASKED in ANY else ASKED]).GLContext


def make_renderer(model: Any, height: int, width: int) -> Any:
    """MuJoCo's renderer with the backend of MUJOCO_GL, else of the display, else EGL.

    Raises:
        Unsupported: This machine cannot render so.
    """
    if ASKED in OFF:
        raise Unsupported(f"MUJOCO_GL={ASKED} switches rendering off; unset it to draw")
    if ASKED not in (*ANY, *BACKENDS):
        raise Unsupported(f"MUJOCO_GL={ASKED} cannot be used here; unset it, or name one of {', '.join(BACKENDS)}")
    # Only one: after a failure, a second backend would abort the process in MuJoCo.
    backend = BACKENDS[ASKED] if ASKED in BACKENDS else GLFW if _has_display() else BACKENDS["egl"]
    try:
        if backend == GLFW and not _has_display():
            raise Unsupported("no display can be opened")
        return _renderer(backend, model, height, width)
    except Exception as error:  # each backend raises its own
        reason = (str(error).strip() or type(error).__name__).splitlines()[0][:200]
        if ASKED in BACKENDS:
            raise Unsupported(f"MUJOCO_GL={ASKED} cannot be used here ({reason}); unset it, or name another") from error
        advice = "install EGL (libegl1 and a Mesa driver) or set MUJOCO_GL=osmesa"
        raise Unsupported(f"no way to render ({reason}); {advice}") from error


def _has_display() -> bool:
    """Whether a window could be opened: DISPLAY may name a display that is gone."""
    if sys.platform == "linux" and not os.environ.get("DISPLAY"):
        return False
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            return bool(importlib.import_module(GLFW).glfw.init())
        except ImportError:
            return False


def _renderer(backend: str, model: Any, height: int, width: int) -> Any:
    os.environ.pop("PYOPENGL_PLATFORM", None)  # each backend sets its own value and refuses others
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # GLFW warns before it raises
        gl_context.GLContext = importlib.import_module(backend).GLContext
        return mujoco.Renderer(model, height, width)
