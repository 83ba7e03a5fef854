"""A client of another kind holds a whole conversation with a real server."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.linalg import cho_factor, cho_solve

Ask = Callable[..., dict[str, Any]]
Numbers = Callable[[Any], np.ndarray[Any, Any]]
MakeTrial = Callable[..., dict[str, Any]]


def test_the_server_introduces_itself(ask: Ask) -> None:
    info = ask("rpc/info")
    assert info["protocol"] == 1
    assert any(name.startswith("reach-") for name in info["tasks"])  # beside those of other tests
    assert info["limits"] == {"states": 4096, "trials": 1024, "message_bytes": 8 * 1024 * 1024}
    assert len(info["server_id"]) == 16


def test_the_same_specification_again_is_fine_and_another_is_refused(ask: Ask, reach: dict[str, Any]) -> None:
    again = ask("rpc/create_task", {**reach, "description": "the same in other words", "learn_from": "successes"})
    assert again["created"] is False
    other = ask("rpc/create_task", {**reach, "budget": 21})["error"]
    assert other["code"] == "CONFLICT"
    assert other["details"]["fields"] == {"budget": [20, 21]}


def test_a_prediction_is_the_posterior_mean_of_what_was_reported(
    ask: Ask, make_trial: MakeTrial, numbers: Numbers
) -> None:
    trials = [make_trial(number, kind="demonstration") for number in range(6)]
    receipt = ask("task/reach/rpc/report", {"trials": trials, "wait": True})
    assert receipt == {"accepted": 6, "duplicates": 0, "seqs": [2, 3, 4, 5, 6, 7], "model_version": 7}
    asked = np.array([[0.3, 0.1], [0.8, -0.5]])
    answer = ask("task/reach/rpc/predict", {"states": asked.tolist()})

    states, goals = np.array([t["state"] for t in trials]), np.array([t["goal"] for t in trials])
    costs, prior = np.array([t["cost"] for t in trials]), np.array([t["goal"] for t in trials]).mean(axis=0)

    def kernel(a: np.ndarray[Any, Any], b: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
        z = (a[:, None] - b[None]) / [0.2, 0.4]
        return np.asarray(np.exp(-0.5 * (z**2).sum(-1)))

    factor = cho_factor(kernel(states, states) + np.diag(np.maximum(costs, 1e-4)))
    cross = kernel(asked, states)
    mean = prior + cross @ cho_solve(factor, goals - prior)
    variance = 1 - np.einsum("ij,ji->i", cross, cho_solve(factor, cross.T))
    np.testing.assert_allclose(numbers(answer["means"]), mean, atol=1e-9)
    np.testing.assert_allclose(numbers(answer["sigmas"]), np.sqrt(variance)[:, None].repeat(3, 1), atol=1e-9)
    np.testing.assert_allclose(numbers(answer["novelty"]), variance, atol=1e-9)
    assert answer["model_version"] == 7
    assert answer["active"] == 6
    assert answer["policy"] == "mean"
    assert len(answer["trial_ids"]) == 2


def test_one_state_and_a_batch_of_one_differ_in_shape_only(ask: Ask, make_trial: MakeTrial, numbers: Numbers) -> None:
    ask("task/reach/rpc/report", {"trials": [make_trial(0), make_trial(1)], "wait": True})
    state = {"shape": [2], "dtype": "<f4", "data": np.array([0.25, 0.5], "<f4").tobytes()}
    one, batch = (ask("task/reach/rpc/predict", {"states": states}) for states in (state, [[0.25, 0.5]]))
    assert numbers(one["goals"]).shape == (3,)
    assert numbers(one["novelty"]).shape == ()
    np.testing.assert_allclose(numbers(batch["goals"])[0], numbers(one["goals"]), atol=1e-9)


def test_the_same_trial_id_draws_the_same_goal_and_another_does_not(
    ask: Ask, make_trial: MakeTrial, numbers: Numbers, new_id: Callable[[], bytes]
) -> None:
    ask("task/reach/rpc/report", {"trials": [make_trial(0)], "wait": True})
    first, second = new_id(), new_id()

    def draw(trial_id: bytes) -> np.ndarray[Any, Any]:
        answer = ask("task/reach/rpc/predict", {"states": [0.5, 0.0], "explore": True, "trial_ids": [trial_id]})
        assert answer["policy"] == "explore"
        assert answer["trial_ids"] == [trial_id]
        return numbers(answer["goals"])

    np.testing.assert_allclose(draw(first), draw(first), atol=1e-9)
    assert not np.allclose(draw(first), draw(second))
    assert np.abs(draw(second)).max() <= 2.0


def test_samples_come_in_pages_in_the_order_of_the_log(ask: Ask, make_trial: MakeTrial, numbers: Numbers) -> None:
    trials = [make_trial(number, info={"number": number}, worker="ada", model_version=1) for number in range(7)]
    ask("task/reach/rpc/report", {"trials": trials})
    pages: list[int] = []
    after: int | None = 0
    while after is not None:
        page = ask("task/reach/rpc/samples", {"after": after, "limit": 3})
        pages.append(len(page["samples"]))
        for sample, trial in zip(page["samples"], trials[sum(pages) - pages[-1] :], strict=False):
            assert numbers(sample["state"]).tolist() == trial["state"]
            assert numbers(sample["goal"]).tolist() == trial["goal"]
            assert {name: sample[name] for name in ("id", "cost", "success", "kind", "info", "worker")} == {
                name: trial[name] for name in ("id", "cost", "success", "kind", "info", "worker")
            }
        after = page["next"]
    assert pages == [3, 3, 1]


def test_a_model_is_handed_out_once_a_version(ask: Ask, make_trial: MakeTrial, numbers: Numbers) -> None:
    trials = [make_trial(number) for number in range(4)]
    ask("task/reach/rpc/report", {"trials": trials, "wait": True})
    model = ask("task/reach/rpc/model")
    assert model["version"] == 5
    assert model["ids"] == [trial["id"] for trial in trials]
    assert numbers(model["states"]).tolist() == [trial["state"] for trial in trials]
    assert ask("task/reach/rpc/model", {"known_version": 5})["unchanged"] is True
    assert ask("task/reach/rpc/model", {"known_version": 4})["version"] == 5


def test_an_explanation_names_the_samples_and_the_suppressor(ask: Ask, make_trial: MakeTrial) -> None:
    better = make_trial(0, state=[0.5, 0.0], cost=0.1)
    worse = make_trial(1, state=[0.5, 0.4], cost=0.5)
    ask("task/reach/rpc/report", {"trials": [better, worse], "wait": True})
    answer = ask("task/reach/rpc/explain", {"state": [0.5, 0.1], "sample_id": worse["id"]})
    assert {neighbour["id"] for neighbour in answer["neighbours"]} == {better["id"], worse["id"]}
    assert answer["active"] is True
    assert answer["suppressor"] == better["id"]
    assert answer["radius"] == pytest.approx(1.0)
    assert 0 <= answer["novelty"] <= 1


def test_status_counts_what_was_reported(ask: Ask, make_trial: MakeTrial) -> None:
    trials = [
        make_trial(0, kind="demonstration"),
        make_trial(1),
        make_trial(2, success=False),
        make_trial(3, kind="evaluation"),
        make_trial(4, kind="failed", cost=None, success=False),
    ]
    ask("task/reach/rpc/report", {"trials": trials, "wait": True})
    status = ask("task/reach/rpc/status")
    assert status["samples"] == {"demonstration": 1, "trial": 2, "evaluation": 1, "failed": 1}
    assert (status["eligible"], status["active"]) == (2, 2)
    assert (status["seq"], status["model_version"]) == (6, 6)
    assert status["latency_us"]["report"]["p50"] > 0
    assert status["queues"]["report"] == {"waiting": 0, "limit": 4096}
    brief = ask("task/reach/rpc/status", {"brief": True})
    assert brief == {name: status[name] for name in brief}
    assert {"samples", "seq", "model_version"} < set(brief)
    assert "workers" not in brief
    [listed] = [task for task in ask("rpc/tasks")["tasks"] if task["spec"]["name"] == status["task"]]
    assert (listed["samples"], listed["active"], listed["model_version"]) == (5, 2, 6)


def test_tasks_on_one_server_know_nothing_of_each_other(ask: Ask, make_trial: MakeTrial, reach: dict[str, Any]) -> None:
    assert ask("rpc/create_task", {**reach, "name": "other"})["created"] is True
    ask("task/reach/rpc/report", {"trials": [make_trial(0)], "wait": True})
    ask("task/other/rpc/report", {"trials": [make_trial(0, cost=0.5)], "wait": True})
    assert ask("task/other/rpc/status")["seq"] == 2
    assert ask("task/reach/rpc/samples")["samples"][0]["cost"] != 0.5
