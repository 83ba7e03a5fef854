"""A clock that jumps must not make anybody wait: deadlines and pauses are measured on the monotonic clock."""

import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from uuid import UUID

import pytest
from postgres import Postgres, running_postgres
from processes import Processes

from crkr.client import Client

REPOSITORY = Path(__file__).parents[3]
WALL_CLOCK = re.compile(r"time\.time\(|datetime\.(now|utcnow|today)\(|time_ns\(|localtime|gmtime")
# Where the time of day is told to people, and compared with nothing.
TELLING = {
    "server/crkr/server/log/new_rows.py",
    "server/crkr/server/workers.py",
    "server/crkr/server/verbs/read.py",
    "client/crkr/client/commands/status.py",
    "client/crkr/client/commands/doctor.py",  # a certificate's last day is a day
}
DAY, DECADE = 86_400, 315_360_000
BEAT = "SELECT min(beat) FROM crkr.server"
JUMPS = (DAY, -DAY, DECADE, -DECADE, 0)


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


# Between a program and the C library: shifts the time of day by the seconds that a file holds, at any moment.
LIBRARY = r"""
#define _GNU_SOURCE
#include <dlfcn.h>
#include <fcntl.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <sys/time.h>
#include <time.h>
static volatile long long *offset;
__attribute__((constructor)) static void start(void) {
    int file = open(getenv("CLOCK_OFFSET"), O_RDONLY);
    void *place = mmap(0, 8, PROT_READ, MAP_SHARED, file, 0);
    if (place != MAP_FAILED) offset = place;
}
int clock_gettime(clockid_t id, struct timespec *now) {
    static int (*next)(clockid_t, struct timespec *);
    if (!next) next = dlsym(RTLD_NEXT, "clock_gettime");
    int status = next(id, now);
    if (!status && offset && (id == CLOCK_REALTIME || id == CLOCK_REALTIME_COARSE)) now->tv_sec += *offset;
    return status;
}
int gettimeofday(struct timeval *restrict now, void *restrict zone) {
    struct timespec found;
    (void)zone;
    clock_gettime(CLOCK_REALTIME, &found);
    now->tv_sec = found.tv_sec;
    now->tv_usec = found.tv_nsec / 1000;
    return 0;
}
time_t time(time_t *where) {
    struct timespec found;
    clock_gettime(CLOCK_REALTIME, &found);
    if (where) *where = found.tv_sec;
    return found.tv_sec;
}
"""
# The same for Python's own view of it, where there is no compiler.
PATCH = """
import struct, sys, time
_real, _file = time.time, open(sys.argv.pop(1), "rb", buffering=0)
def _shifted():
    _file.seek(0)
    return _real() + struct.unpack("<q", _file.read(8))[0]
time.time = _shifted
"""
SERVER = "from crkr.client.cli.main import main; main()"
REPORTER = """
import sys, time
from uuid import UUID
from crkr.client import Client
with Client(sys.argv[1], timeout_s=30) as client:
    task = client.task("reach")
    with task.announce("shifted"):
        for number in range(1, 10**6):
            task.report(state=[0.5, 0.5], goal=[0.0] * 3, cost=0.5, success=True, id=UUID(int=number), worker="shifted")
            print(number, time.time(), flush=True)
            if not sys.stdin.readline():
                break
"""


@dataclass(frozen=True, slots=True)
class Clock:
    """What a child takes for the time of day."""

    file: Path
    library: Path | None

    def jump(self, seconds: int) -> None:
        with self.file.open("r+b", buffering=0) as file:
            file.write(seconds.to_bytes(8, "little", signed=True))

    @property
    def environment(self) -> dict[str, str]:
        """What a program must find there to be told this time; empty without a library."""
        return {} if self.library is None else {"LD_PRELOAD": str(self.library), "CLOCK_OFFSET": str(self.file)}

    def child(self, script: str, *arguments: str, **pipes: Any) -> "subprocess.Popen[str]":
        if self.library is None:
            command = [sys.executable, "-c", PATCH + script, str(self.file), *arguments]
            return subprocess.Popen(command, text=True, **pipes)
        command = [sys.executable, "-c", script, *arguments]
        return subprocess.Popen(command, text=True, env={**os.environ, **self.environment}, **pipes)


@pytest.fixture(params=["python", pytest.param("everything", marks=pytest.mark.campaign)])
def make_clock(request: pytest.FixtureRequest) -> Iterator[Callable[[str], Clock]]:
    """Clocks by name; the time of day of all that runs in a process takes a C compiler."""
    folder = Path(tempfile.mkdtemp(prefix="crkr-clock-"))
    folder.chmod(0o755)  # PostgreSQL runs as another user
    library: Path | None = None
    if request.param == "everything":
        library = folder / "clock.so"
        subprocess.run(
            ["cc", "-shared", "-fPIC", "-o", str(library), "-x", "c", "-", "-ldl"], input=LIBRARY, text=True, check=True
        )

    def make(name: str) -> Clock:
        (folder / name).write_bytes(bytes(8))
        return Clock(folder / name, library)

    yield make
    shutil.rmtree(folder)


