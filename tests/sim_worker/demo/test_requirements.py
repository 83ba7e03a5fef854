"""A demo names everything that it lacks, at once."""

import pytest

from crkr.protocol import Unsupported
from crkr.sim_worker.demo import requirements


def test_nothing_is_missing_here() -> None:
    requirements.check_equipment(dashboard=True)


def test_all_missing_extras_stand_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(requirements, "SIGNS", {"server": "no_such_a", "sim": "no_such_b", "dashboard": "no_such_c"})
    with pytest.raises(Unsupported, match=r"server, sim, dashboard: pip install 'crkr\[server,sim,dashboard\]'"):
        requirements.check_equipment(dashboard=True)
    with pytest.raises(Unsupported, match=r"server, sim: pip"):
        requirements.check_equipment(dashboard=False)


def test_a_missing_dashboard_alone_is_left_to_the_run(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(requirements, "SIGNS", {"server": "numpy", "sim": "numpy", "dashboard": "no_such_c"})
    requirements.check_equipment(dashboard=True)
