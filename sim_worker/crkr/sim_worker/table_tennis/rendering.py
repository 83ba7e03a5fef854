"""Pictures of trials by MuJoCo's renderer, in software where there is no graphics card."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self, final

import mujoco
import numpy as np
from mujoco.rendering.classic import gl_context
from numpy.typing import NDArray

from crkr.protocol import Invalid, Unsupported
from crkr.sim_worker.table_tennis.film import Picture
from crkr.sim_worker.table_tennis.simulation import Simulation
from crkr.sim_worker.table_tennis.tracing import Motion

__all__ = ["Artist", "save_picture", "save_sequence"]

EXPOSURES: Final = 6  # moments shown in one picture
THRESHOLD: Final = 20  # difference from the still scene that counts as moving [of 255]
TRAIL_RADIUS: Final = 0.006  # [m]
TRAIL_COLOUR: Final = np.array([1.0, 0.6, 0.1, 0.6], dtype=np.float32)


@final
class Artist:
    """Draws the scene. Use as a context manager; one object serves one thread.

    Args:
        simulation: The scene.
        width: [pixels].
        height: [pixels].

    Raises:
        Unsupported: This machine cannot render, not even in software.
    """

    def __init__(self, simulation: Simulation, width: int = 1280, height: int = 720) -> None:
        self._simulation = simulation
        self.size = (height, width)
        self._data: Any = mujoco.MjData(simulation.model)
        try:
            _prefer_headless()
            self._renderer: Any = mujoco.Renderer(simulation.model, height, width)
        except Exception as error:  # each backend raises its own
            raise Unsupported(
                f"no way to render ({error}); install EGL (libegl1 and a Mesa driver) or set MUJOCO_GL=osmesa"
            ) from error

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._renderer.close()

    def frames(self, motion: Motion) -> Iterator[Picture]:
        """Every row of a motion, one after the other."""
        return (self.frame(motion, row) for row in range(len(motion.time)))

    def frame(self, motion: Motion, row: int) -> Picture:
        """The scene (h, w, 3) at one row of a motion, with the ball's path up to then."""
        data = self._data
        data.qpos[:6], data.qpos[6:9] = motion.joints[row], motion.ball[row]
        data.qpos[9:13] = (1.0, 0.0, 0.0, 0.0)
        mujoco.mj_forward(self._simulation.model, data)
        self._renderer.update_scene(data, camera="side")
        for point in motion.ball[:row]:
            self._mark(point)
        return np.array(self._renderer.render())

    def _mark(self, point: NDArray[np.float64]) -> None:
        scene = self._renderer.scene
        if scene.ngeom < scene.maxgeom:
            size, turn = np.full(3, TRAIL_RADIUS), np.eye(3).ravel()
            sphere = mujoco.mjtGeom.mjGEOM_SPHERE
            mujoco.mjv_initGeom(scene.geoms[scene.ngeom], sphere, size, point, turn, TRAIL_COLOUR)
            scene.ngeom += 1


def _prefer_headless() -> None:
    """Renders through EGL where there is no display and nothing else was asked for.

    MuJoCo decides by environment when it is first imported, which is too early: workers that never draw need no EGL.
    """
    if sys.platform == "linux" and not os.environ.get("DISPLAY") and not os.environ.get("MUJOCO_GL"):
        import mujoco.egl

        gl_context.GLContext = mujoco.egl.GLContext


def save_picture(artist: Artist, motion: Motion, path: Path) -> None:
    """Saves one picture of several moments, what moves drawn over what does not, as a .png.

    Raises:
        Invalid: Another suffix.
    """
    if path.suffix != ".png":
        raise Invalid(f"a picture is a .png; got {path.name}")
    from matplotlib.image import imsave

    rows = np.linspace(0, len(motion.time) - 1, EXPOSURES).astype(int).tolist()
    moments = np.array([artist.frame(motion, row) for row in rows], dtype=np.float64)  # (e, h, w, 3)
    still = np.median(moments, axis=0)
    composed = still
    for moment in moments:
        moved = np.abs(moment - still).max(axis=2, keepdims=True) > THRESHOLD
        composed = np.where(moved, 0.35 * composed + 0.65 * moment, composed)
    imsave(path, composed.astype(np.uint8))


def save_sequence(artist: Artist, motion: Motion, path: Path) -> None:
    """Saves six moments one beside the other, numbered and with their times, in two rows, as a .png.

    They are the snapshot, two of the swing, the hit time, one of the return, and the end.

    Raises:
        Invalid: Another suffix.
    """
    if path.suffix != ".png":
        raise Invalid(f"a picture is a .png; got {path.name}")
    from PIL import Image

    hit, end = motion.hit_time, float(motion.time[-1])
    moments = (0.0, 0.5 * hit, 0.85 * hit, hit, 0.5 * (hit + end), end)
    names = {0: ": snapshot", 3: ": hit time"}
    frames = []
    for index, moment in enumerate(moments):
        row = int(np.abs(motion.time - moment).argmin())
        frames.append(_captioned(artist.frame(motion, row), f"{index + 1}   {moment:.2f} s{names.get(index, '')}"))
    Image.fromarray(np.vstack([np.hstack(frames[:3]), np.hstack(frames[3:])])).save(path)


def _captioned(picture: Picture, text: str) -> Picture:
    from PIL import Image, ImageDraw, ImageFont

    image = Image.fromarray(picture)
    size = picture.shape[0] / 16
    ImageDraw.Draw(image).text((size / 2, size / 2), text, fill=(20, 30, 40), font=ImageFont.load_default(size))
    return np.asarray(image)
