"""Pictures of any MuJoCo environment: its shapes, and their motion in a trial."""

from __future__ import annotations

from typing import Any, Final, final

import numpy as np

from crkr.protocol import Geom, Trace

__all__ = ["MujocoScene"]

FAINT: Final = 0.05  # alpha below which a shape is not drawn
COLLISION: Final = 3  # group of geoms from which on MuJoCo's viewer hides them, by default
MOST_BODIES: Final = 24  # bodies whose poses fit into a message
FLOOR: Final = 3.0  # half size of an infinite plane [m]
QUATERNION: Final = [1, 2, 3, 0]  # scalar last


@final
class MujocoScene:
    """Draws an environment with a MuJoCo model; others have no shapes.

    Meshes are drawn as boxes around them. Sites that are visible, often targets, are drawn as spheres that move.
    """

    def __init__(self, env: Any) -> None:
        model = getattr(env, "model", None)
        self._model: Any = model if hasattr(model, "geom_aabb") and hasattr(env, "data") else None
        self._data: Any = getattr(env, "data", None)
        self._dt = float(getattr(env, "dt", 1.0 / 30.0))
        self._shapes: list[Geom] = []
        self._bodies: list[int] = []
        self._sites: list[int] = []
        # gymnasium-robotics moves the site of a target only when it is about to draw.
        self._place_targets: Any = getattr(env, "_render_callback", lambda: None)
        self._frames: list[tuple[Any, Any]] = []
        if self._model is not None:
            self._collect()

    def shapes(self) -> list[Geom]:
        """The scene."""
        return self._shapes

    def clear(self) -> None:
        """Starts a trial's trace with the present poses."""
        self._frames.clear()
        if self._sites:
            self._place_targets()
        self.record()

    def record(self) -> None:
        """Adds the present poses to the trace."""
        if self._shapes:
            bodies, sites = self._data.xpos[self._bodies], self._data.site_xpos[self._sites]
            turned = self._data.xquat[self._bodies][:, QUATERNION]
            still = np.tile([0.0, 0.0, 0.0, 1.0], (len(self._sites), 1))
            self._frames.append((np.vstack([bodies, sites]), np.vstack([turned, still])))

    def trace(self) -> Trace | None:
        """The poses since `clear`."""
        if not self._frames:
            return None
        names = [self._body(body) for body in self._bodies] + [self._site(site) for site in self._sites]
        positions, quaternions = (np.array(part, dtype=np.float64) for part in zip(*self._frames, strict=True))
        time = self._dt * np.arange(len(self._frames), dtype=np.float64)
        return Trace(time, tuple(names), positions, quaternions)

    def _collect(self) -> None:
        model = self._model
        drawn = [geom for geom in range(model.ngeom) if model.geom_group[geom] < COLLISION]
        drawn = [geom for geom in drawn if _colour(model, geom)[3] > FAINT]
        moving = {int(model.geom_bodyid[geom]) for geom in drawn if model.body_weldid[model.geom_bodyid[geom]]}
        largest = sorted(moving, key=lambda body: -float(model.body_mass[body]))[:MOST_BODIES]
        self._bodies = sorted(largest)
        for geom in drawn:
            body = int(model.geom_bodyid[geom])
            if body in self._bodies or not model.body_weldid[body]:
                self._shapes.append(self._geom(geom, body))
        visible = (model.site_rgba[:, 3] > FAINT) & (model.site_group == 0)
        self._sites = np.flatnonzero(visible).tolist()[: MOST_BODIES - len(self._bodies)]
        for site in self._sites:
            size = (float(model.site_size[site, 0]), 0.0, 0.0)
            colour = tuple(model.site_rgba[site].tolist())
            self._shapes.append(Geom(self._site(site), "sphere", size, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0), colour))

    def _body(self, body: int) -> str:
        return self._model.body(body).name[:60] or f"body_{body}"

    def _site(self, site: int) -> str:
        return f"site_{(self._model.site(site).name or site)!s:.50}"

    def _geom(self, geom: int, body: int) -> Geom:
        """A shape in its body's frame, or in the world where the body does not move."""
        model, size = self._model, self._model.geom_size[geom]
        kind = _kind(model, geom)
        offset = np.zeros(3)
        if kind in ("capsule", "cylinder"):
            half = (float(size[0]), float(size[1]), 0.0)
        elif kind == "sphere":
            half = (float(size[0]), 0.0, 0.0)
        elif kind == "plane":
            half = (float(size[0] or FLOOR), float(size[1] or FLOOR), 0.001)
        else:
            aabb = model.geom_aabb[geom]
            offset = aabb[:3]
            half = (float(aabb[3]), float(aabb[4]), float(aabb[5]))
        if model.body_weldid[body]:
            name, position, quaternion = self._body(body), model.geom_pos[geom], model.geom_quat[geom]
            turn = _matrix(quaternion)
        else:
            name, position = "world", self._data.geom_xpos[geom]
            turn = self._data.geom_xmat[geom].reshape(3, 3)
            quaternion = _quaternion(turn)
        return Geom(
            name,
            "box" if kind not in ("sphere", "capsule", "cylinder") else kind,
            half,
            tuple((position + turn @ offset).tolist()),
            tuple(np.asarray(quaternion)[QUATERNION].tolist()),
            _colour(model, geom),
        )


def _kind(model: Any, geom: int) -> str:
    import mujoco

    return str(mujoco.mjtGeom(int(model.geom_type[geom])).name).removeprefix("mjGEOM_").lower()


def _colour(model: Any, geom: int) -> Any:
    material = int(model.geom_matid[geom])
    return tuple((model.geom_rgba[geom] if material < 0 else model.mat_rgba[material]).tolist())


def _matrix(quaternion: Any) -> Any:
    import mujoco

    flat = np.zeros(9)
    mujoco.mju_quat2Mat(flat, np.asarray(quaternion, dtype=np.float64))
    return flat.reshape(3, 3)


def _quaternion(matrix: Any) -> Any:
    import mujoco

    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, np.ascontiguousarray(matrix, dtype=np.float64).ravel())
    return quaternion
