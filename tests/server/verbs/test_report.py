"""What a report promises: all or nothing, once, and only acknowledged when it is there."""

from collections.abc import Callable
from typing import Any

from processes import RunningServer

Ask = Callable[..., dict[str, Any]]
MakeTrial = Callable[..., dict[str, Any]]
REPORT = "task/reach/rpc/report"


def stored(ask: Ask) -> list[dict[str, Any]]:
    samples: list[dict[str, Any]] = ask("task/reach/rpc/samples", {"limit": 10_000})["samples"]
    return samples


def test_the_same_trials_again_are_duplicates_with_their_first_positions(ask: Ask, make_trial: MakeTrial) -> None:
    trials = [make_trial(number) for number in range(3)]
    first = ask(REPORT, {"trials": trials})
    again = ask(REPORT, {"trials": [*reversed(trials), make_trial(3)], "wait": True})
    assert first["seqs"] == [2, 3, 4]
    assert again == {"accepted": 1, "duplicates": 3, "seqs": [4, 3, 2, 5], "model_version": 5}
    assert len(stored(ask)) == 4


def test_the_first_reporter_stays(ask: Ask, make_trial: MakeTrial) -> None:
    ask(REPORT, {"trials": [make_trial(0, worker="ada", info={"n": 1}, model_version=1)]})
    assert ask(REPORT, {"trials": [make_trial(0, worker="eve", info={}, model_version=9)]})["duplicates"] == 1
    [sample] = stored(ask)
    assert (sample["worker"], sample["info"], sample["model_version"]) == ("ada", {"n": 1}, 1)


def test_a_known_id_with_other_content_is_a_conflict_and_stores_nothing_of_its_report(
    ask: Ask, make_trial: MakeTrial
) -> None:
    ask(REPORT, {"trials": [make_trial(0)]})
    for changes in ({"cost": 0.123}, {"success": False}, {"kind": "evaluation"}, {"goal": [0.0, 0.0, 0.0]}):
        error = ask(REPORT, {"trials": [make_trial(1), make_trial(0, **changes)]})["error"]
        assert error["code"] == "CONFLICT"
        assert error["details"]["seq"] == 2
    assert [sample["seq"] for sample in stored(ask)] == [2]


def test_one_invalid_trial_stores_nothing_of_its_report(ask: Ask, make_trial: MakeTrial) -> None:
    error = ask(REPORT, {"trials": [make_trial(0), make_trial(1, goal=[0.0, 0.0, 2.1])]})["error"]
    assert error["code"] == "INVALID"
    assert error["details"]["trial"] == 1
    assert stored(ask) == []


def test_a_trial_twice_in_one_report_is_stored_once(ask: Ask, make_trial: MakeTrial) -> None:
    receipt = ask(REPORT, {"trials": [make_trial(0), make_trial(0)]})
    assert (receipt["accepted"], receipt["duplicates"], receipt["seqs"]) == (1, 1, [2, 2])
    assert ask(REPORT, {"trials": [make_trial(1), make_trial(1, cost=0.5)]})["error"]["code"] == "CONFLICT"
    assert len(stored(ask)) == 1


def test_waiting_for_a_duplicate_waits_for_the_model_that_includes_it(ask: Ask, make_trial: MakeTrial) -> None:
    trials = [make_trial(number) for number in range(40)]
    ask(REPORT, {"trials": trials})
    assert ask(REPORT, {"trials": trials[-1:], "wait": True})["model_version"] == 41


def test_outcomes_are_kept_with_what_was_not_observed(connect: Callable[[str], Ask], server: RunningServer) -> None:
    ask = connect(server.endpoint)
    axis = {"name": "x", "unit": "m", "low": 0.0, "high": 1.0}
    outcome = [{"name": name, "unit": "m", "target": 0.0, "tolerance": 0.1, "group": "g"} for name in "ab"]
    spec = {"name": "reach", "state": [axis], "goal": [axis], "outcome": outcome, "exploration": {"type": "gaussian"}}
    assert ask("rpc/create_task", spec)["created"] is True
    trial = {"id": bytes(16), "state": [0.5], "goal": [0.5], "cost": 0.5, "success": False, "kind": "trial"}
    assert ask(REPORT, {"trials": [{**trial, "outcome": [0.25, None]}]})["accepted"] == 1
    assert ask(REPORT, {"trials": [{**trial, "outcome": [0.25, float("nan")]}]})["duplicates"] == 1
    assert ask(REPORT, {"trials": [{**trial, "outcome": [0.25, 0.0]}]})["error"]["code"] == "CONFLICT"
