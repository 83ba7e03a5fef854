"""A file that is cut off, damaged or crafted is refused in one line, before memory is taken for what it claims."""

import io
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any
from uuid import UUID

import numpy as np
import pyarrow as pa
import pyarrow.parquet
import pytest
from hypothesis import given
from hypothesis import strategies as st

from crkr.client.trial_files import Layout, trial_sink, trial_source
from crkr.protocol import CrkrError, Invalid, StoredTrial, TaskSpec

LAYOUT = Layout(
    TaskSpec.from_dict(
        {
            "name": "t",
            "state": [{"name": "x", "low": 0, "high": 1}],
            "goal": [{"name": "a", "low": 0, "high": 1}],
        }
    )
)
HEADER = "id,kind,success,cost,state.x,goal.a,note\n"
# What a command may take beside the interpreter and its libraries.
LIMIT_MIB = 400


def line(number: int, note: str = "ok") -> str:
    return f"{UUID(int=number)},trial,true,0.5,0.5,0.5,{note}\n"


def read(path: Path) -> int:
    source = trial_source(path, LAYOUT)
    count = len(list(source.rows))
    assert count == source.count
    return count


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        (HEADER + line(1) + line(2, '"5 inch ball') + line(3), "row 2: a quote is opened here and never closed"),
        (HEADER + line(1) + line(2, '"cut o')[:-1], "row 2: a quote is opened here and never closed"),
        (HEADER + line(1, '"5 inch') + line(2) + line(3, '5 inch"'), "row 1, column 'note': whole rows are between"),
        (HEADER + line(1, '"a"b'), "row 1: ',' expected"),
        (HEADER + line(1) + line(2)[:30], "row 2: Expected 7 columns, got 1"),
        (HEADER + line(1, "a,b"), "row 1: Expected 7 columns, got 8"),
        (HEADER + line(1, "x" * 2**21), "line 2 has more than 1048576 characters"),
        (HEADER + line(1, '"' + "x\n" * 2**20 + '"'), "row 1: field larger than field limit"),
        (HEADER + line(1).replace("trial", "tr\udcffial"), "row 1, column 'kind': .*invalid UTF8"),
    ],
)
def test_a_csv_that_is_not_whole_stores_nothing(tmp_path: Path, text: str, complaint: str) -> None:
    path = tmp_path / "a.csv"
    path.write_bytes(text.encode(errors="surrogateescape"))
    with pytest.raises(Invalid, match=complaint):
        next(trial_source(path, LAYOUT).rows)


