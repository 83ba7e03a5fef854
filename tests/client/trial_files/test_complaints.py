"""A file that does not fit is refused with its name, the row and the column."""

from collections.abc import Callable
from pathlib import Path
from typing import Any
from uuid import UUID

import numpy as np
import pyarrow as pa
import pyarrow.parquet
import pytest

from crkr.client.trial_files import Layout, check_kind, trial_sink, trial_source
from crkr.protocol import Invalid, StoredTrial, TaskSpec, Trial

Write = Callable[[str], Path]
GOOD = (
    f"id,kind,success,cost,state.x,goal.a,outcome.m\n{UUID(int=1)},trial,true,0.5,1,2,\n{UUID(int=2)},trial,1,0.25,1,2,"
)

NPY = b"\x93NUMPY\x01\0v\0{'descr': '<f8', 'fortran_order': False, 'shape': (0,), }".ljust(127) + b"\n"


@pytest.fixture
def layout() -> Layout:
    spec = {
        "name": "t",
        "state": [{"name": "x", "low": 0, "high": 1}],
        "goal": [{"name": "a", "low": 0, "high": 4}],
        "outcome": [{"name": "m", "target": 0.0, "tolerance": 1.0}],
        "exploration": {"type": "gaussian"},
    }
    return Layout(TaskSpec.from_dict(spec))


def rows(path: Path, layout: Layout) -> list[Trial]:
    source = trial_source(path, layout)
    found = [row.trial for row in source.rows]
    assert len(found) == source.count
    return found


def test_a_file_of_a_spreadsheet_is_read(tmp_path: Path, layout: Layout) -> None:
    path = tmp_path / "a.csv"
    lines = [
        "\ufeffstate.x,goal.a,outcome.m,note,model_version,id,kind,success,cost",
        f"1,2,,n,3.0,{UUID(int=1)},trial,TRUE,0.5",
        f"1,2,nan,,,{UUID(int=2).hex},trial,False,1",
        f"1,2,3.5,,,{UUID(int=3)},failed,0,",
    ]
    path.write_text("\r\n".join(lines) + "\r\n")
    found = rows(path, layout)
    assert [trial.id.int for trial in found] == [1, 2, 3]
    assert [trial.cost for trial in found] == [0.5, 1.0, None]
    assert [trial.success for trial in found] == [True, False, False]
    assert (
        repr([None if trial.outcome is None else trial.outcome.tolist() for trial in found]) == "[None, [nan], [3.5]]"
    )
    assert [trial.model_version for trial in found] == [3, None, None]


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        ("0.25", "much", "row 2, column 'cost': .*much"),
        (",0.25,1,2,", ",0.25,1,2", "row 2: Expected 7 columns, got 6"),
        ("0.25", "1.25", r"row 2: cost must be a finite number in \[0"),
        ("0.25", "", "row 2: cost may be null only for kind 'failed'"),
        (str(UUID(int=2)), "two", "row 2: id must be a UUID; got 'two'"),
        ("0.25,1,2", "0.25,1,9", "row 2: goal 'a' must be in"),
        ("0.25,1,2", "0.25,,2", "row 2: state must be finite"),
        ("trial,1,", "test,1,", "row 2: kind must be one of"),
        ("trial,1,", "trial,,", "row 2: success must be true or false"),
        ("trial,1,", "trial,yes,", "row 2, column 'success'"),
        ("state.x", "state.z", "column 'state.x' is missing; there are: id, kind"),
        ("outcome.m", "outcome.n", "column 'outcome.n' is not a coordinate of task 't'"),
        ("outcome.m", "cost", "column 'cost' comes twice"),
        ("outcome.m", "z" * 200_000, "it cannot be read: field larger than"),
        (GOOD, "", "column 'id' is missing; there are: none"),
    ],
)
def test_a_bad_row_of_a_csv_is_named(tmp_path: Path, layout: Layout, old: str, new: str, complaint: str) -> None:
    path = tmp_path / "a.csv"
    assert old in GOOD
    path.write_text(GOOD.replace(old, new))
    with pytest.raises(Invalid, match=complaint) as caught:
        rows(path, layout)
    assert caught.value.message.startswith(f"{path}: ")


def test_a_bad_value_is_found_beside_columns_that_mean_nothing_here(tmp_path: Path, layout: Layout) -> None:
    path = tmp_path / "a.csv"
    path.write_text("\n".join(f"note,{line}" for line in GOOD.replace("0.25", "much").split("\n")))
    with pytest.raises(Invalid, match=r"row 2, column 'cost': .*much"):
        rows(path, layout)


def parquet(path: Path, **changes: Any) -> None:
    columns = {
        "id": [str(UUID(int=1))],
        "kind": ["trial"],
        "success": [True],
        "cost": [0.5],
        "state.x": [1],
        "goal.a": [2],
    }
    pyarrow.parquet.write_table(pa.table({**columns, **changes}), path)


def test_columns_of_a_parquet_file_may_be_of_other_types_that_fit(tmp_path: Path, layout: Layout) -> None:
    path = tmp_path / "a.parquet"
    parquet(path, **{"state.x": pa.array([1], pa.int8()), "goal.a": pa.array([2.0], pa.float32()), "note": [["x"]]})
    [trial] = rows(path, layout)
    assert (trial.state.tolist(), trial.goal.tolist(), trial.outcome) == ([1.0], [2.0], None)


