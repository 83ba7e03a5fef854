"""Changes after the fact: exact, durable, and refused where they make no sense."""

from collections.abc import Callable
from typing import Any
from uuid import UUID

import numpy as np
import pytest
from processes import Processes

Ask = Callable[..., dict[str, Any]]
Numbers = Callable[[Any], np.ndarray[Any, Any]]
MakeTrial = Callable[..., dict[str, Any]]
COUNT = 60


@pytest.fixture
def trials(ask: Ask, make_trial: MakeTrial) -> list[dict[str, Any]]:
    made = [make_trial(number) for number in range(COUNT)]
    ask("task/reach/rpc/report", {"trials": made, "wait": True})
    return made


def active(ask: Ask) -> set[bytes]:
    return set(ask("task/reach/rpc/model")["ids"])


def expected(trials: list[dict[str, Any]], budget: int = 20) -> set[bytes]:
    """The active set by the batch algorithm, over all trials at once."""
    z = np.array([trial["state"] for trial in trials]) / [0.2, 0.4]
    costs = np.array([trial["cost"] for trial in trials])
    squared = ((z[:, None] - z[None]) ** 2).sum(-1)
    better = (costs[None] < costs[:, None]) | ((costs[None] == costs[:, None]) & np.tri(len(z), k=-1, dtype=bool))
    found = np.where(better, squared, np.inf).min(axis=1)
    order = np.lexsort((np.arange(len(z)), -found))
    return {trials[row]["id"] for row in order[:budget]}


def test_the_active_set_is_the_batch_algorithms(ask: Ask, trials: list[dict[str, Any]]) -> None:
    assert active(ask) == expected(trials)


def test_new_costs_count_as_if_they_had_been_reported(ask: Ask, trials: list[dict[str, Any]]) -> None:
    best = min(trials, key=lambda trial: trial["cost"])
    other = trials[7]
    reply = ask(
        "task/reach/admin/recost", {"ids": [best["id"], other["id"]], "costs": [0.95, 0.01], "reason": "camera off"}
    )
    assert reply == {"changed": 2, "seq": COUNT + 2, "model_version": COUNT + 2}
    costs = {best["id"]: 0.95, other["id"]: 0.01}
    recosted = [{**trial, "cost": costs.get(trial["id"], trial["cost"])} for trial in trials]
    assert active(ask) == expected(recosted)
    samples = ask("task/reach/rpc/samples")["samples"]
    assert [sample["cost"] for sample in samples] == [trial["cost"] for trial in recosted]
    assert ask("task/reach/rpc/report", {"trials": [best]})["duplicates"] == 1


def test_removed_trials_are_not_learned_from_and_stay_known(ask: Ask, trials: list[dict[str, Any]]) -> None:
    gone = trials[10:20]
    reply = ask("task/reach/admin/remove", {"ids": [trial["id"] for trial in gone]})
    assert (reply["removed"], reply["seq"]) == (10, COUNT + 2)
    assert active(ask) == expected(trials[:10] + trials[20:])
    assert ask("task/reach/rpc/report", {"trials": gone[:1], "wait": True})["duplicates"] == 1
    assert not active(ask) & {trial["id"] for trial in gone}
    samples = ask("task/reach/rpc/samples")["samples"]
    assert {sample["id"] for sample in samples if sample.get("removed")} == {trial["id"] for trial in gone}
    assert ask("task/reach/rpc/status")["eligible"] == COUNT - 10


def test_one_unknown_id_changes_nothing(ask: Ask, trials: list[dict[str, Any]]) -> None:
    before = ask("task/reach/rpc/status")["seq"]
    ids = [trials[0]["id"], UUID(int=2**100).bytes]
    for verb, message in (("recost", {"ids": ids, "costs": [0.9, 0.9]}), ("remove", {"ids": ids})):
        error = ask(f"task/reach/admin/{verb}", message)["error"]
        assert error["code"] == "INVALID"
        assert error["details"]["missing"] == [str(UUID(int=2**100))]
    assert ask("task/reach/rpc/status")["seq"] == before


