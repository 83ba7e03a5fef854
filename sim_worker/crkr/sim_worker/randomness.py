"""Random number streams: each is a function of a seed and of its purpose.

`SeedSequence` pads entropy with zeros, so streams of one seed differ by a last word that is never zero.
"""

from __future__ import annotations

from typing import Final

import numpy as np

__all__ = [
    "demonstration_rng",
    "evaluation_rng",
    "fresh_rng",
    "place_seed",
    "training_rng",
    "unpredictable_seed",
    "worker_seed",
]

_TRAINING: Final = 1
_DEMONSTRATIONS: Final = 2
_FRESH: Final = 3
_WORKERS: Final = 4
_PLACES: Final = 5


def evaluation_rng(seed: int, context: int) -> np.random.Generator:
    """Draws context number `context` of a task's fixed evaluation set."""
    return np.random.default_rng([seed, context])


def fresh_rng(seed: int, context: int) -> np.random.Generator:
    """Draws context number `context` of an evaluation by `crkr evaluate`: never one of the fixed set."""
    return np.random.default_rng([seed, context, _FRESH])


def demonstration_rng(seed: int) -> np.random.Generator:
    """Draws the contexts that are demonstrated."""
    return np.random.default_rng([seed, 0, _DEMONSTRATIONS])


def worker_seed(seed: int, index: int) -> int:
    """The seed of worker `index` of a supervisor, below 2^31."""
    return int(np.random.SeedSequence([seed, index, _WORKERS]).generate_state(1)[0] >> 1)


def place_seed(seed: int, index: int) -> int:
    """The seed of supervisor `index` of a run on several machines, below 2^31."""
    return int(np.random.SeedSequence([seed, index, _PLACES]).generate_state(1)[0] >> 1)


def training_rng(seed: int, first_seq: int) -> np.random.Generator:
    """Draws the contexts that a worker trains in, from the log position that it found when it started."""
    return np.random.default_rng([seed, first_seq, _TRAINING])


def unpredictable_seed() -> int:
    """A seed that no other process has, below 2^31."""
    return int(np.random.SeedSequence().generate_state(1)[0] >> 1)
