"""Prometheus scrapes from a real server the numbers that the server gives by Zenoh."""

import re
import signal
import socket
import subprocess
import sys
import urllib.request
from collections.abc import Callable, Mapping
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
import zenoh
from processes import Processes
from prometheus_client.parser import text_string_to_metric_families

Ask = Callable[..., dict[str, Any]]
MakeTrial = Callable[..., dict[str, Any]]
Connect = Callable[[str], Ask]
Scrape = Callable[..., float]
COUNT = 30


@pytest.fixture
def metrics_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
    return port


@pytest.fixture
def endpoint(start_server: Callable[..., Any], metrics_port: int) -> str:
    found: str = start_server("--metrics", str(metrics_port)).endpoint
    return found


def scraped(port: int) -> Mapping[tuple[str, frozenset[tuple[str, str]]], float]:
    """Every sample of one scrape by name and labels."""
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=10) as answer:
        assert answer.headers["Content-Type"].startswith("text/plain; version=")
        families = list(text_string_to_metric_families(answer.read().decode()))
    return {
        (sample.name, frozenset(sample.labels.items())): sample.value
        for family in families
        for sample in family.samples
    }


def value(samples: Mapping[tuple[str, frozenset[tuple[str, str]]], float], name: str, **labels: str) -> float:
    return samples[name, frozenset(labels.items())]


def test_the_numbers_agree_with_what_the_server_answers(
    endpoint: str,
    metrics_port: int,
    connect: Connect,
    make_trial: MakeTrial,
    reach: dict[str, Any],
    plain: Callable[[str], zenoh.Session],
    processes: Processes,
) -> None:
    ask = connect(endpoint)
    ask("rpc/create_task", reach)
    trials = [make_trial(number, success=number % 3 > 0) for number in range(COUNT)]
    ask("task/reach/rpc/report", {"trials": trials, "wait": True})
    late = {"kind": "evaluation", "worker": "ada"}
    ask("task/reach/rpc/report", {"trials": [make_trial(COUNT, **late)], "wait": True})
    for _ in range(7):
        ask("task/reach/rpc/predict", {"states": [0.5, 0.0], "explore": True, "worker": "ada"})
    assert ask("task/reach/rpc/predict", {"states": [0.5]})["error"]["code"] == "INVALID"
    assert ask("task/nobody/rpc/report", {"trials": []})["error"]["code"] == "UNKNOWN_TASK"
    for verb in ("dance", "sing"):
        assert ask(f"task/reach/rpc/{verb}")["error"]["code"] == "UNSUPPORTED"
    ask("task/reach/admin/configure", {"changes": {"budget": 9}})
    session = plain(endpoint)
    token = session.liveliness().declare_token("crkr/@v1/task/reach/live/worker/bob")
    processes.wait_until(
        lambda: {one["state"] for one in ask("task/reach/rpc/status")["workers"]} == {"alive", "unannounced"}
    )
    status = ask("task/reach/rpc/status")
    found = scraped(metrics_port)
    assert token is not None  # held until here

    for kind, count in status["samples"].items():
        assert value(found, "crkr_task_samples", task="reach", kind=kind) == count
    for metric, field in {"eligible_samples": "eligible", "active_samples": "active", "archived": "archived"}.items():
        assert value(found, f"crkr_task_{metric}", task="reach") == status[field]
    assert status["active"] == 9
    assert value(found, "crkr_task_model_version", task="reach") == status["model_version"] == COUNT + 3
    assert value(found, "crkr_task_model_lag", task="reach") == 0
    assert value(found, "crkr_task_faulty", task="reach") == 0
    assert value(found, "crkr_task_success_ratio", task="reach") == status["success"]["rate"]
    drift = status.get("drift", {"score": 0.0, "restarts": 0})
    for name in ("score", "restarts"):
        assert value(found, f"crkr_task_drift_{name}", task="reach") == drift[name]
    advice = {dict(labels)["code"]: value for (name, labels), value in found.items() if name == "crkr_task_advice"}
    assert {"no_success", "drifted"} <= advice.keys()
    limits = {code for code, is_told in advice.items() if is_told}
    assert limits == {advice["code"] for advice in status.get("advice", [])}
    states = [worker["state"] for worker in status["workers"]]
    for state in ("alive", "left", "lost", "unannounced"):
        assert value(found, "crkr_task_workers", task="reach", state=state) == states.count(state)
    opened = sum(worker["open_trials"] for worker in status["workers"])
    assert value(found, "crkr_task_open_trials", task="reach") == opened == 7
    for verb, depth in status["queues"].items():
        if verb != "learning":
            assert value(found, "crkr_queue_limit", verb=verb) == depth["limit"]
            assert value(found, "crkr_queue_waiting", verb=verb) == 0
    assert value(found, "crkr_learning_backlog_trials") == status["queues"]["learning"]["waiting"]

    for verb, times in status["latency_us"].items():
        answered = times["count"] + (verb == "status")  # the answer that told this
        assert value(found, "crkr_requests_total", verb=verb, code="OK") == answered
        assert value(found, "crkr_request_duration_seconds_count", verb=verb) == answered
        assert value(found, "crkr_request_duration_seconds_bucket", verb=verb, le="+Inf") == answered
    predicted = value(found, "crkr_request_duration_seconds_sum", verb="predict")
    assert 0 < predicted / 7 <= 1.1 * status["latency_us"]["predict"]["p99"] * 1e-6
    assert value(found, "crkr_requests_total", verb="predict", code="OK") == 7
    assert value(found, "crkr_requests_total", verb="predict", code="INVALID") == 1
    assert value(found, "crkr_requests_total", verb="report", code="UNKNOWN_TASK") == 1
    assert value(found, "crkr_requests_total", verb="other", code="UNSUPPORTED") == 2

    assert value(found, "crkr_commit_duration_seconds_count") == 4  # create, two reports, configure
    assert 1 <= value(found, "crkr_learning_step_duration_seconds_count") <= 3
    assert value(found, "crkr_log_bytes") > 0
    assert value(found, "crkr_disk_free_bytes") > 0
    version = ask("rpc/info")["version"]
    assert value(found, "crkr_build_info", version=version, protocol="1") == 1
    assert value(found, "process_resident_memory_bytes") > 1e7
    assert value(found, "process_cpu_seconds_total") > 0


