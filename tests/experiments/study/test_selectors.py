"""Each rule chooses what it says, checked against plain definitions."""

import numpy as np
import pytest
from typer import Typer
from typer.testing import CliRunner

from crkr.experiments.study.command import study
from crkr.experiments.study.selectors import RIVAL_SELECTORS
from crkr.protocol import Invalid


def chosen(name: str, Z: np.ndarray, costs: np.ndarray, budget: int) -> list[int]:
    selector = RIVAL_SELECTORS[name](Z.shape[1], budget)
    selector.extend(Z, costs)
    return [int(number) for number in selector.active]


@pytest.fixture
def samples() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(5)
    return rng.uniform(size=(60, 2)), rng.uniform(0.01, 1.0, size=60)


def test_recency_keeps_the_newest_and_lowest_cost_the_cheapest(samples: tuple[np.ndarray, np.ndarray]) -> None:
    Z, costs = samples
    assert chosen("recency", Z, costs, 8) == list(range(52, 60))
    assert set(chosen("lowest-cost", Z, costs, 8)) == {int(number) for number in np.argpartition(costs, 8)[:8]}


def test_a_reservoir_is_blind_to_costs_and_gives_every_sample_its_chance() -> None:
    counts = np.zeros(40)
    for seed in range(300):
        rng = np.random.default_rng(seed)
        Z = rng.uniform(size=(40, 2))
        first = chosen("reservoir", Z, rng.uniform(size=40), 10)
        assert chosen("reservoir", Z, rng.uniform(size=40), 10) == first
        counts[first] += 1
    assert abs(counts / 300 - 0.25).max() < 5 * np.sqrt(0.25 * 0.75 / 300)


def test_the_farthest_points_of_a_line_are_its_ends_and_its_middle() -> None:
    Z = np.array([0.0, 0.1, 0.2, 0.5, 0.9, 1.0])[:, None]
    assert chosen("farthest-point", Z, np.arange(6.0), 3) == [0, 3, 5]


def test_a_cover_keeps_its_samples_apart_and_leaves_out_only_what_a_cheaper_one_covers(
    samples: tuple[np.ndarray, np.ndarray],
) -> None:
    Z, costs = samples
    kept = chosen("cover", Z, costs, 12)
    apart = np.linalg.norm(Z[kept][:, None] - Z[kept][None], axis=2)
    radius = apart[np.triu_indices(len(kept), 1)].min()
    for number in set(range(60)) - set(kept):
        near = [one for one in kept if np.linalg.norm(Z[one] - Z[number]) <= radius]
        assert any(costs[one] <= costs[number] for one in near)


def test_information_gain_is_the_greedy_choice_by_dense_algebra(samples: tuple[np.ndarray, np.ndarray]) -> None:
    Z, costs = samples
    kernel = np.exp(-0.5 * ((Z[:, None] - Z[None]) ** 2).sum(axis=2))
    noise = costs + 1e-4
    greedy: list[int] = []
    for _ in range(6):
        if greedy:
            inner = np.linalg.inv(kernel[np.ix_(greedy, greedy)] + np.diag(noise[greedy]))
            variance = 1 - np.einsum("ij,jk,ik->i", kernel[:, greedy], inner, kernel[:, greedy])
        else:
            variance = np.ones(60)
        gain = variance / noise
        gain[greedy] = -1
        greedy.append(int(np.argmax(gain)))
    assert chosen("information-gain", Z, costs, 6) == sorted(greedy)


def test_dominated_novelty_is_the_mean_distance_from_three_better_ones(samples: tuple[np.ndarray, np.ndarray]) -> None:
    Z, costs = samples
    novelty = []
    for number in range(60):
        better = sorted(np.linalg.norm(Z[costs < costs[number]] - Z[number], axis=1))
        novelty.append(np.mean(better[:3]) if better else np.inf)
    assert set(chosen("dominated-novelty", Z, costs, 9)) == {int(one) for one in np.argsort(novelty)[-9:]}


def test_independence_drops_the_sample_that_the_others_determine_best(samples: tuple[np.ndarray, np.ndarray]) -> None:
    Z, costs = samples
    kernel = np.exp(-0.5 * ((Z[:, None] - Z[None]) ** 2).sum(axis=2)) + 1e-4 * np.eye(60)
    kept: list[int] = []
    for number in range(60):
        kept.append(number)
        if len(kept) > 8:
            left = []
            for one in kept:
                others = [other for other in kept if other != one]
                weights = np.linalg.solve(kernel[np.ix_(others, others)], kernel[others, one])
                left.append(kernel[one, one] - kernel[one, others] @ weights)
            del kept[int(np.argmin(left))]
    assert chosen("independence", Z, costs, 8) == kept
    assert chosen("independence", Z, costs[::-1], 8) == kept


def test_independence_goes_on_as_from_the_beginning(samples: tuple[np.ndarray, np.ndarray]) -> None:
    Z, costs = samples
    selector = RIVAL_SELECTORS["independence"](2, 8)
    for start in range(0, 60, 7):
        selector.extend(Z[start : start + 7], costs[start : start + 7])
        assert len(selector.active) == min(8, start + 7)
    assert selector.active.tolist() == chosen("independence", Z, costs, 8)


def test_splits_keep_the_cheapest_sample_of_every_cell() -> None:
    rng = np.random.default_rng(3)
    Z, costs = rng.permutation(64)[:, None] / 64.0, rng.uniform(size=64)
    eighths = np.floor(8 * Z[:, 0])
    best = [min(np.flatnonzero(eighths == cell), key=lambda row: costs[row]) for cell in range(8)]
    assert chosen("splits", Z, costs, 8) == sorted(int(row) for row in best)


def test_a_study_learns_by_each_selector_and_lists_those_that_there_are() -> None:
    app = Typer()
    app.command()(study)
    words = ["--seeds", "1", "--trials", "15", "--contexts", "5", "--jobs", "1", "--budget", "6"]
    done = CliRunner().invoke(app, [*words, "--only", "anms", "--only", "cover", "--only", "all-by-dtc"])
    assert done.exit_code == 0, done.output
    assert all(f"{name}, budget 6, lambda 1" in done.stdout for name in ("anms", "cover", "all-by-dtc"))
    error = CliRunner().invoke(app, ["--only", "best"]).exception
    assert isinstance(error, Invalid)
    assert "no selector 'best'; there are: anms, full, freeze, recency" in str(error)
