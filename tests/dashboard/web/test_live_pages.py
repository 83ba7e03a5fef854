"""The live pages of a real server: in a real browser, for two hundred readers at once, and for those that misbehave."""

import asyncio
import json
import os
import signal
import socket
import subprocess
import sys
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from uuid import uuid4

import pytest
from browser import Browser
from processes import Processes, RunningServer, shared_server

from crkr.client import Client, Task
from crkr.protocol import TaskSpec

PATIENCE_S = 60.0  # no promise, just no hang
EVIL = "<img src=x onerror=owned=1>"
READERS = 200
SLOW = 60

Start = Callable[..., Any]


def unused_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
    return port


@pytest.fixture(scope="module")
def web() -> int:
    return unused_port()


@pytest.fixture(scope="module")
def server(web: int, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    with shared_server(tmp_path_factory.mktemp("server"), "--web", str(web)) as endpoint:
        with Client(endpoint) as client:
            client.wait_until_ready(PATIENCE_S)
        yield SimpleNamespace(endpoint=endpoint)


@pytest.fixture
def crane(server: RunningServer, spec: TaskSpec) -> Iterator[Task]:
    """A task of its own for each test that has trials in it."""
    with Client(server.endpoint) as client:
        yield client.create_task(replace(spec, name=f"crane-{uuid4()}"))


def report(task: Task, count: int, **fields: Any) -> None:
    task.report(state=[[5.0]] * count, goal=[[0.1]] * count, cost=0.5, success=True, worker="crane-1", **fields)


def get(port: int, path: str, method: str = "GET", **headers: str) -> tuple[int, dict[str, str], str]:
    """Status, headers and text of an answer, whatever it is."""
    request = urllib.request.Request(f"http://127.0.0.1:{port}{path}", method=method, headers=headers)
    try:
        with urllib.request.urlopen(request, timeout=PATIENCE_S) as answer:
            return answer.status, dict(answer.headers), answer.read().decode()
    except urllib.error.HTTPError as error:
        return error.code, dict(error.headers), error.read().decode()


def parts(port: int, task: str) -> str:
    return get(port, f"/task/{task}/parts")[2]


def seen_trials(port: int, task: str) -> bool:
    return "training trials" in parts(port, task)


def test_a_page_renews_itself_in_a_browser(crane: Task, web: int, tmp_path: Path) -> None:
    report(crane, 60, info={"reason": EVIL})
    with Browser(tmp_path / "profile") as browser:
        browser.size(1280, 900)
        browser.open(f"http://127.0.0.1:{web}/")
        browser.run(f"[...document.querySelectorAll('.tasks a')].find((one) => one.text === '{crane.name}').click()")
        shown = "document.querySelector('#tiles') && document.querySelector('#tiles').innerText"
        browser.until(f"({shown} || '').includes('60')")
        browser.run("document.querySelector('summary').click()")
        report(crane, 40, info={"reason": "heavy"})
        browser.until(f"({shown} || '').includes('100')")
        assert EVIL in browser.run("document.querySelector('#reasons').innerText")
        assert browser.run("document.querySelector('details').open"), "what a reader opened stays open"
        assert browser.run("typeof owned") == "undefined"
        assert browser.complaints == []


def test_what_workers_publish_becomes_the_film(
    server: RunningServer, spec: TaskSpec, web: int, publish: Any, message: Any, processes: Processes
) -> None:
    with Client(server.endpoint) as client:
        report(client.create_task(spec), 2)
    processes.wait_until(lambda: seen_trials(web, "crane"))  # it follows now

    def film() -> Any:
        publish("trial", message(2))  # what nobody hears yet is dropped
        return next((text for name, text in json.loads(parts(web, "crane"))["parts"] if name == "film"), None)

    assert "film-data" in processes.wait_until(film)


def test_the_site_can_only_be_read(crane: Task, web: int) -> None:
    for method in ("POST", "PUT", "DELETE"):
        assert get(web, f"/task/{crane.name}/parts", method)[0] == 405
    status, headers, _ = get(web, f"/task/{crane.name}")
    assert status == 200
    content = headers["content-security-policy"]
    assert "default-src 'none'" in content
    assert "unsafe" not in content
    assert headers["x-content-type-options"] == "nosniff"


def test_what_is_not_there_is_a_plain_404(server: RunningServer, web: int) -> None:
    for path in ("/task/none", "/task/%3Cscript%3E", "/task/..%2F..%2Fetc%2Fpasswd", "/nowhere", "/task/a%20b"):
        status, headers, text = get(web, path)
        assert (path, status, headers["content-type"].split(";")[0]) == (path, 404, "text/plain")
        assert "<" not in text


def test_a_page_elsewhere_cannot_borrow_the_name_of_this_host(server: RunningServer, web: int) -> None:
    assert get(web, "/", Host="attacker.example")[0] == 421
    assert get(web, "/", Host=f"localhost:{web}")[0] == 200


async def _read(port: int, task: str, times: int) -> list[int]:
    """Status of answers to one reader, which asks as the page's script does."""
    statuses = []
    for _ in range(times):
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        head = f"GET /task/{task}/parts HTTP/1.1\r\nHost: localhost\r\nAccept-Encoding: gzip\r\nConnection: close"
        writer.write(f"{head}\r\n\r\n".encode())
        answer = await asyncio.wait_for(reader.read(), PATIENCE_S)
        statuses.append(int(answer.split()[1]))
        writer.close()
    return statuses


async def _crowd(port: int, task: str) -> list[int]:
    slow = []
    for number in range(SLOW):
        _, writer = await asyncio.open_connection("127.0.0.1", port)
        if number % 3:  # one third says nothing at all, one does not end its question, one does not read the answer
            head = f"GET /task/{task}/parts HTTP/1.1\r\nHost: localhost\r\n"
            writer.write(head.encode() + b"\r\n" * (number % 2))
        slow.append(writer)
    answers = await asyncio.gather(*(_read(port, task, 3) for _ in range(READERS)))
    for writer in slow:
        writer.transport.abort()
    return [status for statuses in answers for status in statuses]


def test_two_hundred_readers_are_answered_beside_silent_and_slow_ones(
    crane: Task, web: int, processes: Processes
) -> None:
    report(crane, 60)
    processes.wait_until(lambda: seen_trials(web, crane.name))
    assert asyncio.run(_crowd(web, crane.name)) == [200] * READERS * 3
    assert crane.predict([5.0]).goal.shape == (1,)


def test_the_process_of_the_pages_is_started_again_and_ends_with_a_killed_server(
    start_server: Start, processes: Processes, free_port: int
) -> None:
    server = start_server("--web", str(free_port))

    def pages() -> list[int]:
        return [pid for pid in _children(server.process.pid) if "--socket-fd" in processes.command_line(pid)]

    (first,) = processes.wait_until(pages)
    os.kill(first, signal.SIGKILL)
    (second,) = processes.wait_until(lambda: [pid for pid in pages() if pid != first])
    assert get(free_port, "/")[0] == 200
    os.kill(server.process.pid, signal.SIGKILL)
    processes.wait_until(lambda: not processes.running([second]))


def _children(pid: int) -> list[int]:
    """Processes that any thread of a process has started."""
    listed = [path.read_text().split() for path in Path(f"/proc/{pid}/task").glob("*/children")]
    return [int(word) for words in listed for word in words]


def test_a_taken_port_is_one_line(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        command = [sys.executable, "-m", "crkr.client", "server", "--data", str(tmp_path / "data"), "--web", str(port)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S, check=False)
    assert done.returncode == 1
    assert done.stderr == (
        f"error: cannot serve the web page on 127.0.0.1:{port}: the port is in use; stop what listens there or choose "
        "another\n"
    )
    assert not (tmp_path / "data").exists()


def test_a_web_server_that_ends_by_itself_is_an_error() -> None:
    with socket.socket(type=socket.SOCK_DGRAM) as unfit:
        unfit.bind(("127.0.0.1", 0))
        file = unfit.fileno()
        command = [sys.executable, "-m", "crkr.client", "page", "--serve", "0", "--socket-fd", str(file)]
        command += ["--connect", f"tcp/127.0.0.1:{unused_port()}"]
        done = subprocess.run(
            command, stdin=file, pass_fds=[file], stderr=subprocess.PIPE, text=True, timeout=PATIENCE_S, check=False
        )
    assert done.returncode == 1
    assert done.stderr.endswith("error: the web server ended; see its log\n")


def test_pages_served_elsewhere_outlast_a_restart_of_the_server(
    start_server: Start, spec: TaskSpec, tmp_path: Path, free_port: int, processes: Processes
) -> None:
    data = tmp_path / "data"
    server = start_server(data=data, port=free_port)
    command = [sys.executable, "-m", "crkr.client", "page", "--serve", "0", "--connect", server.endpoint]
    with Client(server.endpoint) as client, subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as pages:
        try:
            assert pages.stderr is not None
            told = pages.stderr.readline()
            assert told.startswith("pages of all tasks: http://127.0.0.1:")
            web = int(told.rstrip("/\n").rpartition(":")[2])
            task = client.create_task(spec)
            report(task, 30)
            processes.wait_until(lambda: "<b>30</b>" in parts(web, "crane"))
            server.process.terminate()
            server.process.wait(PATIENCE_S)
            processes.wait_until(lambda: "server does not answer" in parts(web, "crane"))
            again = start_server(data=data, port=free_port)
            assert again.endpoint == server.endpoint
            report(task, 12)
            processes.wait_until(lambda: "<b>42</b>" in parts(web, "crane"))
            pages.send_signal(signal.SIGTERM)
            assert pages.wait(PATIENCE_S) == 0
        finally:
            pages.kill()
