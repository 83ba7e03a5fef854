"""Films hold the frames that went in, read back by the libraries themselves."""

import weakref
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest
from PIL import Image

from crkr.protocol import Invalid
from crkr.sim_worker.pictures.film import Picture, save_film

RATE = 25


@pytest.fixture
def frames() -> list[Picture]:
    """A red square that moves over a grey gradient."""
    still = np.tile(np.linspace(40, 200, 64, dtype=np.uint8)[None, :, None], (48, 1, 3))
    pictures = []
    for step in range(6):
        picture = still.copy()
        picture[16:32, 8 * step : 8 * step + 16] = (220, 30, 20)
        pictures.append(picture)
    return pictures


def test_an_mp4_is_h264_that_browsers_play_with_every_frame(frames: list[Picture], tmp_path: Path) -> None:
    save_film(frames, tmp_path / "film.mp4", RATE)
    with av.open(str(tmp_path / "film.mp4")) as container:
        stream = container.streams.video[0]
        assert (stream.codec.name, stream.pix_fmt) == ("h264", "yuv420p")
        assert stream.average_rate == Fraction(RATE)
        shown = [frame.to_ndarray(format="rgb24").astype(np.uint8) for frame in container.decode(stream)]
    _alike(shown, frames)


def test_the_index_of_an_mp4_comes_first(frames: list[Picture], tmp_path: Path) -> None:
    save_film(frames, tmp_path / "film.mp4", RATE)
    data = (tmp_path / "film.mp4").read_bytes()
    assert data.index(b"moov") < data.index(b"mdat")


def test_a_gif_has_every_frame_at_the_rate_and_repeats(frames: list[Picture], tmp_path: Path) -> None:
    save_film(frames, tmp_path / "film.gif", RATE)
    with Image.open(tmp_path / "film.gif") as film:
        assert getattr(film, "n_frames", 1) == len(frames)
        shown = []
        for index in range(len(frames)):
            film.seek(index)
            assert film.info["duration"] == 40
            shown.append(np.asarray(film.convert("RGB")))
        assert film.info["loop"] == 0
    _alike(shown, frames)


def test_an_mp4_is_written_as_its_frames_are_drawn_and_none_is_kept(tmp_path: Path) -> None:
    drawn: list[weakref.ref[Picture]] = []
    kept: list[int] = []

    def frames() -> Iterator[Picture]:
        for grey in range(50):
            kept.append(sum(one() is not None for one in drawn))
            picture = np.full((48, 64, 3), grey, dtype=np.uint8)
            drawn.append(weakref.ref(picture))
            yield picture

    save_film(frames(), tmp_path / "film.mp4", RATE)
    assert len(drawn) == 50
    assert max(kept) < 10


@pytest.mark.parametrize(
    ("name", "shape", "complaint"),
    [("film.avi", (48, 64, 3), r"\.mp4"), ("film.mp4", (47, 64, 3), "even"), ("film.mp4", (48, 63, 3), "even")],
)
def test_what_no_film_can_be_is_refused(tmp_path: Path, name: str, shape: tuple[int, ...], complaint: str) -> None:
    with pytest.raises(Invalid, match=complaint):
        save_film([np.zeros(shape, dtype=np.uint8)], tmp_path / name, RATE)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["film.mp4", "film.gif"])
def test_no_frames_make_no_film(tmp_path: Path, name: str) -> None:
    with pytest.raises(Invalid, match="no frames"):
        save_film([], tmp_path / name, RATE)


def _alike(shown: list[Picture], frames: list[Picture]) -> None:
    """Every frame in its place: lossy, but nearer to its own original than to any other."""
    assert len(shown) == len(frames)
    for index, picture in enumerate(shown):
        apart = [np.abs(picture.astype(float) - frame).mean() for frame in frames]
        assert int(np.argmin(apart)) == index
        assert apart[index] < 6
