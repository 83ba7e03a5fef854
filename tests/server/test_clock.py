"""A clock that jumps must not make anybody wait: deadlines and pauses are measured on the monotonic clock."""

import re
from pathlib import Path

REPOSITORY = Path(__file__).parents[2]
WALL_CLOCK = re.compile(r"time\.time\(|datetime\.(now|utcnow|today)\(|time_ns\(|localtime|gmtime")
# Where the time of day is told to people, and compared with nothing.
TELLING = {
    "server/crkr/server/log/sqlite_log.py",
    "server/crkr/server/workers.py",
    "server/crkr/server/reading.py",
    "client/crkr/client/commands/status.py",
}


def test_the_time_of_day_is_only_ever_told() -> None:
    sources = [
        path for root in ("server", "client", "protocol", "learner") for path in (REPOSITORY / root).rglob("*.py")
    ]
    asking = {path.relative_to(REPOSITORY).as_posix() for path in sources if WALL_CLOCK.search(path.read_text())}
    assert asking == TELLING
    for name in TELLING:
        for line in (REPOSITORY / name).read_text().splitlines():
            if WALL_CLOCK.search(line):
                assert not re.search(r"deadline|timeout|wait\(|[<>]", line), line
