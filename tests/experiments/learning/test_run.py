"""Whole runs of learning: repeatable by seed, and unchanged by what is watched on the way."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from crkr.client.tally import Tally
from crkr.experiments.learning.many_runs import mean_interval, summarise
from crkr.experiments.learning.run import MARKS, Course, LearningRun, Score, learn_once
from crkr.sim_worker.skill import SkillOptions
from crkr.sim_worker.table_tennis import TableTennis

COURSE = Course(trials=40, contexts=30, judge=5, demonstrations=5)


@pytest.fixture(scope="module")
def analytic() -> TableTennis:
    return TableTennis(SkillOptions(environment="analytic"), traces=False)


def test_the_same_seed_gives_the_same_run_and_another_seed_another(analytic: TableTennis) -> None:
    first = learn_once(analytic, COURSE, 3)
    fresh = TableTennis(SkillOptions(environment="analytic"), traces=False)
    assert learn_once(fresh, COURSE, 3) == first  # digest of all trials included
    other = learn_once(analytic, COURSE, 4)
    assert (other.training, other.final) != (first.training, first.final)


def test_a_whole_run_in_contact_repeats_bitwise() -> None:
    course = Course(trials=60, contexts=1, judge=5, demonstrations=5)
    runs = [learn_once(TableTennis(SkillOptions(seed=9), traces=False), course, 9) for _ in range(2)]
    assert runs[0].digest == runs[1].digest
    assert runs[0].training == runs[1].training
    assert len(runs[0].training) > 1


def test_a_learning_curve_changes_nothing_else_in_a_run(analytic: TableTennis) -> None:
    plain = learn_once(analytic, COURSE, 3)
    watched = learn_once(analytic, replace(COURSE, marks=MARKS), 3)
    assert (watched.final, watched.training) == (plain.final, plain.training)
    assert watched.digest == plain.digest
    assert [score.trials for score in watched.curve] == [0, 25, 40]


def test_every_trial_and_every_context_is_counted_once(analytic: TableTennis) -> None:
    run = learn_once(analytic, COURSE, 3)
    assert sum(run.training.values()) == COURSE.trials
    assert sum(run.final.reasons.values()) == run.final.contexts == COURSE.contexts
    assert run.final.reasons["returned"] == run.final.tally.successes["strict"] <= run.final.tally.successes["paper"]


@pytest.mark.parametrize("launcher", ["nominal", "wide"])
def test_the_tuned_preset_learns_early(launcher: str) -> None:
    skill = TableTennis(SkillOptions(environment="analytic", launcher=launcher), traces=False)
    run = learn_once(skill, replace(COURSE, trials=200, contexts=100, marks=MARKS), 3)
    assert run.curve[0].tally.rate("strict") < 0.6  # by the five demonstrations alone
    assert run.final.tally.rate("strict") > {"nominal": 0.85, "wide": 0.6}[launcher]


def test_a_mean_comes_with_students_interval() -> None:
    rates = np.array([0.90, 0.97, 0.94, 0.99, 0.95])
    expected = stats.t.interval(0.95, 4, loc=rates.mean(), scale=stats.sem(rates))
    assert mean_interval(rates) == pytest.approx(expected)
    assert mean_interval(rates[:1]) is None
    assert mean_interval(np.array([0.2, 1.0])) == (0.0, 1.0)


def test_a_summary_names_the_worst_run() -> None:
    runs = [
        LearningRun(
            seed,
            Score(10, Tally(100, Counter(strict=100, paper=100), Counter(strict=won, paper=100)), {}),
            (),
            {},
            None,
            "",
        )
        for seed, won in [(7, 95), (8, 91), (9, 97)]
    ]
    summary = summarise(runs, "strict", 0.98)
    assert (summary.worst, summary.worst_seed, summary.oracle) == (0.91, 8, 0.98)
    assert summary.mean == pytest.approx(283 / 300)
