from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from crkr.dashboard import Progress, Row, Telemetry
from crkr.dashboard.rerun_view import Recording
from crkr.dashboard.rerun_view.blueprint import FAILURE, SUCCESS
from crkr.dashboard.rerun_view.robots import ALONE_S, MAX_BODIES, MAX_PATHS, MAX_SCENES, MAX_WORKERS, Robots
from crkr.protocol import StoredTrial

Make = Callable[..., StoredTrial]
Message = Callable[..., dict[str, Any]]
Read = Callable[[Path], dict[str, list[Any]]]
Show = Callable[..., None]


@pytest.fixture
def said() -> list[str]:
    """What the robots says that it does not show."""
    return []


@pytest.fixture
def robots(recording: Recording, said: list[str]) -> Robots:
    return Robots(recording, said.append)


@pytest.fixture
def show(robots: Robots, stored: Make, message: Message) -> Show:
    """Counts trial `seq` and puts what its worker published on the robots."""
    progress = Progress()

    def shown(seq: int, *, kind: str = "trial", success: bool = True, **fields: Any) -> None:
        row: Row = progress.add(stored(seq, kind, success=success), 0.0)
        robots.picture(row, Telemetry.from_wire(message(seq, kind=kind, success=success, **fields)))

    return shown


def values(batches: list[Any], column: str) -> list[Any]:
    """A component's values; each row holds one."""
    rows = [value for batch in batches for value in batch.column(column).to_pylist()]
    return [value[0] if isinstance(value, list) else value for value in rows]


def test_poses_go_out_as_moves_of_named_frames(
    robots: Robots, show: Show, message: Message, recording: Recording, file: Path, read: Read
) -> None:
    show(1)
    for now in (0.0, 0.05, 1.0):
        robots.tick(now)
    assert recording.close(5.0)
    moves = read(file)["/world/crane-1/motion"]
    trace = Telemetry.from_wire(message(1)).trace
    assert trace is not None
    frames, positions = values(moves, "Transform3D:child_frame"), values(moves, "Transform3D:translation")
    assert len(frames) == 4 * 3  # two bodies, and the load's path, which no body carries
    for index, name in enumerate(trace.bodies):
        moved = [position for frame, position in zip(frames, positions, strict=True) if frame == f"crane-1/{name}"]
        np.testing.assert_allclose(moved, trace.positions[:, index], rtol=1e-6)
    load = [position for frame, position in zip(frames, positions, strict=True) if frame == "crane-1/load"]
    np.testing.assert_allclose(load, trace.paths["load"], rtol=1e-6)
    assert set(values(moves, "trial")) == {1}
    times = {time for batch in moves for time in batch.column("trial_time").cast("int64").to_pylist()}
    np.testing.assert_allclose(sorted(times), np.linspace(0.0, 0.1, 4) * 1e9, atol=1)  # nanoseconds


def test_motion_follows_the_clock(robots: Robots, show: Show, recording: Recording, file: Path, read: Read) -> None:
    show(1)
    robots.tick(10.0)
    robots.tick(10.04)
    assert recording.close(5.0)
    batches = read(file)["/world/crane-1/motion"]
    assert sorted(batch.num_rows for batch in batches) == [3, 3]  # the poses at 0 and 1/30 s; the others lie ahead


def test_trials_that_come_faster_than_they_play_leave_their_paths(
    robots: Robots, show: Show, recording: Recording, file: Path, read: Read
) -> None:
    show(1)
    robots.tick(0.0)
    show(2, success=False)
    show(3)
    robots.tick(0.05)
    robots.tick(5.0)
    robots.tick(5.1)
    assert recording.close(5.0)
    tables = read(file)
    paths = tables["/world/crane-1/paths/load"]
    lines = [batch for batch in paths if "trial" in batch.schema.names]
    colours = dict(zip(values(lines, "trial"), values(lines, "LineStrips3D:colors"), strict=True))
    assert colours == {1: SUCCESS, 2: FAILURE, 3: SUCCESS}
    assert set(values(tables["/world/crane-1/motion"], "trial")) == {1, 3}


def test_every_worker_has_a_separate_world(
    robots: Robots, show: Show, recording: Recording, file: Path, read: Read
) -> None:
    for seq, worker in enumerate(["crane-1", "crane-2", "odd / name"], 1):
        show(seq, worker=worker)
    robots.tick(0.0)
    assert recording.close(5.0)
    tables = read(file)
    names = ["/world/crane-1", "/world/crane-2", r"/world/odd\ \/\ name"]
    places = [values(tables[name][-1:], "Transform3D:translation")[0] for name in names]
    distances = np.linalg.norm(np.diff(places, axis=0), axis=1)
    assert (distances > 2.0).all()  # the crane's base is 2 m wide
    assert all(f"{name}/shapes/boom/capsule" in tables for name in names)


def test_a_scene_that_is_sent_again_is_drawn_once(
    robots: Robots, show: Show, recording: Recording, file: Path, read: Read
) -> None:
    for seq in range(1, 5):
        show(seq)
    assert recording.close(5.0)
    shapes = {name: batches for name, batches in read(file).items() if "/shapes/" in name}
    assert set(shapes) == {
        f"/world/crane-1/shapes/{shape}" for shape in ("world/box", "boom/capsule", "boom/cylinder", "hook/sphere")
    }
    assert all(sum(batch.num_rows for batch in batches) == 1 for batches in shapes.values())


