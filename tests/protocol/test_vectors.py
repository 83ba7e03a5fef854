"""The published vectors: an independent encoder makes the same bytes, and our messages read and write them."""

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest

from crkr.protocol import (
    AmendRequest,
    Explanation,
    Prediction,
    PredictRequest,
    Receipt,
    ReportRequest,
    StoredTrial,
    TaskSpec,
    UndoRequest,
    check_encoding,
    encoding,
    error_from_wire,
    error_to_wire,
    pack,
    pack_around,
    unpack,
)

VECTORS = Path(__file__).parents[2] / "protocol" / "vectors"
NAMES = sorted(path.stem for path in VECTORS.glob("*.json"))


def vector(name: str) -> tuple[dict[str, Any], bytes]:
    return json.loads((VECTORS / f"{name}.json").read_text()), (VECTORS / f"{name}.msgpack").read_bytes()


def binary(value: Any) -> Any:
    """JSON's {"$bin": hex} as bytes."""
    if isinstance(value, dict):
        return bytes.fromhex(value["$bin"]) if set(value) == {"$bin"} else {k: binary(v) for k, v in value.items()}
    return [binary(entry) for entry in value] if isinstance(value, list) else value


def spec() -> TaskSpec:
    return TaskSpec.from_dict(unpack(vector("create_task.full.request")[1]))


STATE = np.array([1.5, 0.25])
AGAIN: dict[str, Callable[[dict[str, Any]], Mapping[str, Any]]] = {
    "create_task.full.request": lambda message: TaskSpec.from_dict(message).to_dict(),
    "predict.request": lambda message: PredictRequest.from_wire(message, 2).to_wire(),
    "predict.batch.request": lambda message: PredictRequest.from_wire(message, 2).to_wire(),
    "predict.reply": lambda message: Prediction.from_wire(message, STATE).to_wire(),
    "report.request": lambda message: ReportRequest.from_wire(message, spec()).to_wire(),
    "report.learn.request": lambda message: ReportRequest.from_wire(message, spec()).to_wire(),
    "report.reply": lambda message: Receipt.from_wire(message).to_wire(),
    "samples.reply": lambda message: {
        "samples": [StoredTrial.from_wire(entry, spec()).to_wire() for entry in message["samples"]],
        "next": None,
    },
    "explain.reply": lambda message: Explanation.from_wire(message).to_wire(),
    "explain.grounds.reply": lambda message: Explanation.from_wire(message).to_wire(),
    "spec.reply": lambda message: {**message, "spec": TaskSpec.from_dict(message["spec"]).to_dict()},
    "tasks.reply": lambda message: {
        **message,
        "tasks": [{**entry, "spec": TaskSpec.from_dict(entry["spec"]).to_dict()} for entry in message["tasks"]],
    },
    "amend.request": lambda message: AmendRequest.from_wire(message).to_wire(),
    "undo.request": lambda message: UndoRequest.from_wire(message).to_wire(),
    "error.conflict": lambda message: error_to_wire(error_from_wire(message)),
    "error.busy": lambda message: error_to_wire(error_from_wire(message)),
}


@pytest.mark.parametrize("name", NAMES)
def test_an_independent_encoder_makes_the_same_bytes(name: str) -> None:
    document, data = vector(name)
    assert msgpack.packb(binary(document["message"])) == data
    assert document["encoding"] == encoding(name.split(".", maxsplit=1)[0])
    check_encoding(document["encoding"])


@pytest.mark.parametrize("name", AGAIN)
def test_our_messages_read_the_bytes_and_write_them_again(name: str) -> None:
    data = vector(name)[1]
    assert pack(AGAIN[name](unpack(data))) == data


def test_what_is_packed_around_a_specification_is_the_same_message() -> None:
    specification = pack(spec().to_dict())
    reply = unpack(vector("spec.reply")[1])
    about = {name: value for name, value in reply.items() if name != "spec"}
    assert pack_around(about, "spec", specification) == vector("spec.reply")[1]
    page = unpack(vector("tasks.reply")[1])
    entry = {name: value for name, value in page["tasks"][0].items() if name != "spec"}
    entries = [pack_around(entry, "spec", specification)]
    assert pack_around({"next": page["next"]}, "tasks", entries) == vector("tasks.reply")[1]


@pytest.mark.parametrize("count", [0, 1, 15, 16, 70_000])
def test_a_list_of_encoded_entries_is_the_list_of_the_entries(count: int) -> None:
    entries = [{"number": number} for number in range(count)]
    assert pack_around({"next": None}, "tasks", [pack(entry) for entry in entries]) == pack(
        {"next": None, "tasks": entries}
    )


@pytest.mark.parametrize("name", ["predict.lists.request", "predict.f4.request"])
def test_other_forms_of_an_array_say_the_same(name: str) -> None:
    other = "predict.batch.request" if "lists" in name else "predict.request"
    read, expected = (PredictRequest.from_wire(unpack(vector(one)[1]), 2).states for one in (name, other))
    np.testing.assert_array_equal(read, expected)


def test_every_verb_that_stores_or_asks_has_its_vectors() -> None:
    asked = {"create_task", "info", "tasks", "spec", "predict", "report", "samples", "explain"}
    changed = {
        "recost",
        "remove",
        "amend",
        "undo",
        "configure",
        "rollback",
        "rename",
        "delete",
        "error",
    }
    assert {name.split(".")[0] for name in NAMES} == asked | changed
    assert {path.stem for path in VECTORS.glob("*.msgpack")} == set(NAMES)
