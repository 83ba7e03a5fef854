"""Files as data frames, databases and spreadsheets write them are taken; a cell that is no value is named.

pandas writes a truth value or a whole number with gaps as floats or nulls, and NaN as an empty cell; Polars writes
large strings; DuckDB writes UUIDs as 16 bytes, decimals, and dates beside them.
"""

from collections.abc import Callable
from datetime import datetime
from decimal import Decimal
from pathlib import Path
from typing import Any
from uuid import UUID

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet
import pytest

from crkr.client.trial_files import FileRow, Layout, trial_source
from crkr.protocol import Invalid, TaskSpec

Write = Callable[[dict[str, Any]], Path]
IDS = [UUID(int=1), UUID(int=2)]
NAN = float("nan")


@pytest.fixture
def layout() -> Layout:
    return Layout(
        TaskSpec.from_dict(
            {
                "name": "t",
                "state": [{"name": "x", "low": 0, "high": 1}],
                "goal": [{"name": "a", "low": 0, "high": 4}],
                "outcome": [{"name": "m", "tolerance": 1.0}, {"name": "n", "tolerance": 1.0}],
                "exploration": {"type": "gaussian"},
            }
        )
    )


def columns(changes: dict[str, Any]) -> dict[str, Any]:
    good: dict[str, Any] = {
        "id": [str(one) for one in IDS],
        "kind": ["trial", "trial"],
        "success": [True, False],
        "cost": [0.5, 0.25],
        "state.x": [1.0, 2.0],
        "goal.a": [1.0, 2.0],
        **changes,
    }
    return {name: value if isinstance(value, pa.Array) else pa.array(value) for name, value in good.items()}


@pytest.fixture
def parquet(tmp_path: Path) -> Write:
    def write(changes: dict[str, Any]) -> Path:
        pyarrow.parquet.write_table(pa.table(columns(changes)), tmp_path / "a.parquet")
        return tmp_path / "a.parquet"

    return write


@pytest.fixture
def csv(tmp_path: Path) -> Write:
    def write(changes: dict[str, Any]) -> Path:
        pyarrow.csv.write_csv(pa.table(columns(changes)), tmp_path / "a.csv")
        return tmp_path / "a.csv"

    return write


@pytest.fixture
def npz(tmp_path: Path) -> Write:
    def write(changes: dict[str, Any]) -> Path:
        arrays = {
            name: np.array(column.to_pylist(), dtype=None if column.null_count == 0 else float)
            for name, column in columns(changes).items()
        }
        arrays["state"], arrays["goal"] = arrays.pop("state.x")[:, None], arrays.pop("goal.a")[:, None]
        np.savez(tmp_path / "a.npz", allow_pickle=False, **arrays)
        return tmp_path / "a.npz"

    return write


@pytest.fixture(params=["parquet", "csv", "npz"])
def write(request: pytest.FixtureRequest) -> Write:
    made: Write = request.getfixturevalue(request.param)
    return made


def rows(path: Path, layout: Layout) -> list[FileRow]:
    source = trial_source(path, layout)
    found = list(source.rows)
    assert len(found) == source.count
    return found


@pytest.mark.parametrize("flags", [[1.0, 0.0], [1, 0], [True, False]])
def test_a_flag_may_be_a_truth_value_or_one_and_zero(write: Write, layout: Layout, flags: list[Any]) -> None:
    found = rows(write({"success": flags, "removed": flags}), layout)
    assert [(row.trial.success, row.removed) for row in found] == [(True, True), (False, False)]


@pytest.mark.parametrize("column", ["success", "removed"])
@pytest.mark.parametrize("odd", [NAN, 0.3, -2.0, 2.0])
def test_any_other_number_is_no_flag(write: Write, layout: Layout, column: str, odd: float) -> None:
    with pytest.raises(Invalid, match=f"row 2(: |, column '){column}'?:? must be true or false"):
        rows(write({column: [1.0, odd]}), layout)


def test_columns_that_an_import_does_not_use_are_not_read(parquet: Write, csv: Write, layout: Layout) -> None:
    extra = {"time": [datetime(2026, 1, 1)] * 2, "seq": ["a", "b"], "note": [b"\xff", b"\xfe"]}
    assert [row.trial.id for row in rows(parquet({**extra, "when": [[1], [2]]}), layout)] == IDS
    assert [row.trial.id for row in rows(csv({"time": ["now", "then"], "seq": ["a", "b"]}), layout)] == IDS
    path = csv({"note": ["here", "there"]})
    path.write_bytes(path.read_bytes().replace(b"here", b"h\xe9re"))  # a column in Latin-1
    assert [row.trial.id for row in rows(path, layout)] == IDS


@pytest.mark.parametrize(
    "ids",
    [
        pa.array([one.bytes for one in IDS], pa.binary(16)),
        pa.array([one.bytes for one in IDS], pa.uuid()),
        pa.array([str(one) for one in IDS], pa.large_string()),
        pa.array([str(one) for one in IDS]).dictionary_encode(),
        pa.array([str(one).encode() for one in IDS], pa.binary()),
        pa.array([one.hex.upper() for one in IDS], pa.string_view()),
    ],
)
def test_ids_are_text_or_uuids(parquet: Write, layout: Layout, ids: Any) -> None:
    assert [row.trial.id for row in rows(parquet({"id": ids}), layout)] == IDS


