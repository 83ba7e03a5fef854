"""What a measured watch reports: the lag of pictures, and the growth of its memory."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from crkr.dashboard.measured_watch import Meter, growth
from crkr.dashboard.progress import Progress
from crkr.dashboard.telemetry import Telemetry
from crkr.protocol import StoredTrial

Make = Callable[..., StoredTrial]
Message = Callable[..., dict[str, Any]]


def test_a_lag_is_from_the_arrival_to_the_end_of_the_tick_that_drew_it(stored: Make, message: Message) -> None:
    arrivals, progress = {2: -1e9, 3: -2e9}, Progress()
    meter = Meter(None, arrivals)
    for seq in (2, 3):
        meter.picture(progress.add(stored(seq), 0.0), Telemetry.from_wire(message(seq)))
    assert not meter.lags
    meter.tick(0.0, progress)
    meter.tick(1.0, progress)
    assert list(meter.lags) == pytest.approx([1e9, 2e9], rel=1e-2)
    assert arrivals == {}


def test_growth_is_the_slope_of_the_late_part() -> None:
    sizes = [(float(second), 5e7 + 4e6 * min(second, 4) + 1000.0 * second, 50 * second) for second in range(16)]
    assert growth(sizes) == pytest.approx((1000.0, 20.0))
    assert np.isnan(growth(sizes[:2])).all()