def test_jumps_of_the_clock_hold_up_neither_server_nor_worker(
    make_clock: Callable[[str], Clock], free_port: int, reach: dict[str, Any], tmp_path: Path
) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port}"
    ours, theirs = make_clock("server clock"), make_clock("worker clock")
    with ExitStack() as stack:
        server = stack.enter_context(
            ours.child(SERVER, "server", "--listen", endpoint, "--data", str(tmp_path / "data"), stderr=subprocess.PIPE)
        )
        stack.callback(server.kill)
        assert server.stderr is not None
        assert "listening on" in server.stderr.readline()
        client = stack.enter_context(Client(endpoint, timeout_s=30))
        task = client.create_task(reach)
        worker = stack.enter_context(
            theirs.child(REPORTER, endpoint, stdin=subprocess.PIPE, stdout=subprocess.PIPE, bufsize=1)
        )
        stack.callback(worker.kill)
        assert worker.stdout is not None
        assert worker.stdin is not None
        count = 0
        for jump in JUMPS:
            for clock, offset in ((ours, jump), (theirs, -jump)):
                clock.jump(offset)
            for _ in range(10):
                count += 1
                number, told = worker.stdout.readline().split()
                assert int(number) == count
                worker.stdin.write("\n")
            assert abs(float(told) - (time.time() - jump)) < 60.0  # it did jump
            own = task.report(
                state=[0.1, 0.1], goal=[0.0] * 3, cost=0.5, success=True, id=UUID(int=10**9 + count), wait=True
            )
            assert task.predict([0.5, 0.5]).active > 0
            status = task.status()
            assert 0 <= status["uptime"] < 120.0
            [entry] = status["workers"]
            assert (entry["id"], entry["state"]) == ("shifted", "alive")
            assert 0 <= entry["last_seen_s"] < 60.0
            [stored] = [sample for sample in task.iter_samples() if sample.seq == own.seqs[0]]
            assert abs(stored.time - (time.time() + jump)) < 60.0
        worker.stdin.close()
        assert worker.wait(timeout=30) == 0
        server.terminate()
        assert server.wait(timeout=10) == 0
        server.stderr.close()


def test_jumps_of_a_servers_clock_make_no_other_take_its_tasks(
    make_clock: Callable[[str], Clock],
    make_database: Callable[[], str],
    postgres: Postgres,
    processes: Processes,
    unused_ports: list[int],
    reach: dict[str, Any],
) -> None:
    url, clock = make_database(), make_clock("server clock")
    first, second = (f"tcp/127.0.0.1:{port}" for port in unused_ports)
    other = [sys.executable, "-m", "crkr.client", "server", "--listen", second, "--data", url]
    with ExitStack() as stack:
        server = stack.enter_context(clock.child(SERVER, "server", "--listen", first, "--data", url))
        stack.callback(server.kill)
        task = stack.enter_context(Client(first, timeout_s=30)).create_task(reach)
        standby = stack.enter_context(subprocess.Popen(other, stderr=subprocess.PIPE, text=True))
        stack.callback(standby.kill)
        assert standby.stderr is not None
        assert "standing by" in standby.stderr.readline()
        for number, jump in enumerate(JUMPS):
            clock.jump(jump)
            for _ in range(3):
                task.report(state=[0.1, 0.1], goal=[0.0] * 3, cost=0.5, success=True, wait=True)
            name = url.rpartition("/")[2]
            [(beat,)] = postgres.execute(name, BEAT)
            processes.wait_until(lambda name=name, beat=beat: postgres.execute(name, BEAT)[0][0] >= beat + 2)
            assert postgres.execute(url.rpartition("/")[2], "SELECT epoch, last FROM crkr.task") == [
                (1, 4 + 3 * number)
            ]
        server.terminate()
        assert server.wait(timeout=10) == 0


@pytest.mark.campaign
@pytest.mark.parametrize("make_clock", ["everything"], indirect=True)
def test_jumps_of_the_databases_clock_change_no_owner(
    make_clock: Callable[[str], Clock], unused_ports: list[int], reach: dict[str, Any]
) -> None:
    clock = make_clock("database clock")
    with running_postgres(clock.environment) as cluster, ExitStack() as stack:
        url, asked = cluster.create("jumps"), "SELECT extract(epoch FROM clock_timestamp())::float"
        first, second = (f"tcp/127.0.0.1:{port}" for port in unused_ports)
        for endpoint, says in ((first, "listening on"), (second, "standing by")):
            command = [sys.executable, "-m", "crkr.client", "server", "--listen", endpoint, "--data", url]
            server = stack.enter_context(subprocess.Popen(command, stderr=subprocess.PIPE, text=True))
            stack.callback(server.kill)
            assert server.stderr is not None
            while says not in server.stderr.readline():
                assert server.poll() is None
        task = stack.enter_context(Client(first, timeout_s=30)).create_task(reach)
        for number, jump in enumerate(JUMPS):
            clock.jump(jump)
            assert abs(cluster.execute("jumps", asked)[0][0] - (time.time() + jump)) < 60.0
            for _ in range(3):
                task.report(state=[0.1, 0.1], goal=[0.0] * 3, cost=0.5, success=True, wait=True)
            [(beat,)] = beats = cluster.execute("jumps", BEAT)
            while beats[0][0] < beat + 2:
                beats = cluster.execute("jumps", BEAT)
            assert cluster.execute("jumps", "SELECT epoch, last FROM crkr.task") == [(1, 4 + 3 * number)]


def test_no_statement_asks_for_the_time_of_the_database() -> None:
    folder = REPOSITORY / "server/crkr/server/log/postgres"
    asking = re.compile(r"\bnow\(|_timestamp\b|localtime|interval '", re.IGNORECASE)
    assert [path.name for path in folder.glob("*.py") if asking.search(path.read_text())] == []
