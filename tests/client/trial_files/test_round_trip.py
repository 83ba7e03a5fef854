"""What a task knows leaves it as a file and makes another task that answers the same."""

import csv
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any
from uuid import UUID, uuid4

import numpy as np
import pyarrow.parquet
import pytest
from typer.testing import CliRunner

from crkr.client import Client, Task
from crkr.client.cli.subcommands import build
from crkr.protocol import StoredTrial, Trial

Run = Callable[..., Any]
COUNT = 300
SPEC: dict[str, Any] = {
    "state": [{"name": name, "unit": "m", "low": -1, "high": 1} for name in ("x", "y, up")],
    "goal": [{"name": f"joint {n}", "unit": "rad", "low": -2, "high": 2} for n in range(3)],
    "outcome": [{"name": "miss", "unit": "m", "target": 0.0, "tolerance": 0.1, "group": "hit"}],
    "exploration": {"type": "gaussian"},
    "budget": 40,
    "seed": 5,
}
KINDS = ("trial", "trial", "trial", "evaluation", "demonstration", "failed")


def some_trials(task: Task) -> list[Trial]:
    """Of every kind, with and without all that may be left out."""
    rng = np.random.default_rng(3)
    trials = []
    for number in range(COUNT):
        kind = KINDS[number % len(KINDS)]
        failed = kind == "failed"
        trials.append(
            Trial.create(
                task.spec,
                id=UUID(int=rng.integers(2**62).item() << 64 | number),
                state=rng.normal(size=2),
                goal=rng.uniform(-2, 2, 3),
                cost=None if failed else float(rng.uniform()),
                success=not failed and number % 5 > 0,
                kind=kind,
                outcome=[None, [float("nan")], [float(rng.normal())]][number % 3],
                worker=[None, "ada", 'bob, "the arm"\n'][number % 3],
                model_version=None if number % 4 else number,
                learn=[None, True, False][number % 7 % 3] if kind == "trial" else None,
                info={"epoch": number, "odd": [float("nan"), b"\0\xff", {"é": None}]} if number % 2 else None,
            )
        )
    return trials


@pytest.fixture
def client(shared_endpoint: str) -> Any:
    with Client(shared_endpoint, timeout_s=20) as client:
        client.wait_until_ready(60.0)
        yield client


@pytest.fixture
def make_task(client: Client) -> Callable[[], Task]:
    return lambda: client.create_task({"name": f"reach-{uuid4()}", **SPEC})


@pytest.fixture
def told(make_task: Callable[[], Task]) -> Task:
    """A task with trials, some of them corrected and removed since."""
    task = make_task()
    trials = some_trials(task)
    task.report_trials(trials, wait=True)
    tried = [trial for trial in trials if trial.cost is not None]
    task.recost([trial.id for trial in tried[:20]], np.linspace(0, 1, 20), "camera was off")
    task.remove([trial.id for trial in tried[15:40]], "hand slipped")
    return task


@pytest.fixture
def run(shared_endpoint: str) -> Run:
    def run(*words: str, status: int = 0) -> Any:
        arguments = [*words, "--connect", shared_endpoint]
        result = CliRunner().invoke(build(arguments), arguments)
        assert result.exit_code == status, f"{result.stdout}\n{result.stderr}\n{result.exception!r}"
        return json.loads(result.stdout) if "--json" in words else result

    return run


def content(task: Task, *, apart_from: tuple[str, ...] = ()) -> list[dict[str, Any]]:
    """Everything that the server says about its trials, as comparable plain data."""
    return [
        {name: repr(value) for name, value in _fields(stored).items() if name not in apart_from}
        for stored in task.iter_samples()
    ]


def _fields(stored: StoredTrial) -> dict[str, Any]:
    trial = stored.trial
    vectors = {name: getattr(trial, name) for name in ("state", "goal", "outcome")}
    plain = ("id", "cost", "success", "kind", "worker", "model_version", "info")
    return {
        **{name: None if value is None else value.tolist() for name, value in vectors.items()},
        **{name: getattr(trial, name) for name in plain},
        **{name: getattr(stored, name) for name in ("seq", "time", "removed")},
    }


@pytest.mark.parametrize("kind", ["parquet", "csv", "npz"])
def test_an_exported_task_is_imported_as_one_that_answers_the_same(
    told: Task, make_task: Callable[[], Task], run: Run, tmp_path: Path, kind: str
) -> None:
    first, second = tmp_path / f"first.{kind}", tmp_path / f"second.{kind}"
    assert run("export", told.name, str(first), "--json")["trials"] == COUNT
    other = make_task()
    done = run("import", other.name, str(first), "--json")
    assert (done["accepted"], done["duplicates"], done["removed"]) == (COUNT, 0, 25)

    assert content(other, apart_from=("time",)) == content(told, apart_from=("time",))
    models = [task.model() for task in (told, other)]
    assert models[0]["ids"] == models[1]["ids"]
    assert len(models[0]["ids"]) == 40
    states = np.random.default_rng(0).normal(size=(50, 2))
    answers = [task.predict(states) for task in (told, other)]
    for name in ("mean", "sigma", "novelty"):
        assert np.abs(getattr(answers[0], name) - getattr(answers[1], name)).max() <= 1e-9

    again = run("import", other.name, str(first), "--json")
    assert (again["accepted"], again["duplicates"], again["removed"]) == (0, COUNT, 0)
    back = run("import", told.name, str(first), "--json")  # its costs are others than were reported
    assert (back["accepted"], back["duplicates"], back["removed"]) == (0, COUNT, 0)
    assert sum(other.status()["samples"].values()) == COUNT

    run("export", other.name, str(second))
    assert columns_of(second) == columns_of(first)


