"""The robots in 3D: the paths of every trial, and of each worker one trial at a time in real time.

Workers finish trials faster than they can be watched. All paths are drawn, coloured by success. Poses are drawn of the
newest trial, once the one before has been played. The poses of all bodies are rows of one entity for each worker, which
names the moved frame in each row: one chunk for each worker and tick instead of one for each body. Demonstrations are
played in the world of the first worker that tries something: their own worker often does nothing else.

    eye                               the camera that the 3D view follows, static
    world/<worker>                    position of its world, static
    world/<worker>/shapes/<body>/...  shapes, static, each in the frame "<worker>/<body>"
    world/<worker>/motion             transforms of those frames
    world/<worker>/paths/<name>       a line per trial, coloured by success
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, Final, final

import numpy as np
import rerun as rr

from crkr.dashboard.progress import Row
from crkr.dashboard.rerun_view.blueprint import EYE, FAILURE, SUCCESS
from crkr.dashboard.rerun_view.recording import NameLimit, Recording
from crkr.dashboard.rerun_view.scene import VIEW_ANGLE, bounds, eye, offset, shapes_by_body, upright_rotation
from crkr.dashboard.telemetry import Telemetry
from crkr.protocol import Geom, Trace

__all__ = ["Robots"]

MAX_WORKERS: Final = 64
MAX_BODIES: Final = (128, 1024)  # of a worker, and of all
MAX_PATHS: Final = (16, 256)
MAX_SCENES: Final = 8  # of a worker, as a recording keeps static data forever
PATH_RADIUS: Final = -0.6  # negative: Rerun's points on the screen, whatever the distance
MAX_EARLY: Final = 16
ALONE_S: Final = 15.0  # time without another worker after which demonstrations get a world
HOLD_S: Final = 0.3  # time that the last pose of a trial stays
NO_SCENE: Final = (np.array([-1.0, -1.0, 0.0]), np.array([1.0, 1.0, 1.0]))


@final
@dataclass(slots=True)
class _World:
    """One worker's part of the 3D view."""

    name: str
    index: int
    scene: tuple[Geom, ...] = ()
    scenes: int = 0
    markers: set[str] = field(default_factory=set)
    waiting: tuple[Row, Trace] | None = None
    playing: tuple[Row, Trace] | None = None
    started: float = 0.0
    sent: int = 0
    paths: dict[str, list[tuple[Row, Any]]] = field(default_factory=dict)


