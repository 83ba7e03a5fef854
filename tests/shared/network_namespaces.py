"""Network namespaces that stand for machines with a cable between them; they need the right to make them."""

import os
import subprocess
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager


def ip(*arguments: str) -> None:
    subprocess.run(["ip", *arguments], check=True, capture_output=True, text=True)


def inside(namespace: str, *command: str) -> list[str]:
    """A command that runs in a namespace."""
    return ["ip", "netns", "exec", namespace, *command]


@contextmanager
def two_machines() -> Iterator[tuple[str, str]]:
    """Two network namespaces with a cable between them: 10.77.0.1 in the first, 10.77.0.2 in the second."""
    one, two = f"crkr-{os.getpid()}-a", f"crkr-{os.getpid()}-b"
    with ExitStack() as stack:
        for name in (one, two):
            ip("netns", "add", name)
            stack.callback(ip, "netns", "del", name)
        ip("-n", one, "link", "add", "cable", "type", "veth", "peer", "name", "cable", "netns", two)
        for name, address in ((one, "10.77.0.1/24"), (two, "10.77.0.2/24")):
            ip("-n", name, "address", "add", address, "dev", "cable")
            ip("-n", name, "link", "set", "cable", "up")
            ip("-n", name, "link", "set", "lo", "up")
        yield one, two