@pytest.mark.parametrize(
    ("column", "value", "complaint"), [("cost", [2.0], "row 1: cost"), ("cost", ["x"], "row 1, column 'cost': .*'x'")]
)
def test_a_bad_value_of_a_parquet_file_is_refused(
    tmp_path: Path, layout: Layout, column: str, value: list[Any], complaint: str
) -> None:
    path = tmp_path / "a.parquet"
    parquet(path, **{column: value})
    with pytest.raises(Invalid, match=complaint):
        rows(path, layout)


def test_a_parquet_file_with_a_column_twice_is_refused(tmp_path: Path, layout: Layout) -> None:
    path = tmp_path / "a.parquet"
    parquet(path)
    table = pyarrow.parquet.read_table(path)
    pyarrow.parquet.write_table(table.append_column("cost", [[0.75]]), path)
    with pytest.raises(Invalid, match="column 'cost' comes twice"):
        rows(path, layout)


def test_a_parquet_file_that_was_damaged_is_refused(tmp_path: Path, layout: Layout) -> None:
    path = tmp_path / "a.parquet"
    parquet(path, kind=["no kind at all" * 9])
    data = path.read_bytes()
    start = data.index(b"no kind at all") - 4  # the length of the text that follows
    path.write_bytes(data[:start] + b"\xff\xff\xff\x7f" + data[start + 4 :])
    with pytest.raises(Invalid, match=f"^{path}: it cannot be read"):
        rows(path, layout)


@pytest.mark.parametrize("kind", [".parquet", ".npz", ".csv"])
@pytest.mark.parametrize("data", [b"", b"PK\x03\x04nothing", b"PAR1PAR1", NPY, b"\0\xff" * 500])
def test_a_file_that_is_no_such_file_is_refused(tmp_path: Path, layout: Layout, kind: str, data: bytes) -> None:
    path = tmp_path / f"a{kind}"
    path.write_bytes(data)
    with pytest.raises(Invalid, match=f"^{path}: "):
        rows(path, layout)


def arrays(**changes: Any) -> dict[str, Any]:
    good = {
        "id": np.array([str(UUID(int=1)), str(UUID(int=2))]),
        "kind": np.array(["trial", "trial"]),
        "success": np.array([True, False]),
        "cost": np.array([0.5, 0.25]),
        "state": np.array([[1.0], [2.0]]),
        "goal": np.array([[1.0], [2.0]]),
    }
    return {name: value for name, value in {**good, **changes}.items() if value is not None}


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"cost": np.array([0.5])}, r"one row for each of the ids; got cost \(1,\)"),
        ({"state": np.zeros((2, 3))}, "state has 3 columns, but the names are: x"),
        ({"state": np.zeros(2)}, "state must be a matrix"),
        ({"state_names": np.array(["y"])}, "column 'state.x' is missing"),
        ({"goal": None}, "column 'goal.a' is missing"),
        ({"goal": np.array([[1.0], [9.0]])}, "row 2: goal 'a' must be in"),
        ({"info": np.frombuffer(b"{}\n", np.uint8)}, "info must have one line for each of 2 trials; got 1"),
        ({"info": np.frombuffer(b"\n[1]\n", np.uint8)}, "row 2: info must be a JSON object"),
        ({"outcome_given": np.array([True])}, r"one row for each of the ids; got outcome_given \(1,\)"),
        ({"removed": np.array(["False", "False"])}, "row 1: removed must be true or false; got 'False'"),
        ({"removed": np.array([False, np.nan])}, "row 2: removed must be true or false; got nan"),
        ({"kind": np.array([object(), "trial"])}, "it is not npz: .*allow_pickle"),
    ],
)
def test_arrays_that_do_not_fit_are_refused(
    tmp_path: Path, layout: Layout, changes: dict[str, Any], complaint: str
) -> None:
    path = tmp_path / "a.npz"
    np.savez(path, **arrays())
    assert [trial.cost for trial in rows(path, layout)] == [0.5, 0.25]
    np.savez(path, **arrays(**changes))
    with pytest.raises(Invalid, match=complaint):
        rows(path, layout)


def test_only_known_endings_are_taken(tmp_path: Path) -> None:
    assert check_kind(tmp_path / "A.CSV") == ".csv"
    with pytest.raises(Invalid, match=r"must end in \.parquet, \.csv, \.npz; got 'a\.xlsx'"):
        check_kind(tmp_path / "a.xlsx")


@pytest.mark.parametrize("kind", [".parquet", ".csv", ".npz"])
def test_a_failure_leaves_no_file(tmp_path: Path, layout: Layout, kind: str) -> None:
    trial = Trial.create(layout.spec, id=UUID(int=1), state=[1], goal=[2], cost=0, success=True)

    def fail() -> None:
        with trial_sink(tmp_path / f"a{kind}", layout) as sink:
            sink.write(layout.columns([StoredTrial(trial, 2, 0.0)]))
            raise KeyError

    with pytest.raises(KeyError):
        fail()
    assert list(tmp_path.iterdir()) == []
