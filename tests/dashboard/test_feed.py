from collections.abc import Callable, Mapping, Sequence
from typing import Any

import pytest

from crkr.dashboard import EpochResult, Feed, Progress, Row, Telemetry
from crkr.dashboard.feed import MAX_WAITING
from crkr.dashboard.poller import Update
from crkr.protocol import Internal, StoredTrial, Unavailable

Make = Callable[..., StoredTrial]
Message = Callable[..., dict[str, Any]]


class Notebook:
    """A view that writes down what it is told."""

    def __init__(self) -> None:
        self.seqs: list[int] = []
        self.pictures: list[tuple[int, int]] = []
        self.epochs: list[int] = []
        self.statuses: list[Mapping[str, Any]] = []
        self.lines: list[str] = []
        self.warned: list[bool] = []
        self.ticks: list[float] = []
        self.progress: Progress | None = None

    def task(self, description: str) -> None:
        self.lines.append(description)

    def trials(self, rows: Sequence[Row], progress: Progress) -> None:
        self.seqs += [row.seq for row in rows]
        self.progress = progress

    def picture(self, row: Row, telemetry: Telemetry) -> None:
        self.pictures.append((row.seq, telemetry.seq))

    def epoch(self, result: EpochResult, progress: Progress) -> None:
        self.epochs.append(result.epoch)
        self.progress = progress

    def status(self, status: Mapping[str, Any], progress: Progress, now: float) -> None:
        del now  # whatever the test says
        self.statuses.append(status)
        self.progress = progress

    def say(self, message: str, *, warning: bool = False) -> None:
        self.lines.append(message)
        self.warned.append(warning)

    def tick(self, now: float, progress: Progress) -> None:
        self.ticks.append(now)
        self.progress = progress


@pytest.fixture
def notebook() -> Notebook:
    return Notebook()


@pytest.fixture
def feed(notebook: Notebook) -> Feed:
    return Feed(notebook)


def test_an_evaluation_that_waits_for_more_trials_is_shown_at_the_end(
    feed: Feed, notebook: Notebook, stored: Make
) -> None:
    feed.update(Update(trials=tuple(stored(seq, "evaluation", info={"epoch": 0}) for seq in (1, 2))), 0.0)
    feed.step(0.0)
    assert notebook.epochs == []
    feed.finish()
    feed.finish()
    assert notebook.epochs == [0]


def test_a_picture_waits_until_the_log_has_its_trial(
    feed: Feed, notebook: Notebook, stored: Make, message: Message
) -> None:
    feed.publication("trial", message(2))
    feed.update(Update(trials=(stored(1),)), 0.0)
    feed.step(0.0)
    assert notebook.pictures == []
    feed.update(Update(trials=(stored(2),)), 0.5)
    feed.step(0.5)
    feed.step(0.6)
    assert notebook.pictures == [(2, 2)]
    assert notebook.seqs == [1, 2]


def test_trials_are_shown_when_every_publication_is_lost(feed: Feed, notebook: Notebook, stored: Make) -> None:
    feed.update(Update(trials=tuple(stored(seq) for seq in range(1, 100))), 0.0)
    feed.step(0.0)
    assert notebook.seqs == list(range(1, 100))


def test_a_picture_of_a_trial_that_the_log_does_not_have_is_dropped_and_counted(
    feed: Feed, notebook: Notebook, stored: Make, message: Message
) -> None:
    feed.publication("trial", message(2))
    feed.update(Update(trials=(stored(1), stored(3))), 0.0)
    feed.step(0.0)
    assert notebook.pictures == []
    assert feed.dropped == 1


def test_pictures_do_not_pile_up_while_the_log_is_silent(feed: Feed, message: Message) -> None:
    for seq in range(MAX_WAITING + 5):
        feed.publication("trial", message(seq, trace=None, scene=None))
    assert feed.dropped == 5


def test_unreadable_publications_are_counted_and_the_first_ones_named(
    feed: Feed, notebook: Notebook, message: Message
) -> None:
    for _ in range(50):
        feed.publication("trial", message(1, worker=None))
    feed.publication("evaluation", {})
    assert feed.skipped == 51
    assert len(notebook.lines) == 3
    assert "worker" in notebook.lines[0]


def test_refused_goals_are_counted_and_shown_without_a_trial_in_the_log(
    feed: Feed, notebook: Notebook, message: Message
) -> None:
    refused = message(1, kind="failed")
    del refused["seq"]
    for _ in range(5):
        feed.publication("trial", refused)
    assert (feed.refused, feed.skipped) == (5, 0)
    assert len(notebook.lines) == 3
    assert "refused a goal" in notebook.lines[0]


