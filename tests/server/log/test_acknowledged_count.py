"""The number of acknowledged log positions, in its file."""

from pathlib import Path

from crkr.server.log.acknowledged_count import Tally, read_tally


def test_a_number_that_comes_after_the_end_spoils_no_other_file(tmp_path: Path) -> None:
    tally = Tally(tmp_path, 3)
    tally.close()
    other = tmp_path / "other"
    with other.open("w+b", buffering=0) as file:  # gets the descriptor that has become free
        file.write(b"precious")
        tally.note(4)
    assert other.read_bytes() == b"precious"
    assert read_tally(tmp_path) == 3
