"""A wish to stop, as signals bring it."""

import signal
import subprocess
import sys

import pytest

from crkr.client.cli.stop_request import SIGNALS, StopRequest


@pytest.mark.parametrize("number", SIGNALS)
def test_the_first_signal_is_remembered_and_handlers_come_back(number: signal.Signals) -> None:
    before = [signal.getsignal(each) for each in SIGNALS]
    with StopRequest() as stop:
        assert (bool(stop), stop.status) == (False, 0)
        signal.raise_signal(number)
        signal.raise_signal(signal.SIGTERM)
        assert (bool(stop), stop.signal, stop.status) == (True, number, 128 + number)
    assert [signal.getsignal(each) for each in SIGNALS] == before


@pytest.mark.parametrize(
    ("options", "sent", "status"),
    [
        ("", ["SIGINT", "SIGTERM"], 0),
        ("second_ends=True", ["SIGINT", "SIGTERM"], -signal.SIGTERM),
        ("second_ends=True", ["SIGHUP", "SIGHUP"], 0),
    ],
)
def test_a_second_signal_ends_the_process_only_where_that_is_asked_for(
    options: str, sent: list[str], status: int
) -> None:
    raised = "\n".join(f"    signal.raise_signal(signal.{name})" for name in sent)
    program = f"""
import signal
from crkr.client.cli.stop_request import StopRequest
with StopRequest({options}):
{raised}
"""
    assert subprocess.run([sys.executable, "-c", program], check=False, timeout=60).returncode == status


def test_a_hang_up_that_nohup_ignores_stays_ignored() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with StopRequest() as stop:
            signal.raise_signal(signal.SIGHUP)
            assert not stop
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)
