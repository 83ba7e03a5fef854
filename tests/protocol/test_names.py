"""Keys, ids and error codes: what other programs and languages derive for themselves."""

import hashlib
from uuid import UUID

import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st

import crkr.protocol as protocol
from crkr.protocol import (
    ADMIN_VERBS,
    SERVER_VERBS,
    TASK_VERBS,
    CrkrError,
    Internal,
    Invalid,
    Unavailable,
    admin_key,
    check_name,
    demonstration_id,
    error_from_wire,
    error_to_wire,
    evaluation_id,
    live_server_key,
    live_worker_key,
    pub_key,
    rpc_key,
    split_key,
    task_id,
    task_key,
    training_id,
)
from crkr.protocol.keys import live_role_key

CODES = {
    "INVALID", "UNKNOWN_TASK", "NO_SAMPLES", "NOVEL_STATE", "CONFLICT", "BUSY", "UNSUPPORTED", "STORAGE",
    "SHUTTING_DOWN", "INTERNAL",
}  # fmt: skip
names = st.from_regex(r"[a-z0-9][a-z0-9-]{0,62}", fullmatch=True)


@given(names)
def test_a_key_is_read_back_as_it_was_made(task: str) -> None:
    assert check_name(task) == task
    for verb in SERVER_VERBS:
        assert split_key(rpc_key(verb)) == ("rpc", "", verb)
    for verb in TASK_VERBS:
        assert split_key(task_key(task, verb)) == ("task", task, verb)
    for verb in ADMIN_VERBS:
        assert split_key(admin_key(task, verb)) == ("admin", task, verb)


def test_keys_are_where_other_programs_look_for_them() -> None:
    assert rpc_key("info") == "crkr/@v1/rpc/info"
    assert task_key("throw", "predict") == "crkr/@v1/task/throw/rpc/predict"
    assert admin_key("throw", "recost") == "crkr/@v1/task/throw/admin/recost"
    assert pub_key("throw", "trial") == "crkr/@v1/task/throw/pub/trial"
    assert live_server_key("x") == "crkr/@v1/live/server/x"
    assert live_worker_key("throw", "w") == "crkr/@v1/task/throw/live/worker/w"
    assert live_role_key("throw", "judge", "x") == "crkr/@v1/task/throw/live/role/judge/x"


def test_the_servers_prefixes_match_their_keys_and_no_others() -> None:
    prefixes = ["crkr/@v1/rpc/*", "crkr/@v1/task/*/rpc/*", "crkr/@v1/task/*/admin/*"]
    keys = [rpc_key("info"), task_key("throw", "predict"), admin_key("throw", "recost")]
    matches = [[zenoh.KeyExpr(prefix).intersects(zenoh.KeyExpr(key)) for key in keys] for prefix in prefixes]
    assert matches == [[True, False, False], [False, True, False], [False, False, True]]


@pytest.mark.parametrize("key", ["", "crkr/@v2/rpc/info", "crkr/@v1/rpc", "crkr/@v1/task/a/b/c", "x/crkr/@v1/rpc/info"])
def test_a_foreign_key_is_refused(key: str) -> None:
    with pytest.raises(Invalid, match="protocol version 1"):
        split_key(key)


@pytest.mark.parametrize("name", ["", "-a", "A", "a_b", "a/b", "a*", "a" * 64, "a\n", "é", None, 5])
def test_a_name_that_cannot_stand_in_a_key_is_refused(name: object) -> None:
    with pytest.raises(Invalid, match="task name"):
        check_name(name)


def uuid5_by_hand(namespace: UUID, text: str) -> UUID:
    """RFC 4122, section 4.3."""
    digest = bytearray(hashlib.sha1(namespace.bytes + text.encode(), usedforsecurity=False).digest()[:16])
    digest[6] = digest[6] & 0x0F | 0x50
    digest[8] = digest[8] & 0x3F | 0x80
    return UUID(bytes=bytes(digest))


def test_ids_are_those_that_another_language_would_make() -> None:
    url = UUID("6ba7b811-9dad-11d1-80b4-00c04fd430c8")
    task = uuid5_by_hand(url, "crkr/throw")
    assert task_id("throw", "anything") == uuid5_by_hand(task, "anything")
    assert demonstration_id("throw", 3) == uuid5_by_hand(task, "demo/3")
    assert evaluation_id("throw", 2, 49) == uuid5_by_hand(task, "eval/2/49")


@given(st.tuples(*[st.integers(0, 3)] * 3), st.tuples(*[st.integers(0, 3)] * 3))
def test_training_ids_differ_where_their_parts_do(one: tuple[int, int, int], other: tuple[int, int, int]) -> None:
    assert (training_id("a", *one) == training_id("a", *other)) == (one == other)
    assert training_id("a", *one) != training_id("b", *one)


def leaves(kind: type[CrkrError]) -> set[type[CrkrError]]:
    return set().union(*(leaves(child) for child in kind.__subclasses__())) or {kind}


def test_every_error_class_has_its_code_and_comes_back_as_itself() -> None:
    kinds = {kind for kind in leaves(CrkrError) if kind.__module__ == CrkrError.__module__}
    assert {kind.code for kind in kinds} == CODES | {Unavailable.code}
    for kind in kinds - {Unavailable}:
        error = error_from_wire(error_to_wire(kind("what happened", retry_ms=20, details={"field": "x"})))
        assert type(error) is kind
        assert (error.message, error.retry_ms, error.details) == ("what happened", 20, {"field": "x"})
        assert error_to_wire(kind("short")) == {"code": kind.code, "message": "short"}


@pytest.mark.parametrize("body", [{}, {"code": 5}, {"code": "NEW", "message": None}, {"retry_ms": "x", "details": 3}])
def test_an_unknown_code_is_internal_and_keeps_what_it_said(body: dict[str, object]) -> None:
    error = error_from_wire(body)
    assert type(error) is Internal
    assert repr(str(body.get("code", ""))) in error.message
    assert (error.retry_ms, error.details) == (None, {})


def test_the_public_surface_is_what_is_bound() -> None:
    assert sorted(set(protocol.__all__)) == sorted(protocol.__all__)
    assert all(hasattr(protocol, name) for name in protocol.__all__)
