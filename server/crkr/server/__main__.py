"""`python -m crkr.server`: the service without the rest of the `crkr` command."""

from __future__ import annotations

import sys

import typer

from crkr.protocol import CrkrError
from crkr.server.command import server

if __name__ == "__main__":
    try:
        typer.run(server)
    except CrkrError as error:
        sys.stderr.write(f"error: {error.message}\n")
        sys.exit(1)
