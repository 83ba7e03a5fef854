"""What the learner learns from after any events, beside the batch algorithm and beside a replay of the same events."""

from __future__ import annotations

from typing import Any
from uuid import UUID

import numpy as np
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from crkr.learner import Learner, OutcomeExplorer, radii, top
from crkr.protocol import TaskSpec, make_trials

LENGTHSCALE = 0.5


def spec(budget: int) -> TaskSpec:
    return TaskSpec.from_dict(
        {
            "name": "t",
            "state": [{"name": f"x{i}", "low": -1, "high": 1, "lengthscale": LENGTHSCALE} for i in range(2)],
            "goal": [{"name": "g", "low": -1, "high": 1}],
            "outcome": [{"name": name, "tolerance": 0.1, "group": group} for name, group in ("aa", "ba", "cb")],
            "exploration": {"type": "outcome", "min_trials": 3, "neighbours": 5},
            "budget": budget,
        }
    )


class LearnerAgainstTheBatchAlgorithm(RuleBasedStateMachine):
    """Events of every kind; the truth is a list of what was told and Algorithm 2 in its obvious form."""

    @initialize(budget=st.integers(1, 6), seed=st.integers(0, 2**32 - 1))
    def start(self, budget: int, seed: int) -> None:
        self.created, self.budget, self.learn_from = spec(budget), budget, "successes"
        self.rng = np.random.default_rng(seed)
        self.learner = Learner(self.created)
        self.told: list[dict[str, Any]] = []
        self.events: list[tuple[str, tuple[Any, ...]]] = []

    def apply(self, name: str, *arguments: Any) -> None:
        seq = self.learner.version + 1
        self.events.append((name, (seq, *arguments)))
        perform(self.learner, self.events[-1])

    @rule(
        success=st.booleans(),
        kind=st.sampled_from(["trial", "trial", "demonstration", "evaluation", "failed"]),
        seen=st.sampled_from(["all", "all", "one group", "part of a group", "nothing", "not even asked"]),
    )
    def report(self, success: bool, kind: str, seen: str) -> None:
        outcome = self.rng.normal(size=3)
        outcome[{"one group": [2], "part of a group": [0, 2], "nothing": [0, 1, 2]}.get(seen, [])] = np.nan
        entry = {
            "id": UUID(int=len(self.told)),
            "state": self.rng.integers(-3, 4, 2) * 0.1,  # a lattice: duplicates and equal distances
            "goal": self.rng.uniform(-1, 1, 1),
            "cost": float(self.rng.integers(0, 5) / 4),
            "success": success and kind != "failed",
            "kind": kind,
            "outcome": None if seen == "not even asked" else outcome,
        }
        self.told.append({**entry, "removed": False})
        self.apply("report", entry)

    @precondition(lambda self: self.told)
    @rule()
    def recost(self) -> None:
        entry = self.told[int(self.rng.integers(len(self.told)))]
        entry["cost"] = float(self.rng.integers(0, 5) / 4)
        self.apply("recost", entry["id"], entry["cost"])

    @precondition(lambda self: self.told)
    @rule()
    def remove(self) -> None:
        entry = self.told[int(self.rng.integers(len(self.told)))]
        entry["removed"] = True
        self.apply("remove", entry["id"])

    @rule(budget=st.integers(1, 6))
    def change_the_budget(self, budget: int) -> None:
        self.budget = budget
        self.apply("configure", {"budget": budget})

    @rule()
    def learn_from_others(self) -> None:
        self.learn_from = "all" if self.learn_from == "successes" else "successes"
        self.apply("configure", {"learn_from": self.learn_from})

    def eligible(self) -> list[dict[str, Any]]:
        return [
            entry
            for entry in self.told
            if not entry["removed"]
            and (
                entry["kind"] == "demonstration"
                or (entry["kind"] == "trial" and (entry["success"] or self.learn_from == "all"))
            )
        ]

    def expected(self) -> list[UUID]:
        eligible = self.eligible()
        if not eligible:
            return []
        Z = np.array([entry["state"] for entry in eligible]) / LENGTHSCALE
        squared, _ = radii(Z, np.array([entry["cost"] for entry in eligible]))
        return [eligible[index]["id"] for index in top(squared, self.budget)]

    @invariant()
    def the_active_set_is_the_batch_algorithms(self) -> None:
        if hasattr(self, "learner"):
            assert self.learner.active_ids == self.expected()
            assert self.learner.eligible == len(self.eligible())

    @invariant()
    def what_guides_is_what_was_tried(self) -> None:
        if hasattr(self, "learner"):
            explorer = self.learner.model.explorer
            assert isinstance(explorer, OutcomeExplorer)
            tried = [entry for entry in self.told if not entry["removed"] and entry["kind"] != "evaluation"]
            unseen = np.full(3, np.nan)
            outcomes = np.array([unseen if (own := entry["outcome"]) is None else own for entry in tried]).reshape(
                -1, 3
            )
            np.testing.assert_array_equal(explorer.trials.Y, outcomes / 0.1)
            refused = [entry["kind"] == "failed" for entry in tried]
            np.testing.assert_array_equal(explorer.trials.refused, np.array(refused, dtype=np.bool_))
            states = np.array([entry["state"] for entry in tried]).reshape(-1, 2)
            np.testing.assert_allclose(explorer.trials.X[:, :2], states / LENGTHSCALE)
            assert explorer.trials.counts[1] == np.count_nonzero(np.isfinite(outcomes[:, 2]))

    def teardown(self) -> None:
        if not hasattr(self, "learner"):
            return
        replayed = Learner(self.created)
        with replayed.bulk(None):
            for event in self.events:
                perform(replayed, event)
        assert replayed.active_ids == self.learner.active_ids
        assert (replayed.version, replayed.eligible) == (self.learner.version, len(self.eligible()))
        if not self.learner.active_ids:
            return
        states, ids = self.rng.uniform(-0.4, 0.4, (6, 2)), [UUID(int=number) for number in range(6)]
        for explore in (False, True):
            ours, theirs = (one.predict(states, explore, ids) for one in (self.learner, replayed))
            np.testing.assert_allclose(ours.goals, theirs.goals, rtol=0, atol=1e-9)
            assert ours.policy == theirs.policy


def perform(learner: Learner, event: tuple[str, tuple[Any, ...]]) -> None:
    name, (seq, *arguments) = event
    if name == "report":
        learner.apply_trials([seq], make_trials(learner.spec, **arguments[0]))
    elif name == "recost":
        learner.apply_recost(seq, [arguments[0]], [arguments[1]])
    elif name == "remove":
        learner.apply_remove(seq, [arguments[0]])
    else:
        learner.apply_configure(seq, arguments[0])


LearnerAgainstTheBatchAlgorithm.TestCase.settings = settings(max_examples=80, stateful_step_count=25, deadline=None)
TestLearnerAgainstTheBatchAlgorithm = LearnerAgainstTheBatchAlgorithm.TestCase
