"""Files that a command is told to write."""

import os
import resource
from pathlib import Path

import pytest

from crkr.client.cli.output_file import beside, check_output, output_file
from crkr.protocol import Invalid


def test_a_file_that_is_there_is_replaced_only_where_that_was_asked_for(tmp_path: Path) -> None:
    file = tmp_path / "night.rrd"
    check_output(file, overwrite=False)
    file.write_text("of last night")
    with pytest.raises(Invalid, match=r"night\.rrd exists; choose another file, or --overwrite"):
        check_output(file, overwrite=False)
    check_output(file, overwrite=True)
    assert file.read_text() == "of last night"


def test_a_link_to_nowhere_counts_as_a_file(tmp_path: Path) -> None:
    link = tmp_path / "link.png"
    link.symlink_to(tmp_path / "gone.png")
    with pytest.raises(Invalid, match="exists"):
        check_output(link, overwrite=False)


@pytest.mark.parametrize("overwrite", [False, True])
def test_what_is_no_ordinary_file_is_never_replaced(tmp_path: Path, overwrite: bool) -> None:
    pipe = tmp_path / "pipe.png"
    os.mkfifo(pipe)
    for path in (tmp_path, pipe, Path(os.devnull)):
        with pytest.raises(Invalid, match="not an ordinary file"):
            check_output(path, overwrite=overwrite)


def test_a_folder_that_is_not_there_is_said_before_the_work(tmp_path: Path) -> None:
    with pytest.raises(Invalid, match="there is no folder"):
        check_output(tmp_path / "missing" / "a.png", overwrite=True)


def test_a_whole_file_takes_the_place_of_the_one_before(tmp_path: Path) -> None:
    file, link = tmp_path / "a.png", tmp_path / "link.png"
    file.write_text("before")
    link.symlink_to(file)
    with output_file(link) as partial:
        partial.write_text("after")
        assert (file.read_text(), partial.suffix) == ("before", ".png")
    assert (file.read_text(), link.is_symlink()) == ("after", True)
    assert sorted(tmp_path.iterdir()) == [file, link]


@pytest.mark.parametrize("there", [False, True])
def test_a_failed_run_leaves_the_folder_as_it_was(tmp_path: Path, there: bool) -> None:
    file = tmp_path / "a.png"
    if there:
        file.write_text("before")

    def run() -> None:
        with output_file(file) as partial:
            partial.write_text("half of")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        run()
    assert [path.read_text() for path in tmp_path.iterdir()] == (["before"] if there else [])


def test_two_runs_at_once_write_to_files_of_their_own(tmp_path: Path) -> None:
    assert beside(tmp_path / "a.png") != beside(tmp_path / "a.png")


def test_a_full_disk_is_told_with_the_files_name(tmp_path: Path) -> None:
    path, limit = tmp_path / "run.csv", resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (1000, limit[1]))
        with pytest.raises(OSError, match=r"run\.csv") as caught, output_file(path) as partial:
            partial.write_bytes(bytes(4000))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limit)
    assert caught.value.filename == str(path)
    assert list(tmp_path.iterdir()) == []
