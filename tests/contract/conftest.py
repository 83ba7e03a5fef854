"""One real server for the whole contract; each test makes tasks of its own."""

from collections.abc import Iterator

import pytest
from shared_server import shared_server

from crkr.client import Client


@pytest.fixture(scope="session")
def client(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Client]:
    with shared_server(tmp_path_factory.mktemp("contract")) as endpoint, Client(endpoint) as client:
        client.wait_until_ready(20.0)
        yield client
