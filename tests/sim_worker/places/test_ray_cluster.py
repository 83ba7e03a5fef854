"""`crkr workers --on ray` on real clusters, whose nodes are network namespaces of this machine."""

import json
import os
import shutil
import signal
import subprocess
import sys
import sysconfig
import tempfile
import venv
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any, final

import pytest
from network_namespaces import inside, ip, two_machines
from processes import Processes

from crkr.sim_worker.places.ray_cluster import part_plans
from crkr.sim_worker.skill import SkillOptions
from crkr.sim_worker.supervisor.plan import RunPlan

REACH = Path(__file__).parents[3] / "examples" / "reach.py"
HEAD, OTHER = "10.77.0.1", "10.77.0.2"
PATIENCE_S = 90.0
COUNT = """
import json, sys
from collections import Counter
from crkr.client import Client
with Client(sys.argv[1], timeout_s=10) as client:
    samples = [stored.trial for stored in client.task("reach").iter_samples()]
kinds = Counter(one.kind for one in samples)
workers = {one.worker for one in samples if not one.worker.endswith("-demo")}
print(json.dumps({"kinds": kinds, "ids": len({one.id for one in samples}), "workers": sorted(workers)}))
"""


def environment(folder: Path) -> dict[str, str]:
    """For Ray's processes: nothing is sent home, and each machine's files are its own."""
    return {
        **os.environ,
        "RAY_USAGE_STATS_ENABLED": "0",
        "RAY_AUTH_MODE": "disabled",  # else Ray would ask for a token in the home directory
        "RAY_ADDRESS": f"{HEAD}:6379",
        "RAY_TMPDIR": str(folder),
        "OPENBLAS_NUM_THREADS": "1",
        "PYTHONUNBUFFERED": "1",
    }


@final
class Cluster:
    """A crkr server and Ray nodes on two machines; `crkr workers` starts on the first."""

    def __init__(self, folder: Path, machines: tuple[str, str], stack: ExitStack, processes: Processes) -> None:
        self.folder, self.machines, self._stack, self._processes = folder, machines, stack, processes
        self.endpoint = f"tcp/{HEAD}:7447"
        # Ray's sockets have paths of their own below this folder, and a socket's path is at most 107 characters.
        self._short = Path(tempfile.mkdtemp(prefix="crkr-ray-"))
        stack.callback(shutil.rmtree, self._short, ignore_errors=True)

    def start(self, machine: int, name: str, *command: str, **options: Any) -> tuple[subprocess.Popen[str], Path]:
        log = self.folder / f"{name}.log"
        sink = self._stack.enter_context(log.open("w"))
        words = inside(self.machines[machine], *command)
        place = self._short / str(machine)
        place.mkdir(parents=True, exist_ok=True)
        process = self._stack.enter_context(
            subprocess.Popen(words, stderr=sink, stdout=sink, env=environment(place), text=True, **options)
        )
        self._stack.callback(process.kill)
        return process, log

    def wait_for(self, log: Path, text: str) -> None:
        self._processes.wait_until(lambda: text in log.read_text(), log)

    def serve(self) -> None:
        data = str(self.folder / "data")
        _, log = self.start(
            0, "server", sys.executable, "-m", "crkr.client", "server", "--listen", self.endpoint, "--data", data
        )
        self.wait_for(log, "listening on")

    def node(self, machine: int, name: str, python: str = sys.executable) -> subprocess.Popen[str]:
        address = (HEAD, OTHER)[machine]
        role = (
            ["--head", "--port", "6379", "--include-dashboard", "false"]
            if machine == 0
            else ["--address", f"{HEAD}:6379"]
        )
        process, log = self.start(
            machine, name, python, "-m", "ray.scripts.scripts", "start", *role,
            "--node-ip-address", address, "--num-cpus", "1", "--block",
            "--disable-usage-stats", "--object-store-memory", "80000000",
            start_new_session=True,
        )  # fmt: skip
        self._stack.callback(self._end_all, process)
        self.wait_for(log, "Ray runtime started")
        return process

    def _end_all(self, process: subprocess.Popen[str]) -> None:
        members = self._processes.descendants(process.pid)
        for pid in [process.pid, *members]:
            kill(pid)

    def train(self, name: str, *words: str) -> tuple[subprocess.Popen[str], Path]:
        own = self.folder / "own"
        own.mkdir(exist_ok=True)
        shutil.copy(REACH, own / "reach.py")
        options = ["-n", "2", "--on", "ray", "--cpus-per-place", "1", "--evaluations", "0", "--seed", "1", "--json"]
        command = [
            sys.executable,
            "-m",
            "crkr.client",
            "workers",
            str(own / "reach.py:make"),
            *options,
            "--connect",
            self.endpoint,
        ]
        return self.start(0, name, *command, *words)

    def stored(self) -> dict[str, Any]:
        words = inside(self.machines[0], sys.executable, "-c", COUNT, self.endpoint)
        done = subprocess.run(words, capture_output=True, text=True, timeout=PATIENCE_S, check=True)
        result: dict[str, Any] = json.loads(done.stdout)
        return result

    def training(self) -> int:
        try:
            kinds = self.stored()["kinds"]
        except subprocess.CalledProcessError:  # no task yet
            return 0
        return int(kinds.get("trial", 0) + kinds.get("failed", 0))


