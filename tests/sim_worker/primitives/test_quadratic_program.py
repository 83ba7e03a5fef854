from __future__ import annotations

import numpy as np

from crkr.sim_worker.primitives.quadratic_program import InteriorPoint, StrokeProgram, Unsolved

N, HIT = 45, 25


def test_a_solver_that_fails_says_so_and_serves_the_next_goal() -> None:
    program = StrokeProgram(N, HIT, 20.0)
    solver = InteriorPoint(program)
    targets, bound = np.array([0.2, 0.01, 0.0]), np.repeat([0.012, 0.05, 5.0, 5.0], N)
    before = solver.solve(np.zeros(N), targets, -bound, bound, 0.012)
    assert solver.solve(np.zeros(N), np.array([np.nan, 0.0, 0.0]), -bound, bound, 0.012) is Unsolved.FAILED
    assert solver.solve(np.zeros(N), np.array([20.0, 0.0, 0.0]), -bound, bound, 0.012) is Unsolved.INFEASIBLE
    after = solver.solve(np.zeros(N), targets, -bound, bound, 0.012)
    assert not isinstance(before, Unsolved)
    assert not isinstance(after, Unsolved)
    np.testing.assert_array_equal(before, after)
