"""Messages that a client might send, written from the protocol's description: none of the server's code is used."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

import numpy as np
from odd_values import encoded

Rng = np.random.Generator
_Value = TypeVar("_Value")


def one(values: Sequence[_Value], rng: Rng) -> _Value:
    """One of them."""
    return values[int(rng.integers(len(values)))]


def specification(name: str, *, guided: bool = False) -> dict[str, Any]:
    """A task with every field spelt out: two numbers of state, three of goal."""
    spec: dict[str, Any] = {
        "name": name,
        "description": "for messages",
        "seed": 7,
        "state": [
            {"name": "x", "unit": "m", "low": 0.0, "high": 1.0, "lengthscale": 0.2},
            {"name": "y", "unit": "m", "low": -1.0, "high": 1.0, "lengthscale": 0.4},
        ],
        "goal": [{"name": f"g{one}", "unit": "rad", "low": -2.0, "high": 2.0, "scale": 1.0} for one in range(3)],
        "kernel": {"type": "se-ard", "signal_variance": 1.0, "linear_weight": 0.0},
        "budget": 20,
        "regularisation": 1.0,
        "cost_map": "linear",
        "noise_floor": 1e-4,
        "learn_from": "successes",
        "prior_mean": "demonstrations",
        "explore_scale": 1.0,
        "exploration_floor": 0.0,
        "novel": "predict",
        "novelty_limit": 0.9,
        "selector": "anms",
        "refit_every": 0,
        "exploration": {"type": "gaussian"},
        "start": {"type": "space-filling", "count": 0},
        "cost": "measured",
    }
    if guided:
        spec["outcome"] = [
            {"name": name, "unit": "m", "target": 0.0, "tolerance": 0.05, "group": "landing", "aim": aim}
            for name, aim in (("dx", "equal"), ("dy", "at_least"))
        ]
        given = {"trust": 4.0, "temperature": [0.1, 0.5], "neighbours": 20, "iterations": 2, "min_trials": 10}
        spec["exploration"] = {"type": "outcome", **given, "gate": 2.0, "candidates": 4}
        spec["exploration"]["drift"] = False  # so that all entries of the log come from requests
    return spec


def inside(spec: Mapping[str, Any], name: str, rng: Rng) -> dict[str, Any]:
    """A point of the box, as well as an odd specification has one."""
    low, high = ([axis.get(end, 0.0) for axis in spec[name]] for end in ("low", "high"))
    part = rng.uniform(size=len(low))
    return encoded(np.asarray(low) * (1 - part) + np.asarray(high) * part)


def trial(spec: Mapping[str, Any], number: int, rng: Rng) -> dict[str, Any]:
    """A trial that is in order, whose id is a number."""
    trial: dict[str, Any] = {
        "id": number.to_bytes(16, "big"),
        "state": inside(spec, "state", rng),
        "goal": inside(spec, "goal", rng),
        "cost": float(rng.uniform(0, 0.9)),
        "success": bool(rng.random() < 0.7),
        "kind": one(("trial", "trial", "demonstration", "evaluation"), rng),
        "worker": "eve",
        "model_version": 3,
        "info": {"epoch": 1, "reason": "none", "path": [1.0, 2.0]},
    }
    if spec.get("outcome"):
        trial["outcome"] = encoded(rng.normal(size=len(spec["outcome"])))
    return trial


def request(verb: str, spec: Mapping[str, Any], new: Sequence[str], rng: Rng) -> dict[str, Any]:
    """A request that a client might send."""
    fresh = 2**40 + int(rng.integers(2**40))
    known = [int(one).to_bytes(16, "big") for one in rng.choice(30, 2, replace=False) + 1]
    states = inside(spec, "state", rng)
    makers: dict[str, Callable[[], dict[str, Any]]] = {
        "predict": lambda: {"states": states, "explore": True, "trial_ids": known[:1], "worker": "eve"},
        "report": lambda: {
            "trials": [trial(spec, fresh, rng), trial(spec, fresh + 1, rng)],
            "wait": bool(rng.random() < 0.3),
        },
        "trial": lambda: trial(spec, fresh, rng),
        "notice": lambda: {"version": 5, "active": 3, "added": known, "evicted": []},
        "model": lambda: {"known_version": 3},
        "tasks": lambda: {"after": 0, "limit": 3},
        "samples": lambda: one(({"after": 0, "limit": 5}, {"last": 3, "before": 9}, {"id": known[:1]}), rng),
        "explain": lambda: {"state": states, "sample_id": known[0]},
        "create_task": lambda: specification(one(new, rng), guided=bool(rng.random() < 0.3)),
        "recost": lambda: {"ids": known, "costs": encoded([0.5, 0.25]), "reason": "because"},
        "amend": lambda: {
            "ids": known,
            "success": bool(rng.random() < 0.5),
            "cost": 0.25,
            "kind": "trial",
            "restore": True,
            "reason": "because",
        },
        "rollback": lambda: {"to": int(rng.integers(1, 40)), "reason": "because"},
        "undo": lambda: {"request": fresh.to_bytes(16, "big"), "worker": "eve", "reason": "because"},
        "rename": lambda: {"name": one((*new, f"moved-{rng.integers(60)}"), rng), "request": known[0]},
        "delete": lambda: {"request": known[0]},
        "remove": lambda: {"ids": known[:1], "reason": "because"},
        "configure": lambda: {
            "changes": {
                name: spec.get(name, 1.0)
                for name in ("budget", "kernel", "regularisation", "noise_floor", "novelty_limit", "refit_every")
            }
        },
    }
    return makers[verb]() if verb in makers else {}