def kill(pid: int) -> None:
    with suppress(ProcessLookupError):
        os.kill(pid, signal.SIGKILL)


def simulations(node: int, processes: Processes) -> list[int]:
    """Processes on a node that run trials."""
    return [pid for pid in processes.descendants(node) if "spawn_main" in processes.command_line(pid)]


def result_of(log: Path) -> dict[str, Any]:
    lines = [line for line in log.read_text().splitlines() if line.startswith("{")]
    result: dict[str, Any] = json.loads(lines[-1])
    return result


@pytest.fixture
def cluster(tmp_path: Path, processes: Processes) -> Iterator[Cluster]:
    with two_machines() as machines, ExitStack() as stack:
        made = Cluster(tmp_path, machines, stack, processes)
        made.serve()
        made.node(0, "head")
        yield made


def plan(workers: int) -> RunPlan:
    return RunPlan("s", SkillOptions(), "tcp/h:1", None, workers, 10, 5, 0, 3, 5.0, 60.0, 300.0, False, "warning")


@pytest.mark.parametrize(("workers", "per_place", "expected"), [(5, 2, [2, 2, 1]), (2, 8, [2]), (4, 2, [2, 2])])
def test_places_share_all_workers_and_no_seed(workers: int, per_place: int, expected: Sequence[int]) -> None:
    parts = part_plans(plan(workers), per_place)
    assert [one.workers for one in parts] == expected
    assert len({one.seed for one in parts}) == len(parts)
    assert parts == part_plans(plan(workers), per_place)


def test_a_run_on_two_nodes_meets_its_total_and_ctrl_c_ends_the_next(cluster: Cluster, processes: Processes) -> None:
    cluster.node(1, "other")
    first, log = cluster.train("first", "--trials", "120")
    assert first.wait(timeout=PATIENCE_S) == 0, log.read_text()
    report = result_of(log)
    stored = cluster.stored()
    assert report["trials"] == stored["kinds"]["trial"] + stored["kinds"].get("failed", 0)
    assert 120 <= report["trials"] <= 124  # each of two supervisors may have two under way when the total is met
    assert stored["ids"] == sum(stored["kinds"].values())
    assert len(stored["workers"]) == 2
    second, log = cluster.train("second")
    processes.wait_until(lambda: cluster.training() > 160, log)
    os.kill(second.pid, signal.SIGINT)
    assert second.wait(timeout=PATIENCE_S) == 130, log.read_text()
    report = result_of(log)
    assert report["stopped_by"] == "SIGINT"
    assert 160 < report["trained"] <= cluster.training()  # a place may end after its last report


def test_without_a_cluster_a_command_says_how_to_get_one(tmp_path: Path) -> None:
    words = [sys.executable, "-m", "crkr.client", "workers", "table-tennis", "--on", "ray"]
    env = {**environment(tmp_path), "RAY_ADDRESS": "127.0.0.1:1"}
    done = subprocess.run(words, capture_output=True, text=True, timeout=PATIENCE_S, env=env, check=False)
    assert done.returncode == 1
    assert "start one with `ray start --head`" in done.stderr.splitlines()[-1]