def test_notices_of_the_model_are_no_pictures(feed: Feed) -> None:
    feed.publication("model", {"version": 3})
    assert feed.skipped == 0


def test_the_loss_and_the_return_of_a_server_are_each_shown_once(feed: Feed, notebook: Notebook, stored: Make) -> None:
    for _ in range(3):
        feed.update(Update(lost=Unavailable("no answer")), 0.0)
    feed.update(Update(trials=(stored(1),)), 1.0)
    feed.update(Update(trials=(stored(2),)), 2.0)
    assert notebook.lines == ["the server does not answer; waiting for it", "the server answers again"]
    assert notebook.warned == [True, False]


def test_an_error_of_the_server_is_shown_as_it_is(feed: Feed, notebook: Notebook) -> None:
    feed.update(Update(lost=Internal("a page is missing")), 0.0)
    assert notebook.lines == ["INTERNAL: a page is missing"]


def test_a_log_that_became_shorter_gives_a_warning(feed: Feed, notebook: Notebook, stored: Make) -> None:
    feed.update(Update(trials=(stored(9),)), 0.0)
    for _ in range(2):
        feed.update(Update(status={"seq": 3}), 0.0)
    assert len(notebook.lines) == 1
    assert "ends at 3" in notebook.lines[0]


def test_a_finished_evaluation_is_shown_once(feed: Feed, notebook: Notebook, stored: Make) -> None:
    feed.update(Update(trials=(stored(1, "evaluation", info={"epoch": 0}),)), 0.0)
    for now in (1.0, 10.0, 20.0):
        feed.step(now)
    assert notebook.epochs == [0]
    assert notebook.ticks == [1.0, 10.0, 20.0]
    assert notebook.progress is feed.progress


def test_the_picture_of_the_worker_in_the_log_has_precedence(stored: Make, message: Message) -> None:
    class Named(Notebook):
        def picture(self, row: Row, telemetry: Telemetry) -> None:
            super().picture(row, telemetry)
            self.lines.append(telemetry.worker)

    view = Named()
    feed = Feed(view)
    for number in range(20):
        feed.publication("trial", message(1, worker=f"made-up-{number}"))
    feed.publication("trial", message(1))
    feed.publication("trial", message(2, worker="another"))
    feed.update(Update(trials=(stored(1), stored(2))), 0.0)
    feed.step(0.0)
    assert view.lines == ["crane-1", "another"]
    assert feed.dropped == 20


def test_a_trial_is_shown_once_however_often_it_is_published(
    feed: Feed, notebook: Notebook, stored: Make, message: Message
) -> None:
    feed.update(Update(trials=(stored(1),)), 0.0)
    for now in range(5):
        feed.publication("trial", message(1))
        feed.step(float(now))
    assert notebook.pictures == [(1, 1)]
    assert feed.dropped == 4


def test_a_publication_that_breaks_the_view_is_counted_and_the_next_is_shown(stored: Make, message: Message) -> None:
    class Brittle(Notebook):
        def picture(self, row: Row, telemetry: Telemetry) -> None:
            if row.seq == 1:
                raise RecursionError("too deep")
            super().picture(row, telemetry)

        def tick(self, now: float, progress: Progress) -> None:
            if now < 1.0:
                raise OverflowError("too large")
            super().tick(now, progress)

    view = Brittle()
    feed = Feed(view)
    feed.update(Update(trials=(stored(1), stored(2))), 0.0)
    for seq in (1, 2):
        feed.publication("trial", message(seq))
    feed.step(0.0)
    feed.step(1.0)
    assert view.pictures == [(2, 2)]
    assert feed.skipped == 2
    assert [word for word in ("too deep", "too large") if word not in " ".join(view.lines)] == []


def test_a_message_nested_too_deep_is_counted(feed: Feed, message: Message) -> None:
    nested: Any = 0
    for _ in range(100_000):
        nested = [nested]
    for field in ("trace", "scene", "timing", "sigma_mean", "worker"):
        feed.publication("trial", message(1, **{field: nested}))
    refused = message(1, kind="failed", worker=nested)
    del refused["seq"]
    feed.publication("trial", refused)
    assert feed.skipped == 6
    while isinstance(nested, list):  # unmade step by step: an interpreter may unmake it by recursion
        nested = nested[0]
