"""Pictures of trials by MuJoCo's renderer, in software where there is no graphics card."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, Final, Self, final

import numpy as np

from crkr.client.cli.output_file import output_file
from crkr.protocol import Invalid
from crkr.sim_worker.pictures.film import Picture
from crkr.sim_worker.simulation.engine import make_renderer, mujoco
from crkr.sim_worker.simulation.simulation import Simulation
from crkr.sim_worker.table_tennis.pictures.trace import Motion

__all__ = ["SceneRenderer", "save_picture", "save_sequence"]

CAMERA: Final = "side"  # of the scene
HIT: Final = 3  # which of the six moments is the hit time
GHOST: Final = 0.3  # opacity of the arm at the other ones
PATH_RADIUS: Final = 0.007  # [m]
COMING: Final = np.array([1.0, 0.9, 0.55, 1.0], dtype=np.float32)
RETURNED: Final = np.array([1.0, 0.45, 0.05, 1.0], dtype=np.float32)


@final
class SceneRenderer:
    """Draws the scene. Use as a context manager; one object serves one thread.

    Args:
        simulation: The scene.
        width: [pixels].
        height: [pixels].

    Raises:
        Unsupported: This machine cannot render, or not as MUJOCO_GL demands.
    """

    def __init__(self, simulation: Simulation, width: int = 1280, height: int = 720) -> None:
        self._simulation = simulation
        self.size = (height, width)
        self._data: Any = mujoco.MjData(simulation.model)
        self._renderer: Any = make_renderer(simulation.model, height, width)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self._renderer.close()

    def frames(self, motion: Motion) -> Iterator[Picture]:
        """Draws every row of a motion in turn."""
        return (self.frame(motion, row) for row in range(len(motion.time)))

    def frame(self, motion: Motion, row: int) -> Picture:
        """The scene (h, w, 3) at one row of a motion, with the ball's path up to then."""
        self._pose(motion, row)
        self._renderer.update_scene(self._data, camera=CAMERA)
        self._draw_path(motion, row)
        return np.array(self._renderer.render())

    def exposure(self, motion: Motion, rows: Iterable[int], solid: int) -> Picture:
        """The scene (h, w, 3) at several rows of a motion at once, the arm see-through at all but `solid`."""
        self._pose(motion, solid)
        self._renderer.update_scene(self._data, camera=CAMERA)
        for row in rows:
            if row != solid:
                self._pose(motion, row)
                self._add_ghost()
        self._draw_path(motion, len(motion.time) - 1)
        return np.array(self._renderer.render())

    def _pose(self, motion: Motion, row: int) -> None:
        data = self._data
        data.qpos[:6], data.qpos[6:9] = motion.joints[row], motion.ball[row]
        data.qpos[9:13] = (1.0, 0.0, 0.0, 0.0)
        mujoco.mj_forward(self._simulation.model, data)

    def _add_ghost(self) -> None:
        """Adds the moving bodies in their current pose."""
        model, scene = self._simulation.model, self._renderer.scene
        first, moving = scene.ngeom, mujoco.mjtCatBit.mjCAT_DYNAMIC.value
        mujoco.mjv_addGeoms(model, self._data, mujoco.MjvOption(), mujoco.MjvPerturb(), moving, scene)
        for shape in scene.geoms[first : scene.ngeom]:
            if model.geom_bodyid[shape.objid] != model.body("ball").id:
                shape.rgba[3] *= GHOST

    def _draw_path(self, motion: Motion, until: int) -> None:
        """Adds the ball's path, in one colour before the hit time and another after it."""
        scene, capsule = self._renderer.scene, mujoco.mjtGeom.mjGEOM_CAPSULE
        for time, start, end in zip(motion.time[:until], motion.ball[:until], motion.ball[1:], strict=False):
            if scene.ngeom == scene.maxgeom:
                return
            colour = COMING if time < motion.hit_time else RETURNED
            shape = scene.geoms[scene.ngeom]
            mujoco.mjv_initGeom(shape, capsule, np.zeros(3), np.zeros(3), np.eye(3).ravel(), colour)
            mujoco.mjv_connector(shape, capsule, PATH_RADIUS, start, end)
            scene.ngeom += 1


def save_picture(artist: SceneRenderer, motion: Motion, path: Path) -> None:
    """Saves six moments in one picture as a .png, the arm solid at the hit time and see-through at the others.

    Raises:
        Invalid: Another suffix.
    """
    if path.suffix != ".png":
        raise Invalid(f"a picture is a .png; got {path.name}")
    from PIL import Image

    rows = _moments(motion)
    picture = Image.fromarray(artist.exposure(motion, rows, solid=rows[HIT]))
    with output_file(path) as partial:
        picture.save(partial)


def save_sequence(artist: SceneRenderer, motion: Motion, path: Path) -> None:
    """Saves six moments side by side in two rows, numbered and with their times, as a .png.

    Raises:
        Invalid: Another suffix.
    """
    if path.suffix != ".png":
        raise Invalid(f"a picture is a .png; got {path.name}")
    from PIL import Image

    names = {0: ": snapshot", HIT: ": hit time"}
    frames = [
        _captioned(artist.frame(motion, row), f"{index + 1}   {motion.time[row]:.2f} s{names.get(index, '')}")
        for index, row in enumerate(_moments(motion))
    ]
    picture = Image.fromarray(np.vstack([np.hstack(frames[:3]), np.hstack(frames[3:])]))
    with output_file(path) as partial:
        picture.save(partial)


def _moments(motion: Motion) -> list[int]:
    """Rows of the snapshot, two of the swing, the hit time, one of the return, and the end."""
    hit, end = motion.hit_time, float(motion.time[-1])
    times = (0.0, 0.5 * hit, 0.85 * hit, hit, 0.5 * (hit + end), end)
    return [int(np.abs(motion.time - time).argmin()) for time in times]


def _captioned(picture: Picture, text: str) -> Picture:
    from PIL import Image, ImageDraw, ImageFont

    image = Image.fromarray(picture)
    size = picture.shape[0] / 16
    ImageDraw.Draw(image).text((size / 2, size / 2), text, fill=(20, 30, 40), font=ImageFont.load_default(size))
    return np.asarray(image)
