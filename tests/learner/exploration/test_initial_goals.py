"""Goals for a task of which nothing is known."""

from __future__ import annotations

from uuid import UUID

import numpy as np
from scipy.stats import qmc

from crkr.learner.exploration.draws import space_filling

LOW, HIGH = np.array([-1.0, 5.0, 0.0]), np.array([1.0, 9.0, 1e-3])


def goals(count: int) -> np.ndarray:
    return np.concatenate([space_filling(3, [UUID(int=number)], number, LOW, HIGH) for number in range(count)])


def test_goals_fill_the_box_more_evenly_than_chance() -> None:
    scaled = (goals(64) - LOW) / (HIGH - LOW)
    assert ((scaled >= 0) & (scaled <= 1)).all()
    chance = [qmc.discrepancy(np.random.default_rng(seed).uniform(size=(64, 3))) for seed in range(20)]
    assert qmc.discrepancy(scaled) < np.median(chance)


def test_a_question_repeated_gets_the_same_goal_and_another_trial_another() -> None:
    first, again = (space_filling(3, [UUID(int=1)], 7, LOW, HIGH) for _ in range(2))
    assert first.tobytes() == again.tobytes()
    others = {space_filling(3, [UUID(int=number)], 7, LOW, HIGH).tobytes() for number in range(40)}
    assert len(others) == 40


def test_many_trials_at_once_get_goals_of_their_own() -> None:
    found = space_filling(3, [UUID(int=number) for number in range(300)], 0, LOW, HIGH)
    assert len(np.unique(found, axis=0)) == 300


def test_the_end_of_the_sequence_and_its_start_after_it_can_be_asked_for() -> None:
    for tried in (1023, 1024, 10**12):
        found = space_filling(3, [UUID(int=1)], tried, LOW, HIGH)
        assert ((found >= LOW) & (found <= HIGH)).all()


def test_wide_boxes_do_not_overflow() -> None:
    found = space_filling(0, [UUID(int=5)], 2, np.array([-1.7e308]), np.array([1.7e308]))
    assert np.isfinite(found).all()
