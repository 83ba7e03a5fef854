"""What a client may report comes back equal from the server and from files; what earlier versions took is not lost."""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any
from uuid import UUID, uuid4

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as st_numpy
from typer.testing import CliRunner

from crkr.client import Client, Task
from crkr.client.cli.subcommands import build
from crkr.client.trial_files import Layout, trial_sink, trial_source
from crkr.protocol import Invalid, StoredTrial, TaskSpec, Trial, pack, unpack
from crkr.server.log import PendingReport, SqliteLog

SPEC = {
    "state": [{"name": "x", "low": 0, "high": 1}],
    "goal": [{"name": "a", "low": 0, "high": 1}],
    "outcome": [{"name": "m", "tolerance": 1.0}],
    "exploration": {"type": "gaussian"},
}
KINDS = ("csv", "npz", "parquet")


def same(given: Any, got: Any) -> bool:
    if isinstance(given, np.ndarray):
        return isinstance(got, np.ndarray) and np.array_equal(given, got, equal_nan=given.dtype.kind == "f")
    if isinstance(given, dict):
        return isinstance(got, dict) and given.keys() == got.keys() and all(same(given[key], got[key]) for key in given)
    if isinstance(given, list | tuple):
        return isinstance(got, list) and len(given) == len(got) and all(map(same, given, got))
    return (given != given and got != got) or (type(given) is type(got) and bool(given == got))


LEAVES = (
    st.none()
    | st.booleans()
    | st.integers(-(2**64), 2**65)
    | st.floats()
    | st.text(max_size=6)
    | st.binary(max_size=20)
    | st.complex_numbers()
    | st_numpy.arrays(
        st.sampled_from(["<f8", "<f4", "<i8", "u1", "u8", "?", "c16", "<U2", ">f4"]),
        st_numpy.array_shapes(min_dims=0, max_dims=5, max_side=3),
    )
)
KEYS = st.text(max_size=3) | st.sampled_from(["$msgpack", "shape", "dtype", "data", "a\nb", 'a,"b'])
INFO = st.dictionaries(
    KEYS,
    st.recursive(LEAVES, lambda inner: st.lists(inner, max_size=3) | st.dictionaries(KEYS, inner, max_size=3)),
    max_size=3,
)


@pytest.fixture(scope="module")
def client(shared_endpoint: str) -> Any:
    with Client(shared_endpoint, timeout_s=20) as client:
        client.wait_until_ready(60.0)
        yield client


@pytest.fixture(scope="module")
def tasks(client: Client) -> list[Task]:
    """One to report to, and one for each kind of file."""
    return [client.create_task({"name": f"toss-{uuid4()}", **SPEC}) for _ in range(4)]


def written(layout: Layout, trials: list[StoredTrial], path: Path) -> Path:
    with trial_sink(path, layout, overwrite=True) as sink:
        sink.write(layout.columns(trials))
    return path


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(info=INFO)
def test_info_is_refused_or_comes_back_equal_from_the_server_and_every_file(
    tasks: list[Task], tmp_path: Path, info: dict[str, Any]
) -> None:
    task, *others = tasks
    try:
        receipt = task.report(state=[0.5], goal=[0.5], cost=0.5, success=True, info=info)
    except Invalid as error:
        assert error.message.startswith("info")  # noqa: PT017 - either end is right
        return
    [stored], _ = task.samples(receipt.seqs[0] - 1, 1)
    assert same(info, stored.trial.info)
    for kind, other in zip(KINDS, others, strict=True):
        [row] = trial_source(written(Layout(task.spec), [stored], tmp_path / f"a.{kind}"), Layout(task.spec)).rows
        assert not row.packed
        assert same(info, row.trial.info)
        [again], _ = other.samples(other.report_trials([row.trial]).seqs[0] - 1, 1)
        assert same(info, again.trial.info)


def nested(depth: int) -> dict[str, Any]:
    value: Any = None
    for _ in range(depth - 1):
        value = [value]
    return {"a": value}


OLD: list[dict[str, Any]] = [
    nested(40),
    nested(400),
    nested(900),
    {"torque": {b"k": [1, math.inf]}},
    {"forces": {"shape": [2], "dtype": "<f4", "data": b"\0\0\x80?\0\0\0@"}},
    {"map": {"shape": [2], "dtype": "?", "data": b""}},
]


@pytest.fixture
def old_log(tmp_path: Path) -> Path:
    """A data directory with info as the version before took it."""
    spec = TaskSpec.from_dict({"name": "toss", **SPEC})
    state = np.array([0.5])
    trials = [Trial(UUID(int=number + 1), state, state, 0.5, True, info=info) for number, info in enumerate([*OLD, {}])]
    (tmp_path / "data").mkdir()
    log = SqliteLog(tmp_path / "data")
    log.create(spec)
    log.append_reports([PendingReport("toss", tuple(trials))])
    log.close()
    return tmp_path / "data"