@final
class Robots:
    """The 3D view of what the workers publish."""

    def __init__(self, recording: Recording, say: Callable[[str], object]) -> None:
        self._recording = recording
        self._say = say
        self._bodies = NameLimit("bodies", *MAX_BODIES, say)
        self._paths = NameLimit("paths", *MAX_PATHS, say)
        self._crowded = self._changing = False  # whether `say` was called about it
        self._worlds: dict[str, _World] = {}
        self._early: deque[tuple[Row, Telemetry]] = deque(maxlen=MAX_EARLY)
        self._alone_until: float | None = None
        self._bounds = NO_SCENE
        recording.fixed(["world"], rr.ViewCoordinates.RIGHT_HAND_Z_UP)
        self._look()

    def picture(self, row: Row, telemetry: Telemetry) -> None:
        """Add what a worker published about a trial."""
        if row.kind == "demonstration" and telemetry.worker not in self._worlds:
            self._early.append((row, telemetry))
        else:
            self._show(self._world(telemetry.worker), row, telemetry)

    def _show(self, world: _World | None, row: Row, telemetry: Telemetry) -> None:
        if world is None:
            return
        if telemetry.scene is not None and telemetry.scene != world.scene:
            self._change_scene(world, telemetry.scene)
        if telemetry.trace is not None:
            trace = self._known_part(world, telemetry.trace)
            world.waiting = (row, trace)
            for name, path in trace.paths.items():
                world.paths.setdefault(name, []).append((row, path))

    def _known_part(self, world: _World, trace: Trace) -> Trace:
        """The part of a trace whose bodies and paths are drawn."""
        kept = [index for index, name in enumerate(trace.bodies) if self._bodies.admits(name, world.name)]
        paths = {name: path for name, path in trace.paths.items() if self._paths.admits(name, world.name)}
        if len(kept) == len(trace.bodies) and len(paths) == len(trace.paths):
            return trace
        return replace(
            trace,
            bodies=tuple(trace.bodies[index] for index in kept),
            positions=trace.positions[:, kept],
            quaternions=trace.quaternions[:, kept],
            paths=paths,
        )

    def _change_scene(self, world: _World, scene: tuple[Geom, ...]) -> None:
        world.scenes += 1
        if world.scenes <= MAX_SCENES:
            self._draw_scene(world, scene)
        elif not self._changing:
            self._changing = True
            self._say(f"the shapes of {world.name} changed more than {MAX_SCENES} times; later ones are not shown")

    def tick(self, now: float) -> None:
        """Draw the new paths, and move the robots to where they were at `now`, monotonic [s]."""
        self._show_demonstrations(now)
        for world in self._worlds.values():
            try:
                self._play(world, now)
                self._draw_paths(world)
            except Exception:
                world.playing = world.waiting = None  # otherwise each tick fails
                world.paths.clear()
                raise

    def _show_demonstrations(self, now: float) -> None:
        """Show them in the first worker's world, or after some seconds without a trial in a new one."""
        if not self._early:
            return
        self._alone_until = now + ALONE_S if self._alone_until is None else self._alone_until
        if self._worlds or now > self._alone_until:
            for row, telemetry in self._early:
                worker = next(iter(self._worlds), telemetry.worker)
                self._show(self._world(worker), row, telemetry)
            self._early.clear()

    def _world(self, worker: str) -> _World | None:
        if worker not in self._worlds and len(self._worlds) < MAX_WORKERS:
            world = _World(worker, len(self._worlds))
            self._worlds[worker] = world
            self._place(world)
            self._look()
        if worker not in self._worlds and not self._crowded:
            self._crowded = True
            self._say(f"more workers than are shown: at most {MAX_WORKERS}")
        return self._worlds.get(worker)

    def _look(self) -> None:
        """Move the camera so that all worlds are in sight; a viewer whose user moved the view keeps that."""
        position, target = eye(max(len(self._worlds), 1), *self._bounds)
        self._recording.fixed(
            [EYE],
            rr.Transform3D(translation=position, mat3x3=upright_rotation(position, target)),
            # The camera itself is not drawn.
            rr.Pinhole(fov_y=VIEW_ANGLE, aspect_ratio=1.0, image_plane_distance=1e-3, line_width=0.0, color=0),
        )

    def _place(self, world: _World) -> None:
        """Place the worker's frame, the parent of its shapes, paths and poses."""
        self._recording.fixed(
            ["world", world.name],
            rr.Transform3D(
                translation=offset(world.index, *self._bounds), parent_frame="tf#/world", child_frame=world.name
            ),
        )

    def _draw_scene(self, world: _World, scene: tuple[Geom, ...]) -> None:
        first = not any(other.scene for other in self._worlds.values())
        world.scene = scene
        shown = [geom for geom in scene if geom.body == "world" or self._bodies.admits(geom.body, world.name)]
        if first and shown:
            self._bounds = bounds(shown)
            for other in self._worlds.values():
                self._place(other)
            self._look()
        for body, kind, archetype in shapes_by_body(shown):
            frame = world.name if body == "world" else f"{world.name}/{body}"
            self._recording.fixed(["world", world.name, "shapes", body, kind], archetype, rr.CoordinateFrame(frame))

    def _draw_paths(self, world: _World) -> None:
        for name, paths in world.paths.items():
            if not paths:
                continue
            where = ["world", world.name, "paths", name]
            if name not in world.markers:
                world.markers.add(name)
                self._recording.fixed(where, rr.CoordinateFrame(world.name))
            self._recording.columns(
                where,
                _times([row for row, _ in paths]),
                rr.LineStrips3D.columns(
                    strips=[[path] for _, path in paths],
                    colors=np.array([SUCCESS if row.success else FAILURE for row, _ in paths], dtype=np.uint32),
                    radii=[PATH_RADIUS] * len(paths),
                ),
            )
            paths.clear()

    def _play(self, world: _World, now: float) -> None:
        if world.playing is None and world.waiting is not None:
            world.playing, world.waiting, world.started, world.sent = world.waiting, None, now, 0
        if world.playing is None:
            return
        row, trace = world.playing
        elapsed = now - world.started
        until = int(np.searchsorted(trace.time - trace.time[0], elapsed, side="right"))
        if until > world.sent:
            self._move(world, row, trace, slice(world.sent, until))
            world.sent = until
        if elapsed > trace.time[-1] - trace.time[0] + HOLD_S:
            world.playing = None

    def _move(self, world: _World, row: Row, trace: Trace, steps: slice) -> None:
        count, bodies = len(trace.time[steps]), trace.bodies
        points = {name: path for name, path in trace.paths.items() if name not in bodies}
        names = [*bodies, *points]
        if not names:
            return
        still = np.broadcast_to([0.0, 0.0, 0.0, 1.0], (count, len(points), 4))
        positions = [trace.positions[steps], *(path[steps, None, :] for path in points.values())]
        rows = count * len(names)
        self._recording.columns(
            ["world", world.name, "motion"],
            [
                *_times([row] * rows),
                rr.TimeColumn("trial_time", duration=np.repeat(trace.time[steps], len(names))),
            ],
            rr.Transform3D.columns(
                translation=np.concatenate(positions, axis=1).reshape(rows, 3),
                quaternion=np.concatenate([trace.quaternions[steps], still], axis=1).reshape(rows, 4),
                parent_frame=[world.name] * rows,
                child_frame=[f"{world.name}/{name}" for name in names] * count,
            ),
        )


def _times(rows: list[Row]) -> list[rr.TimeColumn]:
    return [
        rr.TimeColumn("trial", sequence=[row.trial for row in rows]),
        rr.TimeColumn("epoch", sequence=[row.epoch for row in rows]),
    ]
