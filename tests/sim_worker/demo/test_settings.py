"""A demo names all extras that it lacks at once."""

import pytest

from crkr.protocol import Unsupported
from crkr.sim_worker.demo import settings


def test_nothing_is_missing_here() -> None:
    settings.check_extras(dashboard=True)


def test_one_line_names_all_missing_extras() -> None:
    packages = {"server": "no_such_a", "sim": "no_such_b", "dashboard": "no_such_c"}
    with pytest.raises(Unsupported, match=r"server, sim, dashboard: pip install 'crkr\[server,sim,dashboard\]'"):
        settings.check_extras(True, packages)
    with pytest.raises(Unsupported, match=r"server, sim: pip"):
        settings.check_extras(False, packages)


def test_a_missing_dashboard_alone_is_left_to_the_run() -> None:
    packages = {"server": "numpy", "sim": "numpy", "dashboard": "no_such_c"}
    settings.check_extras(True, packages)