def run(endpoint: str, *words: str) -> str:
    arguments = [*words, "--connect", endpoint]
    result = CliRunner().invoke(build(arguments), arguments)
    assert result.exit_code == 0, f"{result.stdout}\n{result.stderr}\n{result.exception!r}"
    return result.stdout + result.stderr


def test_a_log_of_the_version_before_is_exported_and_imported_with_all_its_info(
    old_log: Path, start_server: Callable[..., Any], tmp_path: Path
) -> None:
    endpoint = start_server(data=old_log).endpoint
    with Client(endpoint) as client:
        infos = [stored.trial.info for stored in client.task("toss").iter_samples()]
        assert same(infos[4]["forces"], np.array([1, 2], np.float32))
        assert infos[:4] + infos[5:] == [*OLD[:4], OLD[5], {}]
        for kind in KINDS:
            client.create_task({"name": kind, **SPEC})
            run(endpoint, "export", "toss", str(tmp_path / f"a.{kind}"))
            said = run(endpoint, "import", kind, str(tmp_path / f"a.{kind}"))
            assert "7 trials stored" in said
            assert "4 rows have info that an earlier version took" in said
            again = [stored.trial.info for stored in client.task(kind).iter_samples()]
            assert [unpack(info["$msgpack"], depth=None) for info in again[:4]] == OLD[:4]
            assert same(infos[4:], again[4:])
            assert "0 trials stored, 7 known" in run(endpoint, "import", "toss", str(tmp_path / f"a.{kind}"))


def test_an_outcome_that_became_empty_cells_is_the_one_that_was_stored(
    client: Client, shared_endpoint: str, tmp_path: Path
) -> None:
    task = client.create_task({"name": f"toss-{uuid4()}", **SPEC})
    for outcome in ([math.nan], None, [1.5]):
        task.report(state=[0.5], goal=[0.5], cost=1.0, success=False, outcome=outcome)
    stored = list(task.iter_samples())
    layout = Layout(task.spec)
    columns = layout.columns(stored)
    changes: list[list[float | None]] = [[None, None, 1.5], [math.nan, math.nan, 1.5]]
    for number, measured in enumerate(changes):
        for kind in KINDS:
            path = tmp_path / f"{number}.{kind}"
            with trial_sink(path, layout) as sink:
                sink.write({**columns, "outcome.m": measured})
            assert "0 trials stored, 3 known" in run(shared_endpoint, "import", task.name, str(path))


def test_a_goal_and_what_float32_made_of_it_are_one_trial(client: Client) -> None:
    goal = {"name": "a", "low": -0.3, "high": 0.7}
    task = client.create_task({"name": f"toss-{uuid4()}", **SPEC, "goal": [goal]})
    one = uuid4()
    for value in (np.float32(-0.3), -0.3, -0.3 - 1e-7):
        receipt = task.report(state=[0.5], goal=[value], cost=np.float64(1 + 1e-7), success=True, id=one)
        assert receipt.accepted + receipt.duplicates == 1
    [stored] = task.iter_samples()
    assert (stored.trial.goal.tolist(), stored.trial.cost) == ([-0.3], 1.0)
    raw = unpack(pack({**stored.trial.to_wire(), "goal": [-0.30000001192092896], "cost": 1.0000001}))
    assert Trial.from_wire(raw, task.spec).digest() == stored.trial.digest()
    task.recost([one], [-1e-9])
    [stored] = task.iter_samples()
    assert stored.trial.cost == 0.0


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("worker", [None, "", " ", "nan", "NULL", '"', "a\nb", "a\r\n,b", "θ", "-1"])
def test_a_worker_and_a_version_come_back_equal_from_every_file(tmp_path: Path, kind: str, worker: str | None) -> None:
    layout = Layout(TaskSpec.from_dict({"name": "toss", **SPEC}))
    told = {"worker": worker, "model_version": 2**53 + 1}
    one: dict[str, Any] = {"state": [0.1], "goal": [0.2], "cost": 0.3, "success": True, **told}
    trial = Trial.create(layout.spec, id=UUID(int=1), **one)
    [row] = trial_source(written(layout, [StoredTrial(trial, 2, 1.0)], tmp_path / f"a.{kind}"), layout).rows
    assert (row.trial.worker, row.trial.model_version) == (worker, 2**53 + 1)
    assert row.trial.digest() == trial.digest()