def columns_of(path: Path) -> dict[str, str]:
    """A file's columns apart from the times, read without anything of ours."""
    if path.suffix == ".parquet":
        columns = pyarrow.parquet.read_table(path).to_pydict()
    elif path.suffix == ".csv":
        with path.open(newline="") as file:
            header, *rows = csv.reader(file)
        columns = {name: [row[place] for row in rows] for place, name in enumerate(header)}
    else:
        with np.load(path, allow_pickle=False) as found:
            columns = {name: (found[name].shape, found[name].tobytes()) for name in found.files}
    del columns["time"]
    return {name: repr(values) for name, values in columns.items()}


def test_other_programs_find_every_field_in_the_files(told: Task, run: Run, tmp_path: Path) -> None:
    for kind in ("parquet", "csv", "npz"):
        run("export", told.name, str(tmp_path / f"a.{kind}"))
    stored = list(told.iter_samples())
    rows = pyarrow.parquet.read_table(tmp_path / "a.parquet").to_pylist()
    with (tmp_path / "a.csv").open(newline="") as file:
        lines = list(csv.DictReader(file))
    arrays = np.load(tmp_path / "a.npz", allow_pickle=False)
    assert len(rows) == len(lines) == len(arrays["seq"]) == COUNT
    assert arrays["state_names"].tolist() == ["x", "y, up"]
    for place, (one, row, line) in enumerate(zip(stored, rows, lines, strict=True)):
        trial = one.trial
        assert row["id"] == line["id"] == arrays["id"][place] == str(trial.id)
        assert (row["seq"], row["time"], row["removed"]) == (one.seq, one.time, one.removed)
        assert (row["kind"], row["success"], row["cost"]) == (trial.kind, trial.success, trial.cost)
        assert (row["worker"], row["model_version"]) == (trial.worker, trial.model_version)
        assert [row["state.x"], row["state.y, up"]] == trial.state.tolist()
        assert [float(line["state.x"]), float(line["state.y, up"])] == trial.state.tolist()
        assert arrays["goal"][place].tolist() == trial.goal.tolist() == [row[f"goal.joint {n}"] for n in range(3)]
        assert line["cost"] == ("" if trial.cost is None else repr(trial.cost) if trial.cost % 1 else f"{trial.cost:g}")
        if trial.outcome is None:
            assert (row["outcome.miss"], line["outcome.miss"]) == (None, "")
        else:
            assert repr([row["outcome.miss"]]) == repr(trial.outcome.tolist()) == repr([float(line["outcome.miss"])])
        assert bool(arrays["outcome_given"][place]) is (trial.outcome is not None)
        assert (json.loads(row["info"])["epoch"] if row["info"] else None) == trial.info.get("epoch")
    text = arrays["info"].tobytes().decode().splitlines()
    assert [line or None for line in text] == [row["info"] for row in rows]
    arrays.close()


def test_an_empty_task_is_an_empty_file(make_task: Callable[[], Task], run: Run, tmp_path: Path) -> None:
    for kind in ("parquet", "csv", "npz"):
        file = tmp_path / f"empty.{kind}"
        assert run("export", make_task().name, str(file), "--json")["trials"] == 0
        assert run("import", make_task().name, str(file)).stdout.endswith(": 0 trials stored, 0 known already\n")


def test_a_file_is_not_overwritten_unless_told_and_never_half(told: Task, run: Run, tmp_path: Path) -> None:
    file = tmp_path / "a.csv"
    file.write_text("mine")
    assert "exists" in run("export", told.name, str(file), status=1).stderr
    assert "UNKNOWN" not in run("export", "nobody", str(file), "--overwrite", status=1).stderr
    assert file.read_text() == "mine"
    run("export", told.name, str(file), "--overwrite")
    assert file.read_text().startswith('"id",')
    assert [path.name for path in tmp_path.iterdir()] == ["a.csv"]


def test_a_trial_of_other_content_stops_the_import_at_its_row(
    told: Task, make_task: Callable[[], Task], run: Run, tmp_path: Path
) -> None:
    file = tmp_path / "a.csv"
    run("export", told.name, str(file))
    with file.open(newline="") as source:
        header, *rows = csv.reader(source)
    rows[280][header.index("cost")] = "0.123"
    with file.open("w", newline="") as target:
        csv.writer(target).writerows([header, *rows])
    before = content(told)
    error = run("import", told.name, str(file), status=1).stderr
    assert f"row 281: trial {rows[280][0]} is stored" in error.replace("\n", " ")
    assert content(told) == before
