"""Specifications are UTF-8 and what is printed is readable, whatever the locale of the machine."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from crkr.client import Client
from crkr.client.cli.subcommands import build
from crkr.client.commands.spec_files import read_spec, write_spec
from crkr.protocol import Invalid

TILT = (
    'name = "{name}"\n[[state]]\nname = "θ"\nunit = "°"\nlow = 0\nhigh = 90\n[[goal]]\nname = "ν"\nlow = 0\nhigh = 9\n'
)
# No UTF-8 mode, and no locale of UTF-8 in place of this one.
ASCII = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}


def run(*words: str, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "crkr.client", *words],
        env={**os.environ, **environment},
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        encoding="utf-8",
        check=False,
    )


@pytest.mark.parametrize("mark", ["", "\ufeff"])
@pytest.mark.parametrize("ending", ["toml", "json"])
def test_a_specification_is_utf8_with_or_without_a_byte_order_mark(tmp_path: Path, mark: str, ending: str) -> None:
    path = tmp_path / f"tilt.{ending}"
    path.write_text(TILT.format(name="tilt"), encoding="utf-8")
    if ending == "json":
        toml = tmp_path / "tilt.toml"
        toml.write_text(TILT.format(name="tilt"), encoding="utf-8")
        path.write_text(json.dumps(read_spec(toml).to_dict(), ensure_ascii=False), encoding="utf-8")
    path.write_text(mark + path.read_text(encoding="utf-8"), encoding="utf-8")
    done = run("create", str(path), "--write", str(tmp_path / "out.json"), **ASCII)
    assert (done.returncode, done.stderr) == (0, "")
    [axis] = read_spec(tmp_path / "out.json").state
    assert (axis.name, axis.unit) == ("θ", "°")


def test_no_command_ends_on_a_name_that_the_locale_cannot_print(tmp_path: Path, shared_endpoint: str) -> None:
    path = tmp_path / "tilt.toml"
    path.write_text(TILT.format(name="tilt"), encoding="utf-8")
    connect = ("--connect", shared_endpoint)
    with Client(shared_endpoint, timeout_s=30.0) as client:
        client.wait_until_ready(60.0)
        task = client.create_task(read_spec(path))
        task.report(state=[1], goal=[2], cost=0, success=True, kind="demonstration", worker="Zoë", wait=True)
    told = ""
    for words in (("predict", "tilt", "--state", "1"), ("explain", "tilt", "--state", "1"), ("status", "tilt")):
        done = run(*words, *connect, **ASCII)
        assert (done.returncode, done.stderr) == (0, ""), words
        told += done.stdout
    assert r"\u03bd" in told
    wrong = run("predict", "tilt", "--state", "1 2", *connect, **ASCII)
    assert wrong.returncode == 1
    assert "--state takes 1 number" in wrong.stderr
    report = ("report", "tilt", "--state", "1", "--goal", "2", "--cost", "0.5", "--failure")
    assert run(*report, "--worker", os.fsdecode(b"\xff"), *connect, **ASCII).stderr.startswith("error: worker must be")


def test_no_command_reads_or_writes_in_the_locales_encoding(tmp_path: Path, shared_endpoint: str) -> None:
    path = tmp_path / "lean.toml"
    path.write_text(TILT.format(name="lean"), encoding="utf-8")
    out = str(tmp_path / "out.json")
    for words in (
        ("create", str(path), "--write", out),
        ("create", out, "--connect", shared_endpoint),
        ("export", "lean", str(tmp_path / "a.csv"), "--connect", shared_endpoint),
        ("import", "lean", str(tmp_path / "a.csv"), "--connect", shared_endpoint),
    ):
        done = run(*words, PYTHONWARNDEFAULTENCODING="1", PYTHONWARNINGS="error::EncodingWarning")
        assert (done.returncode, done.stderr) == (0, ""), words


def test_a_specification_is_not_written_over_a_file(tmp_path: Path) -> None:
    path = tmp_path / "tilt.toml"
    path.write_text(TILT.format(name="tilt"), encoding="utf-8")
    out = tmp_path / "out.json"
    out.write_text("mine", encoding="utf-8")
    with pytest.raises(Invalid, match="is there already"):
        write_spec(read_spec(path), out)
    assert out.read_text(encoding="utf-8") == "mine"


def unreadable(folder: Path) -> dict[tuple[str, ...], str]:
    os.mkfifo(folder / "pipe.csv")
    os.mkfifo(folder / "pipe.toml")
    (folder / "folder.csv").mkdir()
    (folder / "folder.toml").mkdir()
    (folder / "file.csv").touch()
    (folder / "gone.csv").symlink_to(folder / "nowhere.csv")
    return {
        ("create", "pipe.toml"): "is not an ordinary file",
        ("create", "folder.toml"): "is a directory",
        ("create", "none.toml"): "does not exist",
        ("import", "lean", "pipe.csv"): "is not an ordinary file",
        ("import", "lean", "folder.csv"): "is a directory",
        ("import", "lean", "none.csv"): "does not exist",
        ("export", "lean", "pipe.csv"): "is not an ordinary file",
        ("export", "lean", "pipe.csv", "--overwrite"): "is not an ordinary file",
        ("export", "lean", "gone.csv"): "exists",
        ("export", "lean", "folder.csv", "--overwrite"): "is a directory",
        ("export", "lean", "nowhere/a.csv"): "there is no folder",
        ("export", "lean", "file.csv/a.csv"): "there is no folder",
        ("export", "lean", "n" * 300 + ".csv"): "File name too long",
    }


def test_what_is_no_file_is_one_line_and_never_a_traceback(tmp_path: Path, shared_endpoint: str) -> None:
    (tmp_path / "lean.toml").write_text(TILT.format(name="lean"), encoding="utf-8")
    connect = ("--connect", shared_endpoint)
    assert run("create", str(tmp_path / "lean.toml"), *connect).returncode == 0
    for (command, *words), complaint in unreadable(tmp_path).items():
        places = [str(tmp_path / word) if "." in word else word for word in words]
        given = [command, *places, *connect]
        done = CliRunner(env={"COLUMNS": "2000"}).invoke(build(given), given)
        assert done.exit_code in (1, 2), (command, words)
        assert isinstance(done.exception, SystemExit), (command, words)
        assert complaint in done.stderr
    assert {path.name for path in tmp_path.iterdir() if path.suffix == ".partial"} == set()


@pytest.mark.parametrize("kind", ["csv", "npz", "parquet"])
def test_a_disk_without_room_is_one_line_and_leaves_no_file(tmp_path: Path, shared_endpoint: str, kind: str) -> None:
    (tmp_path / "full.toml").write_text(TILT.format(name="full"), encoding="utf-8")
    out = tmp_path / f"a.{kind}"
    assert run("create", str(tmp_path / "full.toml"), "--connect", shared_endpoint).returncode == 0
    command = [sys.executable, "-m", "crkr.client", "export", "full", str(out), "--connect", shared_endpoint]
    done = subprocess.run(
        ["sh", "-c", 'ulimit -f 0; exec "$@"', "sh", *command],  # files may grow to no byte at all
        capture_output=True,
        text=True,
        encoding="utf-8",
        check=False,
    )
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr.startswith("error: ")
    told = done.stderr.partition("Exception ignored in: <function ZipFile")[0]  # which NumPy 1.26 leaves open
    assert told.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["full.toml"]