def test_unknown_places_are_listed() -> None:
    words = [sys.executable, "-m", "crkr.client", "workers", "table-tennis", "--on", "slurm"]
    done = subprocess.run(words, capture_output=True, text=True, timeout=PATIENCE_S, check=False)
    assert done.returncode == 1
    assert "no places 'slurm' to run on; there are: here, ray" in done.stderr


@pytest.mark.campaign
@pytest.mark.timeout(400)
def test_workers_of_a_killed_node_start_again_when_it_comes_back(cluster: Cluster, processes: Processes) -> None:
    node = cluster.node(1, "other")
    train, log = cluster.train("train", "--trials", "3000")
    processes.wait_until(lambda: cluster.training() > 50, log)
    for pid in [node.pid, *processes.descendants(node.pid)]:
        kill(pid)
    node.wait(timeout=PATIENCE_S)
    before = cluster.training()
    processes.wait_until(lambda: cluster.training() > before + 50, log)
    cluster.node(1, "again")
    assert train.wait(timeout=300) == 0, log.read_text()
    assert 3000 <= cluster.training() <= 3004
    stored = cluster.stored()
    assert stored["ids"] == sum(stored["kinds"].values())


@pytest.mark.campaign
@pytest.mark.timeout(300)
def test_ctrl_c_ends_a_run_whose_node_cannot_be_reached(cluster: Cluster, processes: Processes) -> None:
    node = cluster.node(1, "other")
    train, log = cluster.train("train")
    processes.wait_until(lambda: simulations(node.pid, processes) and cluster.training() > 50, log)
    ip("-n", cluster.machines[0], "link", "set", "cable", "down")
    os.kill(train.pid, signal.SIGINT)
    assert train.wait(timeout=PATIENCE_S) == 130, log.read_text()
    assert "1 places did not end within 10 s" in log.read_text()


@pytest.mark.campaign
@pytest.mark.timeout(300)
def test_nothing_outlives_a_killed_driver(cluster: Cluster, processes: Processes) -> None:
    node = cluster.node(1, "other")
    train, log = cluster.train("train")
    processes.wait_until(lambda: cluster.training() > 50, log)
    kill(train.pid)
    processes.wait_until(lambda: not simulations(node.pid, processes), log)
    before = cluster.training()
    assert cluster.training() == before


@pytest.mark.campaign
@pytest.mark.timeout(300)
def test_a_node_without_the_package_is_one_clear_line(cluster: Cluster, tmp_path: Path) -> None:
    venv.create(tmp_path / "bare", symlinks=True)
    bare = tmp_path / "bare" / "bin" / "python"
    ours = sysconfig.get_path("purelib")  # holds Ray itself, and crkr by a .pth file, which is not followed from there
    target = subprocess.run(
        [bare, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))"],
        capture_output=True,
        text=True,
        check=True,
    )
    (Path(target.stdout.strip()) / "ray.pth").write_text(f"{ours}\n")
    cluster.node(1, "other", str(bare))
    train, log = cluster.train("train", "--trials", "60")
    assert train.wait(timeout=PATIENCE_S) == 1
    assert "error: a node of the cluster lacks the module crkr; install crkr[sim]==" in log.read_text()
    assert "Traceback" not in log.read_text()
    assert 60 <= cluster.training() <= 64


@pytest.mark.campaign
@pytest.mark.timeout(300)
def test_a_study_on_a_cluster_has_the_figures_of_one_machine(cluster: Cluster, tmp_path: Path) -> None:
    study = ["experiment", "learning", "--environment", "analytic", "--trials", "20", "--balls", "20", "--seeds", "2"]
    results = []
    for place in ("here", "ray"):
        command = [sys.executable, "-m", "crkr.client", *study, "--json", "--on", place, "--out", str(tmp_path / place)]
        process, log = cluster.start(0, place, *command)
        assert process.wait(timeout=PATIENCE_S) == 0, log.read_text()
        results.append(json.loads((tmp_path / place / "learning.json").read_text()))
    assert results[0] == results[1]