def test_the_gaps_of_a_data_frame_are_gaps(parquet: Write, csv: Write, layout: Layout) -> None:
    changes: dict[str, Any] = {
        "kind": pa.array(["failed", "trial"]).dictionary_encode(),
        "success": [False, True],
        "cost": pa.array([NAN, 0.25]),
        "model_version": pa.array([NAN, 3.0]),
        "worker": pa.array([None, None], pa.float64()),
        "info": pa.array([None, '{"epoch": 3}']),
        "removed": pa.array([None, True]),
        "outcome.m": pa.array([None, 1.5]),
        "outcome.n": pa.array([None, None], pa.float64()),
    }
    text = {"kind": ["failed", "trial"], "worker": pa.array([None, None], pa.string())}
    for path in (parquet(changes), csv({**changes, **text})):
        first, second = rows(path, layout)
        one = first.trial
        assert (one.cost, one.model_version, one.worker, first.removed) == (None, None, None, False)
        assert first.trial.outcome is None
        assert second.trial.outcome is not None
        assert (second.trial.cost, second.trial.model_version, second.removed) == (0.25, 3, True)
        assert np.array_equal(second.trial.outcome, [1.5, NAN], equal_nan=True)
        assert second.trial.info == {"epoch": 3}


@pytest.mark.parametrize("gap", ["", '""', "NA", "<NA>", "NULL"])
def test_the_gaps_of_a_table_in_text_are_gaps(tmp_path: Path, layout: Layout, gap: str) -> None:
    path = tmp_path / "a.csv"
    names = "id,kind,success,cost,state.x,goal.a,outcome.m,outcome.n,model_version,removed,worker"
    path.write_text(f"{names}\n{IDS[0]},failed,FALSE,{gap},1,2,{gap},0.5,{gap},{gap},NA\n", encoding="utf-8")
    [row] = rows(path, layout)
    assert (row.trial.cost, row.trial.model_version, row.removed, row.trial.worker) == (None, None, False, "NA")
    assert np.array_equal(np.asarray(row.trial.outcome), [NAN, 0.5], equal_nan=True)
    path.write_text(path.read_text(encoding="utf-8").replace("FALSE", gap), encoding="utf-8")
    with pytest.raises(Invalid, match="row 1: success must be true or false"):
        rows(path, layout)


def test_numbers_of_a_database_are_numbers(parquet: Write, layout: Layout) -> None:
    path = parquet(
        {"cost": [Decimal("0.50"), Decimal("0.25")], "state.x": pa.array([1, 2], pa.int8()), "goal.a": ["1", " 2e0 "]}
    )
    assert [(row.trial.cost, row.trial.state[0], row.trial.goal[0]) for row in rows(path, layout)] == [
        (0.5, 1.0, 1.0),
        (0.25, 2.0, 2.0),
    ]


@pytest.mark.parametrize(
    ("column", "values", "complaint"),
    [
        ("cost", [datetime(2026, 1, 1)] * 2, "row 1, column 'cost': a trial has no value of type timestamp"),
        ("state.x", [[1.0], [2.0]], "row 1, column 'state.x': a trial has no value of type list"),
        ("state.x", [True, False], "row 1, column 'state.x': must be a number; got True"),
        ("goal.a", [1.0, None], "row 2: goal must be finite; column 'goal.a' is empty"),
        ("goal.a", ["1", "1_0"], "row 2, column 'goal.a': must be a number; got '1_0'"),
        ("goal.a", ["1", "2" * 5000], "row 2: goal must be finite; got inf"),
        ("model_version", [1.0, 1.5], "row 2: model_version must be a whole number"),
        ("worker", [1, 2], "row 1, column 'worker': must be text; got 1"),
        ("id", [str(IDS[0]), "2"], "row 2: id must be a UUID; got '2'"),
        ("id", [b"\xff" * 7] * 2, "row 1: id must be a UUID"),
        ("id", [1, 2], "row 1: id must be a UUID; got 1"),
        ("info", ["{}", '{"a": 1' + "0" * 5000 + "}"], "row 2: info must be JSON"),
        ("info", ["{}", '{"a": 18446744073709551616}'], r"row 2: info\.a must be a whole number of 64 bits"),
        ("info", ["{}", '{"a": "\\ud800"}'], r"row 2: info\.a cannot be encoded"),
    ],
)
def test_a_cell_that_is_no_value_is_named(
    parquet: Write, layout: Layout, column: str, values: list[Any], complaint: str
) -> None:
    with pytest.raises(Invalid, match=complaint):
        rows(parquet({column: values}), layout)


def test_goals_that_were_kept_as_float32_are_taken(parquet: Write) -> None:
    spec = {
        "name": "t",
        "state": [{"name": "x", "low": 0, "high": 1}],
        "goal": [{"name": "a", "low": -0.3, "high": 0.7}],
    }
    path = parquet({"goal.a": pa.array([-0.3, 0.7], pa.float32())})
    found = rows(path, Layout(TaskSpec.from_dict(spec)))
    assert [row.trial.goal.tolist() for row in found] == [[-0.3], [float(np.float32(0.7))]]


def test_a_matrix_that_is_kept_by_columns_is_read_by_rows(npz: Write, layout: Layout) -> None:
    path = npz({})
    arrays = dict(np.load(path))
    arrays["outcome"] = np.asfortranarray([[1.0, 2.0], [3.0, 4.0]])
    np.savez(path, **arrays)
    measured = [row.trial.outcome for row in rows(path, layout)]
    assert [one.tolist() for one in measured if one is not None] == [[1.0, 2.0], [3.0, 4.0]]
