"""A link between client and server that is cut and healed: everything arrives, once."""

import json
import socket
import subprocess
import sys
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

import pytest
from network_namespaces import ip, two_machines
from processes import RunningServer
from zenoh_wire import Cable

OUTAGE_S = 4.0  # longer than a lease, so that the partition is noticed

REPORTER = """
import json, sys
from uuid import UUID
from crkr.client import Client
from crkr.protocol import Trial, Unavailable
endpoint, spec, count = sys.argv[1], json.loads(sys.argv[2]), int(sys.argv[3])
with Client(endpoint, timeout_s=60) as client:
    client.wait_until_ready(60.0)
    task = client.create_task(spec)
    for number in range(1, count + 1):
        task.report(state=[0.5, 0.5], goal=[0.0] * 3, cost=0.5, success=True, id=UUID(int=number))
        print(number, flush=True)
    print(json.dumps([sample.trial.id.int for sample in task.iter_samples()]), flush=True)
"""


def test_over_a_link_that_is_silent_for_a_while_everything_arrives_once(
    server: RunningServer, reach: dict[str, Any]
) -> None:
    count = 150
    with closing(Cable(server.port)) as cable, ExitStack() as stack:
        script = [sys.executable, "-c", REPORTER, cable.endpoint, json.dumps(reach), str(count)]
        client = stack.enter_context(subprocess.Popen(script, stdout=subprocess.PIPE, text=True))
        stack.callback(client.kill)
        assert client.stdout is not None
        lines = [client.stdout.readline() for _ in range(50)]
        with cable.cut(), pytest.raises(subprocess.TimeoutExpired):
            client.wait(timeout=2.5)  # longer than a lease
        lines += client.stdout.readlines()
        assert client.wait(timeout=10) == 0
    assert [int(line) for line in lines[:-1]] == list(range(1, count + 1))
    assert json.loads(lines[-1]) == list(range(1, count + 1))


@pytest.mark.campaign
@pytest.mark.timeout(120)
def test_over_a_cut_cable_everything_arrives_once(tmp_path: Path, reach: dict[str, Any]) -> None:
    """Needs the right to make network namespaces."""
    count = 400
    with two_machines() as (one, two), ExitStack() as stack:
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            endpoint = f"tcp/10.77.0.1:{probe.getsockname()[1]}"
        python = [sys.executable, "-m", "crkr.client", "server", "--listen", endpoint, "--data", str(tmp_path / "data")]
        server = stack.enter_context(
            subprocess.Popen(["ip", "netns", "exec", one, *python], stderr=subprocess.PIPE, text=True)
        )
        stack.callback(server.kill)
        assert server.stderr is not None
        assert "listening on" in server.stderr.readline()
        script = [sys.executable, "-c", REPORTER, endpoint, json.dumps(reach), str(count)]
        client = stack.enter_context(
            subprocess.Popen(["ip", "netns", "exec", two, *script], stdout=subprocess.PIPE, text=True)
        )
        stack.callback(client.kill)
        assert client.stdout is not None
        lines = []
        for end in (one, two):
            lines += [client.stdout.readline() for _ in range(50)]
            ip("-n", end, "link", "set", "cable", "down")
            with pytest.raises(subprocess.TimeoutExpired):
                client.wait(timeout=OUTAGE_S)
            ip("-n", end, "link", "set", "cable", "up")
        lines += client.stdout.readlines()
        assert client.wait(timeout=10) == 0
        server.terminate()
        assert server.wait(timeout=10) == 0
    assert [int(line) for line in lines[:-1]] == list(range(1, count + 1))
    assert json.loads(lines[-1]) == list(range(1, count + 1))
