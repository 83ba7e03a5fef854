import io
import re
import subprocess
import sys
from collections.abc import Callable
from itertools import zip_longest
from typing import Any

import pytest
from rich.console import Console

from crkr.dashboard.feed import Feed
from crkr.dashboard.poller import Update
from crkr.dashboard.terminal import TerminalDisplay, sparkline
from crkr.protocol import StoredTrial

Make = Callable[..., StoredTrial]
STATUS = {
    "active": 17,
    "eligible": 40,
    "seq": 9,
    "advice": [{"code": "no_success", "message": "no success in 200 trials"}, "odd"],
    "workers": [{"id": "crane-1", "state": "alive", "open_trials": 1, "last_seen_s": 40.0}, "odd"],
    "latency_us": {"predict": {"p50": 250.0, "p99": 1500.0, "count": 3}, "odd": 4},
}


def shown(terminal: bool, updates: list[Update]) -> str:
    text = io.StringIO()
    console = Console(file=text, force_terminal=terminal, width=160, height=60, color_system=None)
    with TerminalDisplay(console, "crane") as display:
        feed = Feed(display)
        for number, piece in enumerate(updates):
            feed.update(piece, float(number))
            feed.step(float(number) * 10.0)
        display.finish(feed.progress)
    return text.getvalue()


@pytest.fixture
def run(stored: Make) -> list[Update]:
    def ball(seq: int, epoch: int, hit: bool) -> StoredTrial:
        return stored(seq, "evaluation", info={"epoch": epoch, "outcomes": {"hit": hit}})

    known = {"outcomes": {"hit": True}, "predicted": {"success": 0.25}}
    lifted = [stored(seq, info={"reason": "lifted", **known}) for seq in (3, 4, 5)]
    stuck = [stored(6, info={"reason": "stuck [bold]", "outcomes": {"hit": False}}, success=False)]
    return [
        Update(trials=(ball(1, 0, False), ball(2, 0, True))),
        Update(trials=(*lifted, *stuck)),
        Update(trials=(ball(7, 1, True), ball(8, 1, True))),
        Update(status=STATUS),
    ]


def test_a_terminal_shows_curve_reasons_workers_and_latency(run: list[Update]) -> None:
    text = shown(True, run)
    for expected in (
        "▅█",
        "50 %",
        "100 %",
        "lifted",
        "stuck [bold]",
        "75 %",
        "crane-1",
        "alive",
        "1.50 ms",
        "17 of 40",
        "advice: no success in 200 trials",
        "expected success",
        "25 %",
    ):
        assert expected in text


@pytest.mark.parametrize("width", [30, 60, 100])
def test_names_are_whole_however_narrow_the_terminal_is(stored: Make, width: int) -> None:
    name = "".join(f"{letter}{number}" for letter in "abcdefgh" for number in range(7))
    status = {**STATUS, "workers": [{"id": name, "state": "alive", "open_trials": 1, "last_seen_s": 1.0}]}
    console = Console(width=width, height=200, color_system=None)
    display = TerminalDisplay(console, "crane")
    feed = Feed(display)
    feed.update(Update(trials=(stored(1, worker=name, info={"reason": "r" + name[:40]}),), status=status), 1.0)
    feed.step(2.0)
    with console.capture() as seen:
        console.print(display.page(feed.progress, 2.0))
    lines = [[cell.strip() for cell in line.split("│")] for line in seen.get().splitlines()]
    columns = ["".join(cells) for cells in zip_longest(*lines, fillvalue="")]
    assert any(name in column for column in columns)
    assert "…" not in seen.get()


def test_silence_grows_while_the_server_does_not_answer(stored: Make) -> None:
    console = Console(width=160, color_system=None)
    display = TerminalDisplay(console, "crane")
    feed = Feed(display)
    feed.update(Update(trials=(stored(1),), status=STATUS), 1000.0)
    feed.step(1001.0)
    with console.capture() as seen:
        console.print(display.page(feed.progress, 1002.0))
        console.print(display.page(feed.progress, 1020.0))
    assert re.findall(r"crane-1 .*?(\d+) s", seen.get()) == ["42", "60"]


def test_a_terminal_shows_the_tasks_description() -> None:
    text = io.StringIO()
    console = Console(file=text, force_terminal=True, width=40, height=60, color_system=None, soft_wrap=True)
    with TerminalDisplay(console, "crane") as display:
        display.task("Lift [bold] loads. Cost: how far they swing, and no more than that.")
        display.finish(Feed(display).progress)
    words = " ".join(text.getvalue().replace("│", " ").split())
    assert "Lift [bold] loads. Cost: how far they swing, and no more than that." in words


def test_without_a_terminal_there_are_plain_lines(run: list[Update]) -> None:
    text = shown(False, run)
    assert "\x1b" not in text
    assert "epoch 1: hit 1.00 of 2 evaluation trials" in text.splitlines()
    assert any("training trials 4 " in line and "active 17 of 40 samples" in line for line in text.splitlines())


def test_a_run_without_trials_can_be_shown() -> None:
    assert "trials 0" in shown(True, [Update(status={})])
    assert "trials 0" in shown(False, [Update(status={"workers": 3, "latency_us": []})])


@pytest.mark.parametrize(("shares", "bars"), [([], ""), ([0.0, 0.5, 1.0], "▁▅█"), ([-1.0, 2.0], "▁█")])
def test_a_sparkline_has_a_bar_for_each_share(shares: list[float], bars: str) -> None:
    assert sparkline(shares) == bars


def test_a_sparkline_keeps_the_newest() -> None:
    assert sparkline([0.0] * 10 + [1.0] * 3, width=3) == "███"


def test_terminal_imports_no_rerun() -> None:
    program = "import crkr.dashboard.terminal, crkr.dashboard.command, sys; sys.exit('rerun' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", program], check=False).returncode == 0


def test_odd_status_fields_do_no_harm(run: list[Update]) -> None:
    odd: dict[str, Any] = {
        "active": "many",
        "workers": [{"id": 3, "last_seen": "never"}],
        "latency_us": {"a": {"p50": "x"}},
    }
    assert "many" in shown(True, [*run, Update(status=odd)])
