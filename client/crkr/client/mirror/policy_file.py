"""A policy as a file that NumPy alone evaluates (reader in `docs/policies.md`), or as an ONNX model."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final, Protocol

import numpy as np

from crkr.client.checks import answer_to
from crkr.client.cli.output_file import output_file
from crkr.learner import Model
from crkr.protocol import NoSamples, TaskSpec

__all__ = ["save_policy"]

_FORMAT: Final = 1


class _PolicySource(Protocol):
    """The part of `Task` that is saved."""

    @property
    def spec(self) -> TaskSpec: ...
    def model(self) -> dict[str, Any]: ...


def save_policy(task: _PolicySource, path: Path, *, overwrite: bool = False) -> int:
    """Writes the present policy's mean goals; returns its version.

    As an .npz file without pickles, or where the name ends in .onnx as a model, states (n, d) -> goals (n, p).

    With z = (state - centre) / lengthscales, samples (m, d) and weights (m, p), the goal is prior + scales (k weights)
    clipped to low and high, where k = signal_variance exp(-|z - samples|^2 / 2) + linear_weight z samples^T.
    Exploration and outcomes are not in the file.

    Raises:
        NoSamples: Nothing was learned yet.
        Invalid: The file exists, or cannot be written there.
        ModuleNotFoundError: The extra 'onnx' is needed and not installed.
    """
    reply = task.model()
    with answer_to("model"):
        model = Model.from_wire(reply)
    own, regression, spec = model.parameters, model.regression, task.spec
    if regression is None:
        raise NoSamples(f"task {spec.name!r} has no active sample, so there is no policy to save")
    kernel = own.kernel
    policy: dict[str, Any] = {
        "format": _FORMAT,
        "task": spec.name,
        "version": model.version,
        "state_names": [axis.name for axis in spec.state],
        "goal_names": [axis.name for axis in spec.goal],
        "centre": kernel.centre,
        "lengthscales": kernel.lengthscales,
        "signal_variance": kernel.signal_variance,
        "linear_weight": kernel.linear_weight,
        "samples": regression.Z,
        "weights": regression.W,
        "prior": own.prior,
        "scales": own.scales,
        "low": own.low,
        "high": own.high,
    }
    with output_file(path, overwrite=overwrite) as partial, partial.open("xb") as file:
        if path.suffix.lower() == ".onnx":
            from crkr.client.mirror.onnx_policy import onnx_policy  # needs an extra of its own

            file.write(onnx_policy(policy).SerializeToString())
        else:
            np.savez(file, **policy)
    return model.version
