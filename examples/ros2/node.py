"""A ROS 2 node that serves a task to other nodes: services /TASK/predict and /TASK/report, see README.md.

It speaks the wire format of rmw_zenoh and needs no ROS 2 itself:

    pip install crkr zenoh-ros2-sdk
    python examples/ros2/node.py throw --connect tcp/127.0.0.1:7448 --router 127.0.0.1:7447
"""

import argparse
import signal
import sys
import threading
import time
from pathlib import Path
from typing import Any
from uuid import UUID

import numpy as np
from zenoh_ros2_sdk import ROS2ServiceServer

from crkr.client import Client, Task
from crkr.protocol import CrkrError

PACKAGE = Path(__file__).parent / "crkr_interfaces"


def definition(service: str) -> dict[str, str]:
    """Type and definitions of a service of crkr_interfaces, as the SDK's classes take them."""
    request, response = (PACKAGE / "srv" / f"{service}.srv").read_text(encoding="utf-8").split("---\n")
    return {
        "srv_type": f"crkr_interfaces/srv/{service}",
        "request_definition": request,
        "response_definition": response,
    }


def address(router: str) -> dict[str, Any]:
    """HOST:PORT of rmw_zenohd, as the SDK's classes take it."""
    host, _, port = router.rpartition(":")
    return {"router_ip": host, "router_port": int(port)}


def await_service(client: Any, patience_s: float = 30.0) -> None:
    """Wait until the session of a `ROS2ServiceClient` knows the service: a call before that gets no answer."""
    until = time.monotonic() + patience_s
    while not client.querier.matching_status.matching:
        if time.monotonic() > until:
            raise SystemExit(f"nobody serves {client.service_name}; is node.py running, with the same router?")
        time.sleep(0.02)


class Policy:
    """A task's two services.

    Args:
        task: Of the crkr server.
        router: HOST:PORT of rmw_zenohd.
    """

    def __init__(self, task: Task, router: str) -> None:
        self._task = task
        self._goal_size = len(task.spec.goal)
        name = "/" + task.name.replace("-", "_")
        there = {"node_name": f"crkr_{name[1:]}", **address(router)}
        self._predict = ROS2ServiceServer(f"{name}/predict", callback=self.predict, **definition("Predict"), **there)
        self._report = ROS2ServiceServer(f"{name}/report", callback=self.report, **definition("Report"), **there)

    def predict(self, request: Any) -> Any:
        """Answers Predict."""
        empty, none = np.zeros(0), np.zeros(16, np.uint8)
        answer = {"ok": False, "error": "", "trial_id": none, "goal": empty, "mean": empty, "sigma": empty}
        answer |= {"novelty": np.nan, "success_probability": np.nan, "model_version": 0}
        try:
            got = self._task.predict(request.state, explore=bool(request.explore))
        except CrkrError as error:
            return self._predict.response_msg_class(**{**answer, "error": error.message})
        answer |= {"ok": True, "trial_id": np.frombuffer(got.trial_id.bytes, np.uint8)}
        answer |= {"goal": got.goal, "mean": got.mean, "sigma": got.sigma, "novelty": float(got.novelty)}
        answer |= {"model_version": got.model_version}
        if got.success_probability is not None:
            answer |= {"success_probability": float(got.success_probability)}
        return self._predict.response_msg_class(**answer)

    def report(self, request: Any) -> Any:
        """Answers Report, after the trial is on the server's disk."""
        trial = {"state": request.state, "goal": request.goal, "kind": request.kind or "trial", "worker": "ros2"}
        trial |= {"success": bool(request.success), "id": UUID(bytes=bytes(request.trial_id))}
        trial |= {"cost": None if np.isnan(request.cost) else float(request.cost)}
        trial |= {"outcome": request.outcome if len(request.outcome) else None}
        answer = {"ok": True, "error": "", "seq": 0, "duplicate": False}
        try:
            receipt = self._task.report(**trial)
            answer |= {"seq": receipt.seqs[0], "duplicate": receipt.duplicates > 0}
        except CrkrError as error:
            answer |= {"ok": False, "error": error.message}
        return self._report.response_msg_class(**answer)

    def close(self) -> None:
        """Ends the services."""
        self._predict.close()
        self._report.close()


def main() -> None:
    parser = argparse.ArgumentParser(description="Serve a crkr task to ROS 2 nodes.")
    parser.add_argument("task")
    parser.add_argument("--connect", default="tcp/127.0.0.1:7448", help="the crkr server")
    parser.add_argument("--router", default="127.0.0.1:7447", help="HOST:PORT of rmw_zenohd")
    options = parser.parse_args()
    ended = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: ended.set())
    with Client(options.connect) as client:
        policy = Policy(client.task(options.task), options.router)
        print(f"serving task {options.task}", flush=True)
        ended.wait()
        policy.close()


if __name__ == "__main__":
    try:
        main()
    except CrkrError as error:
        sys.exit(f"error: {error}")
