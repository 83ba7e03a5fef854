"""A check of a skill in a process of its own, which ends within its time limit, whatever the skill does."""

from __future__ import annotations

import faulthandler
import os
import re
import signal
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from itertools import pairwise
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Final, final

from crkr.protocol import CrkrError
from crkr.sim_worker import guarded_skill, skill_registry
from crkr.sim_worker.guarded_skill import keep_standard_output
from crkr.sim_worker.skill import SkillOptions
from crkr.sim_worker.skill_check import Remark, check
from crkr.sim_worker.supervisor.child_process import MessagePipe, end_with_parent
from crkr.sim_worker.supervisor.processes import WorkerProcess, WorkerProcesses
from crkr.sim_worker.supervisor.stall import StallWatch

__all__ = ["timed_check"]

LOOKS_S: Final = 0.1
LOADING_S: Final = 30.0  # longer than a trial: simulators are large
LISTENS_S: Final = 0.5  # for where the skill is
LOADING: Final = "its module or factory"
_FRAME: Final = re.compile(r'File "(.*)", line (\d+) in ')


@final
@dataclass(frozen=True, slots=True)
class _Settings:
    skill: str
    options: SkillOptions
    seed: int


def timed_check(skill: str, options: SkillOptions, *, seed: int, timeout_s: float) -> Iterator[Remark]:
    """Checks a skill as `skill_check.check` does; its process and all that the skill starts end with the check.

    Args:
        skill: As for `load_skill`.
        options: Likewise.
        seed: Of the situations and goals.
        timeout_s: Time limit of a trial, or another call of the skill [s]; loading it may take 30 s more.

    Raises:
        CrkrError: The skill cannot be loaded.
        ModuleNotFoundError: A library that it needs is not installed.
    """
    with WorkerProcesses() as processes:
        process = processes.start("check", _check, _Settings(skill, options, seed))
        try:
            yield from _followed(processes, process, timeout_s)
        finally:
            process.kill(0.0)


def _followed(processes: WorkerProcesses, process: WorkerProcess, timeout_s: float) -> Iterator[Remark]:
    method, silences = LOADING, StallWatch[WorkerProcess](timeout_s)
    while True:
        for _, event in processes.events(LOOKS_S):
            silences.heard(process)
            match event:
                case {"event": "call", "method": str(method)}:
                    pass
                case {"event": "remark", "level": str(level), "what": str(what), "message": str(message)}:
                    yield Remark(level, what, message)
                case {"event": "failed", "reason": str(reason), "library": library}:
                    raise ModuleNotFoundError(reason, name=library) if library else CrkrError(reason)
                case {"event": "checked"}:
                    return
                case None:
                    yield Remark("problem", method, f"the skill ended its process, which {process.ending()}")
                    return
        loads = method == LOADING
        if silences.look([process], [process] if loads else [], LOADING_S):
            what = "a trial" if method == "execute" else "loading" if loads else "a call"
            place = _place(process, loads)
            where = f"; it is at {place}" if place else ""
            limit_s = timeout_s + (LOADING_S if loads else 0.0)
            yield Remark("problem", method, f"{what} did not end within {limit_s:g} s{where}; --timeout allows more")
            return


def _place(process: WorkerProcess, loads: bool) -> str:
    """The main thread's line in the skill's file, by a signal that needs no lock of the interpreter; "" if unknown."""
    told = b""
    with suppress(OSError):
        os.kill(process.process.pid or 0, signal.SIGUSR1)
        while wait([process.pipe.connection], LISTENS_S) and (part := os.read(process.pipe.connection.fileno(), 4096)):
            told += part
    frames = _FRAME.findall(told.decode(errors="replace"))  # innermost first
    own = next((file for (file, _), (caller, _) in pairwise(frames) if caller == guarded_skill.__file__ != file), "")
    if loads or b"..." in told:  # or a recursion, of which the outer calls are not told
        own = frames[0][0] if frames else ""
    return next((f"{Path(file).name}, line {line}" for file, line in frames if file == own), "")


def _check(settings: _Settings, connection: Connection) -> None:
    """The body of the process: announces every call of the skill."""
    end_with_parent()
    keep_standard_output()
    faulthandler.register(signal.SIGUSR1, connection.fileno(), all_threads=False)
    pipe = MessagePipe(connection)

    @contextmanager
    def told(method: str) -> Iterator[None]:
        pipe.send({"event": "call", "method": method})
        yield

    def fail(reason: str, library: str = "") -> None:
        pipe.send({"event": "failed", "reason": reason, "library": library})

    try:
        with told(LOADING):
            skill = skill_registry.load_skill(settings.skill, settings.options)
        for remark in check(skill, seed=settings.seed, within=told):
            pipe.send({"event": "remark", **asdict(remark)})
        pipe.send({"event": "checked"})
    except CrkrError as error:
        fail(error.message)
    except ModuleNotFoundError as error:
        fail(str(error), error.name or "")
    except KeyboardInterrupt as error:  # only the skill raises it: those of a terminal are blocked
        fail(f"skill {settings.skill!r}: {guarded_skill.one_line(error)}")
