"""Pictures of trials by MuJoCo's renderer, in software where there is no graphics card.

Needs only a skill's shapes and a trial's trace.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Any, Final, Self, final

import numpy as np

from crkr.protocol import Array, Geom, Trace
from crkr.sim_worker.pictures.film import Picture
from crkr.sim_worker.simulation.engine import make_renderer, mujoco
from crkr.sim_worker.skill import Film

__all__ = ["SceneRenderer"]

GHOST: Final = 0.3  # opacity of moving bodies at all moments but one
PATH_RADIUS: Final = 0.007  # [m]
BEFORE: Final = np.array([1.0, 0.9, 0.55, 1.0], dtype=np.float32)
AFTER: Final = np.array([1.0, 0.45, 0.05, 1.0], dtype=np.float32)
HALF_VIEW: Final = np.deg2rad(25.0)  # half the camera's vertical angle of view
MARGIN: Final = 1.2  # share of the picture around the motion
FLAT: Final = 0.1  # a flatter motion is seen from above
WORLD: Final = "world"


@final
class SceneRenderer:
    """Draws a trial. Use as a context manager; one object serves one thread.

    Args:
        shapes: Of the skill.
        film: The trial's motion.
        width: [pixels].
        height: [pixels].

    Raises:
        Unsupported: This machine cannot render, or not as MUJOCO_GL demands.
    """

    def __init__(self, shapes: Sequence[Geom], film: Film, width: int = 1280, height: int = 720) -> None:
        self._trace = film.trace
        self._moment = film.moment
        self._model: Any = _model(shapes, film.trace, width, height)
        self._data: Any = mujoco.MjData(self._model)
        self._renderer: Any = make_renderer(self._model, height, width)
        self._camera = _camera(film.trace, width / height)
        positions, quaternions = film.trace.positions, film.trace.quaternions
        still = (np.ptp(positions, axis=0) < 1e-9).all(axis=1) & (np.ptp(quaternions, axis=0) < 1e-9).all(axis=1)
        names = film.trace.bodies
        self._still = {name for name, rests in zip(names, still, strict=True) if rests}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self._renderer.close()

    def frames(self) -> Iterator[Picture]:
        """Draws every row of the motion in turn."""
        return (self.frame(row) for row in range(len(self._trace.time)))

    def frame(self, row: int) -> Picture:
        """The scene (h, w, 3) at one row of the motion, with the paths up to then."""
        row = range(len(self._trace.time))[row]
        self._pose(row)
        self._renderer.update_scene(self._data, camera=self._camera)
        self._draw_paths(row)
        return np.array(self._renderer.render())

    def exposure(self, rows: Iterable[int], solid: int) -> Picture:
        """The scene (h, w, 3) at several rows of the motion at once, transparent except at `solid`."""
        self._pose(solid)
        self._renderer.update_scene(self._data, camera=self._camera)
        for row in rows:
            if row != solid:
                self._pose(row)
                self._add_ghost()
        self._draw_paths(len(self._trace.time) - 1)
        return np.array(self._renderer.render())

    def _pose(self, row: int) -> None:
        poses = np.concatenate([self._trace.positions[row], self._trace.quaternions[row][:, [3, 0, 1, 2]]], axis=1)
        self._data.qpos[:] = poses.ravel()
        mujoco.mj_forward(self._model, self._data)

    def _add_ghost(self) -> None:
        """Adds the moving bodies in their current pose; those with a path stay solid."""
        model, scene = self._model, self._renderer.scene
        first, moving = scene.ngeom, mujoco.mjtCatBit.mjCAT_DYNAMIC.value
        mujoco.mjv_addGeoms(model, self._data, mujoco.MjvOption(), mujoco.MjvPerturb(), moving, scene)
        for shape in scene.geoms[first : scene.ngeom]:
            name = model.body(model.geom_bodyid[shape.objid]).name
            if name not in self._trace.paths:
                shape.rgba[3] *= 0.0 if name in self._still else GHOST

    def _draw_paths(self, until: int) -> None:
        """Adds the paths, in one colour before the moment that matters and another after it."""
        scene, capsule = self._renderer.scene, mujoco.mjtGeom.mjGEOM_CAPSULE
        change = -np.inf if self._moment is None else self._moment
        for path in self._trace.paths.values():
            for time, start, end in zip(self._trace.time[:until], path[:until], path[1:], strict=False):
                if scene.ngeom == scene.maxgeom:
                    return
                colour = BEFORE if time < change else AFTER
                shape = scene.geoms[scene.ngeom]
                mujoco.mjv_initGeom(shape, capsule, np.zeros(3), np.zeros(3), np.eye(3).ravel(), colour)
                mujoco.mjv_connector(shape, capsule, PATH_RADIUS, start, end)
                scene.ngeom += 1


def _model(shapes: Sequence[Geom], trace: Trace, width: int, height: int) -> Any:
    """The shapes as a model in which every body of the trace moves freely and nothing collides."""
    spec = mujoco.MjSpec()
    screen = spec.visual.global_
    screen.offwidth, screen.offheight, screen.fovy = width, height, 2 * np.rad2deg(HALF_VIEW)
    light = spec.visual.headlight
    light.ambient, light.diffuse, light.specular = [0.35] * 3, [0.4] * 3, [0.1] * 3
    spec.visual.quality.shadowsize = 2048
    spec.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=[0.85, 0.9, 0.95],
        rgb2=[0.45, 0.55, 0.65],
        width=256,
        height=256,
    )
    low, high = _box(trace)
    x, y, _ = 0.5 * (low + high)
    for side, way in ((-1.0, 0.2), (1.0, -0.4)):
        spec.worldbody.add_light(
            pos=[x + side, y + 2 * side, high[2] + 3.0],
            dir=[way, -0.2 * side, -1.0],
            type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
            diffuse=[0.4] * 3,
            castshadow=side < 0,
        )
    bodies = {WORLD: spec.worldbody}
    for name in trace.bodies:
        bodies[name] = spec.worldbody.add_body(name=name, mass=1.0, inertia=[1.0] * 3, explicitinertial=True)
        bodies[name].add_freejoint()
    kinds = {
        name: getattr(mujoco.mjtGeom, f"mjGEOM_{name.upper()}") for name in ("box", "sphere", "capsule", "cylinder")
    }
    for shape in shapes:
        if shape.body in bodies:
            rotation = [shape.quaternion[index] for index in (3, 0, 1, 2)]
            bodies[shape.body].add_geom(
                type=kinds[shape.shape],
                size=shape.size,
                pos=shape.position,
                quat=rotation,
                rgba=shape.colour,
                contype=0,
                conaffinity=0,
            )
    return spec.compile()


def _box(trace: Trace) -> tuple[Array, Array]:
    """Least and greatest coordinates (3,) of the trace [m]."""
    points = np.concatenate([trace.positions.reshape(-1, 3), *trace.paths.values()])
    return points.min(axis=0), points.max(axis=0)


def _camera(trace: Trace, aspect: float) -> Any:
    """A camera that has the whole motion in view: from the side where it is narrow, or from above."""
    low, high = _box(trace)
    wide, deep, tall = high - low
    camera = mujoco.MjvCamera()
    camera.type = mujoco.mjtCamera.mjCAMERA_FREE
    camera.lookat = 0.5 * (low + high)
    camera.azimuth = 78.0 if deep <= wide else 168.0
    camera.elevation = -75.0 if tall < FLAT * max(wide, deep) else -12.0
    turn, tilt = np.deg2rad([camera.azimuth, camera.elevation])
    ahead = np.array([np.cos(tilt) * np.cos(turn), np.cos(tilt) * np.sin(turn), np.sin(tilt)])
    right = np.array([np.sin(turn), -np.cos(turn), 0.0])
    corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)]) * (high - low)
    across, upward = np.abs(corners @ right), np.abs(corners @ np.cross(right, ahead))
    needed = np.maximum(across / aspect, upward) * MARGIN / np.tan(HALF_VIEW) - corners @ ahead
    camera.distance = max(float(needed.max()), 0.1)
    return camera
