"""Run a `crkr` command that ends when its starter does: `python -m crkr.sim_worker.demo.bound_command server ...`.

Standard input is the tether: a pipe whose other end only the starter holds, so that it closes even if that is killed.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from typing import Final

from crkr.client.cli.main import main

__all__: list[str] = []

PATIENCE_S: Final = 4.0
ORPHANED: Final = 3


def _watch() -> None:
    while os.read(0, 4096):
        continue
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(PATIENCE_S)
    os._exit(ORPHANED)


if __name__ == "__main__":
    threading.Thread(target=_watch, name="tether", daemon=True).start()
    sys.argv[0] = "crkr"
    main()