def test_the_endpoint_ends_with_the_server_and_only_loopback_is_listened_on(
    start_server: Callable[..., Any], metrics_port: int, processes: Processes
) -> None:
    server = start_server("--metrics", str(metrics_port))
    held = socket.create_connection(("127.0.0.1", metrics_port))  # a scraper that never asks delays nothing
    with closing(held):
        said = f"metrics at http://127.0.0.1:{metrics_port}/metrics"
        processes.wait_until(lambda: said in server.log.read_text(), server.log)  # a thread of its own writes it
        assert f"0100007F:{metrics_port:04X} 00000000:0000 0A" in Path("/proc/net/tcp").read_text()
        server.process.send_signal(signal.SIGTERM)
        assert server.process.wait(timeout=60) == 0
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.1", metrics_port))
    assert "Traceback" not in server.log.read_text()


def test_a_file_that_vanishes_while_they_are_counted_costs_no_scrape(
    start_server: Callable[..., Any], metrics_port: int, processes: Processes
) -> None:
    server = start_server("--metrics", str(metrics_port))
    processes.wait_until(lambda: "listening on" in server.log.read_text(), server.log)
    (server.data / "backup.sqlite3.partial").symlink_to(server.data / "gone")
    assert value(scraped(metrics_port), "crkr_log_bytes") > 0
    server.data.rename(server.data.with_name("away"))
    found = scraped(metrics_port)
    assert (value(found, "crkr_log_bytes"), value(found, "crkr_disk_free_bytes")) == (0, 0)
    assert "Traceback" not in server.log.read_text()


def test_the_operators_page_lists_every_metric_and_no_other(
    start_server: Callable[..., Any], metrics_port: int, connect: Connect, reach: dict[str, Any]
) -> None:
    ask = connect(start_server("--metrics", f"127.0.0.1:{metrics_port}").endpoint)
    ask("rpc/create_task", reach)
    ask("rpc/create_task", reach)  # what the first took is noted just after its answer
    names = {re.sub(r"_(bucket|count|sum)$", "", name) for name, _ in scraped(metrics_port)}
    page = (Path(__file__).parents[3] / "docs" / "operating.md").read_text()
    assert set(re.findall(r"`(crkr_[a-z_]+)", page)) == {name for name in names if name.startswith("crkr_")}


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "crkr.client", "server", *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=20, check=False)


def test_a_port_that_is_taken_is_told_in_one_line_before_anything_else(free_port: int, tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        address = f"127.0.0.1:{taken.getsockname()[1]}"
        done = run("--listen", f"tcp/127.0.0.1:{free_port}", "--data", str(tmp_path / "data"), "--metrics", address)
    assert done.returncode == 1
    reason = "the port is in use; stop what listens there or choose another"
    assert done.stderr == f"error: cannot serve metrics on {address}: {reason}\n"
    assert not (tmp_path / "data").exists()


def test_an_address_of_another_machine_is_refused_in_one_line(free_port: int, tmp_path: Path) -> None:
    listen = ["--listen", f"tcp/127.0.0.1:{free_port}", "--data", str(tmp_path / "data")]
    done = run(*listen, "--metrics", "192.0.2.1:9464")  # reserved for documentation
    assert done.returncode == 1
    assert done.stderr == "error: cannot serve metrics on 192.0.2.1:9464: Cannot assign requested address\n"


@pytest.mark.parametrize("address", ["here", "127.0.0.1:", "127.0.0.1:70000", ":-1"])
def test_what_is_no_address_is_wrong_usage(address: str, tmp_path: Path) -> None:
    done = run("--data", str(tmp_path / "data"), "--metrics", address)
    assert done.returncode == 2
    assert "an address is HOST:PORT" in done.stderr