def test_demonstrations_are_played_where_the_first_worker_learns(
    robots: Robots, show: Show, recording: Recording, file: Path, read: Read
) -> None:
    show(1, kind="demonstration", worker="teacher")
    robots.tick(0.0)
    show(2)
    robots.tick(1.0)
    assert recording.close(5.0)
    assert not any(name.startswith("/world/teacher") for name in read(file))


def test_demonstrations_without_trials_are_played_after_some_seconds(
    robots: Robots, show: Show, recording: Recording, file: Path, read: Read
) -> None:
    show(1, kind="demonstration", worker="teacher")
    robots.tick(0.0)
    robots.tick(2 * ALONE_S)
    assert recording.close(5.0)
    assert "/world/teacher/motion" in read(file)


def test_the_number_of_workers_that_are_drawn_is_bounded(
    robots: Robots, show: Show, recording: Recording, file: Path, read: Read
) -> None:
    for seq in range(1, MAX_WORKERS + 10):
        show(seq, worker=f"w{seq}", scene=None)
    robots.tick(0.0)
    assert recording.close(5.0)
    assert sum(name.endswith("/motion") for name in read(file)) == MAX_WORKERS


def seen(camera: list[Any], points: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """Points (n, 3) of the world, which lie ahead of a camera's newest pose, as tangents (n, 2) right and down."""
    # Rerun's matrices are columns one after the other, and its cameras look along their z with y downwards.
    turn = np.reshape(values(camera, "Transform3D:mat3x3")[-1], (3, 3)).T
    local = (points - values(camera, "Transform3D:translation")[-1]) @ turn
    assert (local[:, 2] > 0.0).all()
    tangents: np.ndarray[Any, Any] = local[:, :2] / local[:, 2:]
    return tangents


@pytest.mark.parametrize("count", [1, 3, 9])
def test_the_camera_has_every_world_in_sight(
    robots: Robots, show: Show, recording: Recording, file: Path, read: Read, count: int
) -> None:
    for seq in range(1, count + 1):
        show(seq, worker=f"w{seq}")
    assert recording.close(5.0)
    tables = read(file)
    camera = tables["/eye"]
    base = np.array([[x, y, 0.0] for x in (-2.0, 2.0) for y in (-1.0, 1.0)])  # the box that the crane stands on
    focal = values(camera, "Pinhole:image_from_camera")[-1][4]
    height = values(camera, "Pinhole:resolution")[-1][1]
    for number in range(1, count + 1):
        place = values(tables[f"/world/w{number}"], "Transform3D:translation")[-1]
        right, down = seen(camera, base + place).T
        assert (np.abs(down) < height / focal / 2).all()
        assert (np.abs(right) < 1.5 * height / focal / 2).all()  # the view is wider than high
    (_, up), (_, ground) = seen(camera, np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 0.0]]))
    assert up < ground


def test_there_is_a_camera_before_there_is_anything_to_see(
    robots: Robots, recording: Recording, file: Path, read: Read
) -> None:
    del robots  # made, and told nothing
    assert recording.close(5.0)
    assert "/eye" in read(file)


def test_names_that_change_with_every_message_do_not_grow_the_recording(
    robots: Robots,
    show: Show,
    message: Message,
    said: list[str],
    recording: Recording,
    file: Path,
    read: Read,
) -> None:
    """Paths, bodies and shapes: the first names of each kind stay, and what is not shown is told once."""
    plain = message(1)
    for seq in range(1, 2 * MAX_BODIES[0]):
        path = plain["trace"]["paths"]["load"]
        trace = plain["trace"] | {"bodies": [f"a{seq}", f"b{seq}"], "paths": {f"p{seq}": path, f"q{seq}": path}}
        show(seq, trace=trace, scene=[{**geom, "body": f"{geom['body']}{seq}"} for geom in plain["scene"]])
        robots.tick(10.0 * seq)
        robots.tick(10.0 * seq + 5.0)
    assert recording.close(5.0)
    content = read(file)
    assert sum(path.startswith("/world/crane-1/paths/") for path in content) == MAX_PATHS[0]
    assert sum(path.startswith("/world/crane-1/shapes/") for path in content) <= MAX_BODIES[0]
    frames = set(values(content["/world/crane-1/motion"], "Transform3D:child_frame"))
    assert len(frames) <= MAX_BODIES[0] + MAX_PATHS[0]
    assert len(said) == 3
    assert [word for word in ("bodies", "paths", "shapes") if not any(word in line for line in said)] == []


def test_the_shapes_of_a_worker_are_redrawn_a_few_times_only(
    robots: Robots, show: Show, message: Message, said: list[str], recording: Recording, file: Path, read: Read
) -> None:
    scene = message(1)["scene"]
    for seq in range(1, 3 * MAX_SCENES):
        show(seq, scene=[{**geom, "size": [0.1 + 0.01 * seq, 0.1, 0.1]} for geom in scene])
    assert recording.close(5.0)
    drawn = values(read(file)["/world/crane-1/shapes/hook/sphere"], "Ellipsoids3D:half_sizes")
    np.testing.assert_allclose(
        [size[0] for size in drawn], [0.1 + 0.01 * (1 + n) for n in range(MAX_SCENES)], rtol=1e-6
    )
    assert len(said) == 1