def test_settings_change_for_the_next_prediction(ask: Ask, trials: list[dict[str, Any]]) -> None:
    reply = ask("task/reach/admin/configure", {"changes": {"budget": 5, "regularisation": 0.5}})
    assert (reply["spec"]["budget"], reply["spec"]["regularisation"]) == (5, 0.5)
    assert active(ask) == expected(trials, 5)
    [listed] = [t for t in ask("rpc/tasks")["tasks"] if t["spec"]["name"] == reply["spec"]["name"]]
    assert listed["spec"] == reply["spec"]


def test_a_fit_improves_the_evidence_and_is_logged(ask: Ask, trials: list[dict[str, Any]], numbers: Numbers) -> None:
    fit = ask("task/reach/admin/refit")
    assert fit["accepted"] is True
    assert fit["evidence_after"] > fit["evidence_before"]
    assert fit["seq"] == fit["model_version"] == COUNT + 2
    hyperparameters = ask("task/reach/rpc/status")["hyperparameters"]
    assert numbers(hyperparameters["lengthscales"]).tolist() == numbers(fit["lengthscales"]).tolist()
    assert hyperparameters["signal_variance"] == fit["signal_variance"]
    again = ask("task/reach/admin/refit")
    assert again["evidence_before"] == pytest.approx(fit["evidence_after"])


def test_new_settings_are_answered_with_the_fitted_numbers_that_stay_in_force(
    ask: Ask, trials: list[dict[str, Any]], numbers: Numbers
) -> None:
    fit = ask("task/reach/admin/refit")
    reply = ask("task/reach/admin/configure", {"changes": {"budget": 5}})
    assert [axis["lengthscale"] for axis in reply["spec"]["state"]] == [0.2, 0.4]
    assert numbers(reply["hyperparameters"]["lengthscales"]).tolist() == numbers(fit["lengthscales"]).tolist()
    assert reply["hyperparameters"]["signal_variance"] == fit["signal_variance"] != 1.0
    reply = ask("task/reach/admin/configure", {"changes": {"kernel": {"signal_variance": 3.0, "linear_weight": 0.5}}})
    assert (reply["hyperparameters"]["signal_variance"], reply["hyperparameters"]["linear_weight"]) == (3.0, 0.5)


def test_fits_come_by_themselves_where_the_settings_ask_for_them(
    ask: Ask, trials: list[dict[str, Any]], make_trial: MakeTrial, numbers: Numbers, processes: Processes
) -> None:
    ask("task/reach/admin/configure", {"changes": {"refit_every": 5, "budget": 40}})
    ask("task/reach/rpc/report", {"trials": [make_trial(COUNT + n) for n in range(5)], "wait": True})
    processes.wait_until(
        lambda: numbers(ask("task/reach/rpc/status")["hyperparameters"]["lengthscales"]).tolist() != [0.2, 0.4]
    )
    fits = ask("task/reach/rpc/status")["seq"] - (COUNT + 1 + 1 + 5)
    assert fits in (1, 2)  # one is due by the settings, one by the trials unless they come while the first runs


def test_an_archived_task_answers_reads_only(ask: Ask, trials: list[dict[str, Any]], make_trial: MakeTrial) -> None:
    assert ask("task/reach/admin/archive")["seq"] == COUNT + 2
    assert ask("task/reach/rpc/report", {"trials": [make_trial(99)]})["error"]["code"] == "INVALID"
    assert ask("task/reach/admin/remove", {"ids": [trials[0]["id"]]})["error"]["code"] == "INVALID"
    assert ask("task/reach/rpc/predict", {"states": [0.5, 0.0]})["active"] == 20
    assert len(ask("task/reach/rpc/samples")["samples"]) == COUNT
    assert ask("task/reach/rpc/status")["archived"] is True
