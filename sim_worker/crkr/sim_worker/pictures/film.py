"""Films on disk: H.264 by PyAV, or a GIF by Pillow."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import chain
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from crkr.client.cli.output_file import output_file
from crkr.protocol import Invalid

__all__ = ["FILMS", "Picture", "save_film"]

Picture = NDArray[np.uint8]

FILMS: Final = (".mp4", ".gif")
QUALITY: Final = "20"  # constant rate factor of H.264: lower is better and larger; above 28 edges smear


def save_film(frames: Iterable[Picture], path: Path, rate: int) -> None:
    """Saves frames (h, w, 3) as an .mp4 that browsers play, or as a .gif that repeats.

    Args:
        frames: All of one size; for an .mp4 both sides are even.
        path: Where to; an existing file is replaced when the film is whole.
        rate: Frames a second; a .gif counts in hundredths of a second.

    Raises:
        Invalid: Another suffix, no frames, or sides that H.264 cannot halve.
        ModuleNotFoundError: PyAV is not installed, for an .mp4.
    """
    if path.suffix not in FILMS:
        raise Invalid(f"a film is a .mp4 or a .gif; got {path.name}")
    shown = iter(frames)
    first = next(shown, None)
    if first is None:
        raise Invalid(f"{path.name}: there are no frames to save")
    save = _save_mp4 if path.suffix == ".mp4" else _save_gif
    with output_file(path) as partial:
        save(first, shown, partial, rate)


def _save_mp4(first: Picture, others: Iterable[Picture], path: Path, rate: int) -> None:
    import av

    height, width = first.shape[:2]
    if height % 2 or width % 2:
        raise Invalid(f"an .mp4 needs even sides; got {width} x {height} pixels")
    # The index goes first, so that a browser can start before it has the whole file.
    with av.open(str(path), "w", options={"movflags": "+faststart"}) as container:
        stream = container.add_stream("libx264", rate=rate, options={"crf": QUALITY})
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        for picture in chain([first], others):  # one at a time: a slow film has gigabytes of them
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        container.mux(stream.encode())


def _save_gif(first: Picture, others: Iterable[Picture], path: Path, rate: int) -> None:
    from PIL import Image

    # The octree keeps the colours of small things, such as ball and paddle; the default spends them on the floor.
    kept = [Image.fromarray(picture).quantize(method=Image.Quantize.FASTOCTREE) for picture in (first, *others)]
    kept[0].save(path, save_all=True, append_images=kept[1:], duration=round(1000 / rate), loop=0)
