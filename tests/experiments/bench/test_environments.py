import numpy as np
import pytest

from crkr.sim_worker.table_tennis.environments.bench_environments import bench_environments
from crkr.sim_worker.table_tennis.table_tennis import TableTennis


def test_a_bench_measures_every_environment_and_its_ratios(skill: TableTennis) -> None:
    shown = skill.demonstrations(3, np.random.default_rng(0))
    balls, goals = np.array([d.state for d in shown]), np.array([d.goal for d in shown])
    bench = bench_environments(balls, goals, batch=30)
    assert bench.trials == 3
    assert min(bench.contact_ms, bench.bare_ms, bench.hybrid_ms, bench.analytic_ms, bench.batch_us) > 0
    assert bench.contact_over_bare == pytest.approx(bench.contact_ms / bench.bare_ms)
    assert bench.hybrid_over_contact == pytest.approx(bench.hybrid_ms / bench.contact_ms)
    assert bench.batch_speedup == pytest.approx(1000 * bench.analytic_ms / bench.batch_us)