def test_quotes_and_line_breaks_within_cells_are_taken(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text(HEADER + line(1, '"said ""no""\nand left, twice"') + "\n" + line(2, 'a "b"'), encoding="utf-8")
    assert read(path) == 2


def npz(path: Path, members: dict[str, bytes]) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in members.items():
            archive.writestr(f"{name}.npy", data)
    return path


def npy(shape: tuple[int, ...], data: bytes, descr: Any = "<f8", version: tuple[int, int] = (1, 0)) -> bytes:
    header = io.BytesIO()
    write = np.lib.format.write_array_header_1_0 if version == (1, 0) else np.lib.format.write_array_header_2_0
    write(header, {"descr": descr, "fortran_order": False, "shape": shape})
    return header.getvalue() + data


def good_arrays() -> dict[str, Any]:
    return {
        "id": np.array([str(UUID(int=1)), str(UUID(int=2))]),
        "kind": np.array(["trial", "trial"]),
        "success": np.array([True, False]),
        "cost": np.array([0.5, 0.25]),
        "state": np.array([[0.5], [0.25]]),
        "goal": np.array([[0.5], [0.25]]),
    }


def good_members() -> dict[str, bytes]:
    members = {}
    for name, array in good_arrays().items():
        file = io.BytesIO()
        np.save(file, array)
        members[name] = file.getvalue()
    return members


@pytest.mark.parametrize(
    ("name", "data", "complaint"),
    [
        ("state", npy((2**31, 3), b"\0" * 1000), "state should have 51539607552 bytes, but there are 1000"),
        ("state", npy((2, 2**40), b""), "state should have"),
        ("state", npy((2, 2**14), b"\0" * 2**18), "state has more than 65536 bytes a row"),
        ("id", npy((2,), b"\0" * 2**19, "<U65536"), "id has more than 65536 bytes a row"),
        ("kind", npy((2,), b"\0" * 2**20, f"<U{2**17}"), "kind has more than 65536 bytes a row"),
        ("cost", npy((2,), b"\0" * 8), "cost should have 16 bytes, but there are 8"),
        ("cost", npy((-1,), b""), "it is not npz"),
        ("cost", b"\x93NUMPY\x01\0" + (9000).to_bytes(2, "little") + b"(" * 9000, "it is not npz"),
        ("cost", b"\x93NUMPY\x01\0" + (9000).to_bytes(2, "little") + b"[" * 9000, "it is not npz"),
        ("cost", b"\x93NUMPY\x09\0", "it is not npz"),
        ("cost", b"", "it is not npz"),
        ("info", npy((3,), b"\xff\n\n", "|u1"), "row 1, column 'info': it is not UTF-8"),
        ("info", npy((2**21 + 2,), b"x" * 2**21 + b"\n\n", "|u1"), "row 1, column 'info': it has more than"),
        ("outcome_given", npy((2,), np.array([1.0, np.nan]).tobytes()), "row 2: outcome_given must be true or false"),
    ],
)
def test_an_array_that_lies_about_itself_is_refused(tmp_path: Path, name: str, data: bytes, complaint: str) -> None:
    assert read(npz(tmp_path / "good.npz", good_members())) == 2
    with pytest.raises(Invalid, match=complaint):
        read(npz(tmp_path / "a.npz", {**good_members(), name: data}))


def test_arrays_that_no_trial_is_made_of_are_not_read(tmp_path: Path) -> None:
    strangers = {"extra": b"no array at all", "seq": npy((2**40,), b""), "time": npy((1,), b"\0" * 8)}
    assert read(npz(tmp_path / "a.npz", {**good_members(), **strangers})) == 2


def good_parquet(path: Path) -> Path:
    columns = {name: array.ravel() for name, array in good_arrays().items()}
    columns["state.x"], columns["goal.a"] = columns.pop("state"), columns.pop("goal")
    pyarrow.parquet.write_table(pa.table(columns), path, use_dictionary=False, compression="gzip")
    return path


def test_a_parquet_file_whose_columns_would_fill_the_memory_is_refused(tmp_path: Path) -> None:
    count = 2**25 + 1
    zeros = pa.array(np.zeros(count))
    columns = {"id": pa.nulls(count), "kind": pa.nulls(count), "success": pa.nulls(count)}
    table = pa.table({**columns, "cost": zeros, "state.x": zeros, "goal.a": zeros})
    path = tmp_path / "a.parquet"
    pyarrow.parquet.write_table(table, path, row_group_size=count, use_dictionary=False, compression="zstd")
    with pytest.raises(Invalid, match=r"a group of its rows would have \d+ bytes, but the file has \d+;"):
        trial_source(path, LAYOUT)


@pytest.mark.parametrize("kind", ["npz", "parquet"])
def test_a_bit_that_fell_over_in_an_export_is_found(tmp_path: Path, kind: str) -> None:
    trials = [
        StoredTrial(row.trial, 2, 0.0) for row in trial_source(npz(tmp_path / "a.npz", good_members()), LAYOUT).rows
    ]
    path = tmp_path / f"b.{kind}"
    with trial_sink(path, LAYOUT) as sink:
        sink.write(LAYOUT.columns(trials))
    data = bytearray(path.read_bytes())
    data[data.index(np.float64(0.25).tobytes()) + 6] ^= 1  # of the second state
    path.write_bytes(data)
    with pytest.raises(Invalid, match=f"{path}: .*(CRC|crc)"):
        read(path)


@pytest.mark.parametrize("kind", ["npz", "parquet", "csv"])
@given(place=st.floats(0, 1, exclude_max=True), change=st.binary(min_size=0, max_size=8), cut=st.booleans())
def test_a_damaged_file_is_read_or_refused_but_no_more(
    tmp_path_factory: pytest.TempPathFactory, kind: str, place: float, change: bytes, cut: bool
) -> None:
    folder = tmp_path_factory.mktemp("damaged")
    path = folder / f"a.{kind}"
    if kind == "npz":
        npz(path, good_members())
    elif kind == "parquet":
        good_parquet(path)
    else:
        path.write_text(HEADER + line(1) + line(2, '"x"'), encoding="utf-8")
    data = path.read_bytes()
    first = int(place * len(data))
    path.write_bytes(data[:first] + change + (b"" if cut else data[first + len(change) :]))
    try:
        assert read(path) <= 2
    except CrkrError as error:
        assert error.message.startswith(str(path))  # noqa: PT017 - either end is right


def run(*words: str, stdin: Any = subprocess.DEVNULL) -> tuple[int, str, float]:
    """A command's status, what it says, and the most memory that it took [MiB]."""
    program = (
        "import resource, subprocess, sys\n"
        "done = subprocess.run(sys.argv[1:], stdin=0, capture_output=True)\n"
        "sys.stdout.buffer.write(done.stdout + done.stderr)\n"
        "print('\\n', done.returncode, resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss)\n"
    )
    command = [sys.executable, "-c", program, sys.executable, "-m", "crkr.client", *words]
    done = subprocess.run(command, stdin=stdin, capture_output=True, text=True, encoding="utf-8", check=True)
    said, _, last = done.stdout.strip().rpartition("\n")
    status, kib = last.split()
    return int(status), said.strip(), int(kib) / 1024


@pytest.mark.parametrize(
    ("name", "data", "complaint"),
    [
        ("a.toml", b"x = " + b"[" * 5000 + b"]" * 5000, "is nested too deep"),
        ("a.json", b'{"a":' * 5000 + b"1" + b"}" * 5000, "is nested too deep"),
        ("b.json", b'{"name": "x", "seed": ' + b"9" * 5000 + b"}", "is not JSON"),
        ("b.toml", b"seed = " + b"9" * 5000, "is not TOML"),
        ("c.toml", b"name" + b".a" * 5000 + b" = 1", "error: "),
        ("d.toml", b"#" * (2**19 + 1), "has more than 524288 bytes"),
        ("f.toml", b"name" + b".a" * 200_000 + b" = 1", "a key has more than 128 parts"),
        (
            "g.toml",
            b"".join(b"[t%d]\n" % one for one in range(50_000)),
            "unknown fields in the specification: t0",
        ),
        ("d.json", b'{"name": "x", "description": "\\ud800"}', "error: "),
        ("e.toml", b'name = "\xff"', "is not TOML: 'utf-8'"),
        ("c.json", b"[1, 2]", "a task specification is a map; got list"),
    ],
)
def test_a_specification_that_cannot_be_read_is_one_line(
    tmp_path: Path, name: str, data: bytes, complaint: str
) -> None:
    path = tmp_path / name
    path.write_bytes(data)
    status, said, mib = run("create", str(path), "--write", str(tmp_path / "out.json"))
    assert (status, said.count("\n")) == (1, 0)
    assert complaint in said
    assert str(path) in said
    assert len(said) < 1500
    assert mib < LIMIT_MIB


@pytest.fixture(scope="module")
def task(shared_endpoint: str) -> str:
    from crkr.client import Client

    with Client(shared_endpoint, timeout_s=30.0) as client:
        client.wait_until_ready(60.0)
        return client.create_task(LAYOUT.spec).name


def zip_bomb(path: Path) -> None:
    """512 MiB of zeros that nobody asked for, in half a MiB."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in good_members().items():
            archive.writestr(f"{name}.npy", data)
        with archive.open("extra.npy", "w", force_zip64=True) as member:
            member.write(npy((2**26,), b""))
            for _ in range(512):
                member.write(b"\0" * 2**20)


def endless_line(path: Path) -> None:
    with path.open("wb") as file:
        file.write(HEADER.encode())
        file.truncate(2**31)


WRITERS: dict[str, Callable[[Path], Any]] = {
    "bomb.npz": zip_bomb,
    "endless.csv": endless_line,
    "claims.npz": lambda path: npz(path, {**good_members(), "state": npy((2**31, 3), b"\0" * 1000)}),
}


@pytest.mark.parametrize(("name", "status"), [("bomb.npz", 0), ("endless.csv", 1), ("claims.npz", 1)])
def test_an_import_takes_no_memory_for_what_it_does_not_read(
    tmp_path: Path, shared_endpoint: str, task: str, name: str, status: int
) -> None:
    WRITERS[name](tmp_path / name)
    found, said, mib = run("import", task, str(tmp_path / name), "--connect", shared_endpoint)
    assert (found, said.count("\n")) == (status, 0), said
    assert mib < LIMIT_MIB
