"""A specification with an absurd number is refused, or its task answers as any other: finite, and within bounds."""

from collections.abc import Callable, Iterator
from copy import deepcopy
from typing import Any, Final

import numpy as np
import pytest
from odd_values import FLOATS, WHOLE, encoded
from valid_messages import specification, trial

Ask = Callable[..., dict[str, Any]]
Rng = np.random.Generator

NUMBERS: Final = (*FLOATS, *WHOLE, 1e6, 1e-6, 1e-300, 1e300, 1e-12, 1e12)
STATES: Final = ([0.3, 0.4], [0.01, -0.9], [1e10, 0.0], [1e308, -1e308], [0.5, 1e154])
OTHERS: Final = (
    {"cost": "label"},
    {"cost": "label", "learn_from": "all"},
    {"learn_from": "all", "cost_map": "odds"},
    {"start": {"type": "space-filling", "count": 45}},
    {"start": {"type": "demonstrations", "count": 3}},
    {"selector": "full", "prior_mean": "zero"},
    {"selector": "freeze", "novel": "refuse"},
)
UNKNOWN: Final = ("success_probability", "predicted_outcome", "predicted_outcome_sd")  # may be NaN: nothing is known
UNUSABLE: Final = ("INTERNAL", "STORAGE", "SHUTTING_DOWN")
TRIALS: Final = 40


def places(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Where a specification has numbers."""
    if isinstance(value, dict | list):
        for name, entry in value.items() if isinstance(value, dict) else enumerate(value):
            yield from places(entry, (*path, name))
    elif isinstance(value, int | float):
        yield path


def odd(name: str, rng: Rng) -> dict[str, Any]:
    """A specification with one or two absurd numbers."""
    spec = deepcopy(specification(name, guided=bool(rng.random() < 0.5)))
    if rng.random() < 0.5:
        spec |= deepcopy(OTHERS[int(rng.integers(len(OTHERS)))])
    spec["exploration"]["drift"] = True
    found = list(places(spec))
    for _ in range(1 if rng.random() < 0.6 else 2):
        *within, last = found[int(rng.integers(len(found)))]
        part: Any = spec
        for step in within:
            part = part[step]
        number = NUMBERS[int(rng.integers(len(NUMBERS)))]
        part[last] = int(number) if isinstance(part[last], int) and abs(number) < 2**63 else number
    return spec


def practised(spec: dict[str, Any], rng: Rng) -> list[dict[str, Any]]:
    """Trials that are in order, some in absurd states and with absurd outcomes."""
    trials, misses = [], rng.random() < 0.2  # alone
    for number in range(TRIALS):
        made = {**trial(spec, number + 1, rng), "kind": "trial", "success": not misses}
        if rng.random() < 0.1:
            made |= {"kind": "failed", "success": False, "cost": None}
        if spec["cost"] == "label" and rng.random() < 0.7:
            made |= {"cost": None, "success": not misses and bool(rng.random() < 0.7)}
        if rng.random() < 0.05:
            made["state"] = encoded(STATES[int(rng.integers(len(STATES)))])
        if "outcome" in made and rng.random() < 0.1:
            made["outcome"] = encoded(rng.choice([1e308, -1e308, np.nan, 5e-324, 0.1], 2))
        trials.append(made)
    return trials


def numbers(value: Any) -> Iterator[float]:
    """Every number of an answer."""
    if isinstance(value, dict) and {"shape", "dtype", "data"} <= value.keys():
        yield from np.frombuffer(value["data"], value["dtype"]).tolist()
    elif isinstance(value, dict | list):
        for entry in value.values() if isinstance(value, dict) else value:
            yield from numbers(entry)
    elif isinstance(value, float):
        yield value


class Practice:
    """One task with an odd specification: what it is asked, and what is wrong with its answers."""

    def __init__(self, ask: Ask, spec: dict[str, Any]) -> None:
        self._ask, self._spec = ask, spec
        self.wrong: list[str] = []
        self._low, self._high = ([axis[end] for axis in spec["goal"]] for end in ("low", "high"))

    def ask(self, verb: str, message: dict[str, Any]) -> dict[str, Any]:
        """Asks, and sees to it that the answer is one."""
        answer = self._ask(f"task/{self._spec['name']}/{verb}", message)
        error = answer.get("error", {})
        if error.get("code") in UNUSABLE:
            self._complain(verb, error["message"])
        elif not all(np.isfinite(one) for one in numbers({**answer, **dict.fromkeys(UNKNOWN)})):
            self._complain(verb, "a number that is none")
        elif not all(np.isnan(one) or 0 <= one <= 1 for one in numbers(answer.get("success_probability"))):
            self._complain(verb, "a probability that is none")
        return answer

    def predict(self, state: list[float], explore: bool) -> None:
        """Asks for a goal."""
        answer = self.ask("rpc/predict", {"states": state, "explore": explore})
        if "goals" in answer:
            goal = np.frombuffer(answer["goals"]["data"])
            if not ((goal >= self._low) & (goal <= self._high)).all():
                self._complain("predict", f"{goal} is out of bounds")

    def _complain(self, verb: str, what: str) -> None:
        self.wrong.append(f"{verb}: {what[:200]}: {self._spec}")


@pytest.mark.parametrize(
    "count",
    [60, pytest.param(4000, marks=[pytest.mark.campaign, pytest.mark.timeout(1800)])],
    ids=["short", "long"],
)
def test_a_specification_that_is_taken_gives_finite_goals_within_its_bounds(
    count: int, start_server: Callable[..., Any], connect: Callable[[str], Ask]
) -> None:
    server, rng = start_server(), np.random.default_rng(count)
    ask = connect(server.endpoint)
    taken, wrong = [], []
    for number in range(count):
        spec = odd(f"odd-{number}", rng)
        created = ask("rpc/create_task", spec)
        if "error" in created:
            if created["error"]["code"] != "INVALID":
                wrong.append(f"{created}: {spec}")
            continue
        taken.append(spec["name"])
        practice = Practice(ask, spec)
        practice.ask("rpc/report", {"trials": practised(spec, rng), "wait": True})
        for state in STATES:
            practice.predict(state, explore=False)
            practice.predict(state, explore=True)
        practice.ask("rpc/explain", {"state": STATES[0], "sample_id": (1).to_bytes(16, "big")})
        practice.ask("rpc/model", {})
        practice.ask("admin/configure", {"changes": {"regularisation": 0.5}})
        if number % 4 == 0:
            practice.ask("admin/refit", {})
        practice.ask("admin/remove", {"ids": [(2).to_bytes(16, "big")]})
        practice.predict(STATES[0], explore=True)
        wrong += practice.wrong
    assert wrong == []
    assert len(taken) > count / 5

    server.process.kill()
    server.process.wait(timeout=5)
    ask = connect(start_server().endpoint)
    assert [name for name in taken if "fault" in ask(f"task/{name}/rpc/status")] == []
