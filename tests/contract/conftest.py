"""One real server for the whole contract; each test makes tasks of its own."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from processes import shared_server

from crkr.client import Client


@pytest.fixture(scope="session", params=["sqlite", "postgres"])
def client(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Client]:
    data: Path | str = tmp_path_factory.mktemp("contract")
    if request.param == "postgres":
        data = request.getfixturevalue("postgres").create("contract")
    with shared_server(data) as endpoint, Client(endpoint) as client:
        client.wait_until_ready(60.0)
        yield client
