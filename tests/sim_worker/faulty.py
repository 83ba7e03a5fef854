"""A skill that breaks its contract, for tests; the launcher's name says how."""

from __future__ import annotations

import importlib
import os
import threading
from collections.abc import Callable
from dataclasses import replace
from typing import Any, Final

import numpy as np

from crkr.sim_worker.skill import SkillOptions, TrialResult

_reaching = importlib.import_module("reaching")


class Scalar:
    """A number of another library, which has it as an array without axes."""

    ndim = 0
    shape = ()

    def __init__(self, value: float) -> None:
        self._value = value

    def item(self) -> float:
        return self._value


def raises(error: BaseException) -> Callable[[TrialResult], TrialResult]:
    def spoil(result: TrialResult) -> TrialResult:
        raise error

    return spoil


def gives(value: Any) -> Callable[[TrialResult], Any]:
    return lambda _: value


def has(**fields: Any) -> Callable[[TrialResult], TrialResult]:
    return lambda result: replace(result, **fields)


RESULTS: Final[dict[str, Callable[[TrialResult], Any]]] = {
    "raises": raises(RuntimeError("joint 3 stalled\nat 0.2 rad")),
    "leaves": raises(SystemExit(3)),
    "panics": raises(BaseException("a binding's panic")),
    "returns nothing": gives(None),
    "returns a map": gives({"cost": 0.5}),
    "cost nan": has(cost=float("nan")),
    "cost 2": has(cost=2.0),
    "cost none": has(cost=None),
    "cost text": has(cost="cheap"),
    "cost of two": has(cost=np.array([0.1, 0.2])),
    "cost of one axis": has(cost=np.array([0.1])),
    "outcome too long": has(outcome=np.zeros(3)),
    "success of two": has(success=np.array([True, False])),
    "info of numbers": has(info={1: 2}),
    "info too large": has(info={"all": "x" * 100_000}),
    "cost an array": lambda result: has(cost=np.array(result.cost))(result),
    "cost a tensor": lambda result: has(cost=Scalar(result.cost or 0.0))(result),
    "success an array": lambda result: has(success=np.array(result.success))(result),
    "trace of numbers": has(trace=[1, 2]),
}
STATES: Final[dict[str, Callable[[], Any]]] = {
    "reset raises": lambda: np.zeros(2)[5],
    "reset too long": lambda: np.zeros(3),
    "reset nan": lambda: np.full(2, np.nan),
    "reset nothing": lambda: None,
}


class Faulty:
    """Reaches, and in every third trial, or in all, does something else with the result."""

    def __init__(self, options: SkillOptions, every: int) -> None:
        self._well: Any = _reaching.Reaching(options)
        self._fault = options.launcher or ""
        self._every = every
        self._count = 0

    def execute(self, goal: Any) -> Any:
        result = self._well.execute(goal)
        self._count += 1
        spoilt = self._fault in RESULTS and self._count % self._every == 0
        return RESULTS[self._fault](result) if spoilt else result

    def demonstrations(self, count: int, rng: np.random.Generator) -> Any:
        if self._fault == "demonstrations raises":
            raise ZeroDivisionError("division by zero")
        return [(1, 2)] * count if self._fault == "demonstrations a pair" else self._well.demonstrations(count, rng)

    def reset(self, rng: np.random.Generator) -> Any:
        state = self._well.reset(rng)
        return STATES[self._fault]() if self._fault in STATES else state

    def spec(self) -> Any:
        if self._fault == "spec raises":
            raise KeyError("goal")
        return {} if self._fault == "spec a map" else self._well.spec()

    def best_plan(self, state: Any) -> Any:
        if self._fault == "best_plan raises":
            raise LookupError("no plan")
        return self._well.best_plan(state)

    def scene(self) -> Any:
        if self._fault == "scene raises":
            raise OSError("no mesh")
        return [3] if self._fault == "scene of numbers" else self._well.scene()


class Loud(Faulty):
    """Prints, has others print, moves to another folder, and starts threads that never end."""

    def execute(self, goal: Any) -> Any:
        print("swing")  # noqa: T201 - that is the point
        os.system("echo from a child")
        os.chdir("/")
        threading.Thread(target=threading.Event().wait, daemon=self._count > 0).start()
        return super().execute(goal)


def make(options: SkillOptions) -> Faulty:
    """Faulty now and then."""
    return Faulty(options, 3)


def make_always(options: SkillOptions) -> Faulty:
    """Faulty in every trial."""
    return Faulty(options, 1)


def make_loud(options: SkillOptions) -> Faulty:
    """Does what is no fault, but in the way of others."""
    return Loud(options, 1)
