"""What workers publish."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from crkr.protocol import Trace
from crkr.sim_worker.worker.telemetry import thinned


def trace(steps: int, rate_hz: float) -> Trace:
    time = np.arange(steps) / rate_hz
    path = np.column_stack([time, time**2, np.zeros(steps)])
    return Trace(time, ("ball",), path[:, None, :], np.tile([0.0, 0.0, 0.0, 1.0], (steps, 1, 1)), {"ball": path})


@given(st.integers(1, 2000), st.floats(5.0, 2000.0))
def test_a_trace_is_thinned_to_thirty_poses_a_second_and_keeps_its_ends(steps: int, rate_hz: float) -> None:
    full = trace(steps, rate_hz)
    thin = thinned(full)
    assert thin.time[0] == full.time[0]
    assert thin.time[-1] == full.time[-1]
    assert len(thin.time) <= 45.0 * full.time[-1] + 3
    assert set(thin.time) <= set(full.time)


def test_positions_and_paths_of_a_thinned_trace_belong_to_its_times() -> None:
    thin = thinned(trace(1000, 1000.0))
    np.testing.assert_array_equal(thin.positions[:, 0, 0], thin.time)
    np.testing.assert_array_equal(thin.paths["ball"][:, 1], thin.time**2)
    assert thin.quaternions.shape == (len(thin.time), 1, 4)


def test_a_trace_that_is_thin_enough_is_left_alone() -> None:
    full = trace(20, 30.0)
    assert thinned(full) is full
