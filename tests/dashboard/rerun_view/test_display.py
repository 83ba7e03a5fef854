import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from rerun.chunk import RrdReader

from crkr.client.tally import wilson_interval
from crkr.dashboard import Feed
from crkr.dashboard.poller import Update
from crkr.dashboard.rerun_view import Recording, RerunDisplay
from crkr.dashboard.rerun_view.curves import MAX_PHASES
from crkr.protocol import StoredTrial

Make = Callable[..., StoredTrial]
Message = Callable[..., dict[str, Any]]
Read = Callable[[Path], dict[str, list[Any]]]

STATUS = {
    "active": 4,
    "eligible": 6,
    "seq": 12,
    "latency_us": {"predict": {"p50": 200.0, "p99": 900.0}},
    "drift": {"restarts": 0, "last_seq": None, "score": 1.5},
    "advice": [{"code": "no_success", "message": "no success in 200 trials"}],
}


def column(batches: list[Any], name: str) -> list[Any]:
    rows = [row for batch in batches if name in batch.schema.names for row in batch.column(name).to_pylist()]
    return [row[0] if isinstance(row, list) else row for row in rows]


@pytest.fixture
def tables(recording: Recording, file: Path, read: Read, stored: Make, message: Message) -> dict[str, Any]:
    """A short run: four evaluation trials, eight training trials with their publications, four evaluation trials."""
    display = RerunDisplay(recording, "crane [1]")
    feed = Feed(display)
    display.task("Lift <loads>. Cost: how far they swing.")

    def ball(seq: int, epoch: int, hit: bool) -> StoredTrial:
        return stored(seq, "evaluation", info={"epoch": epoch, "outcomes": {"hit": hit}})

    def trial(seq: int) -> StoredTrial:
        hit = seq % 4 != 0
        info = {"reason": "lifted" if hit else "stuck | odd", "predicted": {"success": 0.5}}
        return stored(seq, cost=seq / 100, success=hit, info=info)

    feed.update(Update(trials=tuple(ball(seq, 0, seq > 2) for seq in range(1, 5))), 0.0)
    feed.step(0.0)
    feed.update(Update(trials=tuple(trial(seq) for seq in range(5, 13)), status=STATUS), 10.0)
    for seq in range(5, 13):
        feed.publication("trial", message(seq))
    feed.publication("trial", {"seq": 1})
    feed.step(10.0)
    feed.update(Update(trials=tuple(ball(seq, 1, True) for seq in range(13, 17))), 20.0)
    feed.step(20.0)
    display.finish(feed.progress)
    assert recording.close(5.0)
    return read(file)


def test_each_training_trial_is_a_point_of_its_cost_by_trial_and_epoch(tables: dict[str, Any]) -> None:
    good, bad = tables["/cost/success"], tables["/cost/failure"]
    assert column(good, "Scalars:scalars") == pytest.approx([0.05, 0.06, 0.07, 0.09, 0.10, 0.11])
    assert column(bad, "Scalars:scalars") == pytest.approx([0.08, 0.12])
    assert column(bad, "trial") == [4, 8]
    assert column(bad, "epoch") == [1, 1]


def test_the_learning_curve_has_a_point_and_a_wilson_band_for_each_evaluation(tables: dict[str, Any]) -> None:
    rate, band = tables["/evaluation/hit/rate"], tables["/evaluation/hit/interval"]
    assert column(rate, "Scalars:scalars") == [0.5, 1.0]
    assert column(rate, "epoch") == [0, 1]
    assert column(rate, "trial") == [0, 8]
    for successes, middle, variance in zip(
        (2, 4), column(band, "Measurements:values"), column(band, "Measurements:variances"), strict=True
    ):
        low, high = wilson_interval(successes, 4)
        assert middle - variance**0.5 == pytest.approx(low)
        assert middle + variance**0.5 == pytest.approx(high)


def test_running_means_follow_the_trials(tables: dict[str, Any]) -> None:
    assert column(tables["/reasons/lifted"], "Scalars:scalars")[-1] == 0.75
    assert column(tables["/training/success"], "Scalars:scalars")[-1] == 0.75
    assert column(tables["/cost/mean"], "Scalars:scalars")[-1] == pytest.approx(sum(range(5, 13)) / 800)


def test_predicted_and_observed_success_follow_the_trials(tables: dict[str, Any]) -> None:
    assert column(tables["/predictions/expected_success"], "Scalars:scalars") == [0.5] * 8
    assert column(tables["/predictions/observed_success"], "Scalars:scalars")[-1] == 0.75
    [*_, status] = column(tables["/status"], "TextDocument:text")
    assert "expected success **50 %**, observed success **75 %** (last 200)" in status
    assert "**Advice**: no success" in status
    assert column(tables["/drift/score"], "Scalars:scalars") == [1.5]


def test_widths_novelty_and_durations_come_from_the_publications(tables: dict[str, Any]) -> None:
    assert column(tables["/exploration/sigma"], "Scalars:scalars") == [0.4] * 8
    assert column(tables["/exploration/novelty_mean"], "Scalars:scalars") == [0.75] * 8
    assert column(tables["/latency/worker_execute"], "Scalars:scalars") == [20.0]


def test_the_learner_and_its_latency_come_from_the_status(tables: dict[str, Any]) -> None:
    assert column(tables["/learner/active"], "Scalars:scalars") == [4.0]
    assert column(tables["/learner/eligible"], "Scalars:scalars") == [6.0]
    assert column(tables["/latency/server_predict"], "Scalars:scalars") == pytest.approx([0.9])


def test_every_row_in_time_has_trial_and_epoch(tables: dict[str, Any]) -> None:
    for name, batches in tables.items():
        for batch in batches:
            timelines = {"trial", "epoch"} & set(batch.schema.names)
            assert timelines in (set(), {"trial", "epoch"}), name


def test_pages_show_numbers_and_no_foreign_markup(tables: dict[str, Any]) -> None:
    status, outcomes = (column(tables[f"/{name}"], "TextDocument:text")[-1] for name in ("status", "outcomes"))
    assert r"crane \[1\]" in status
    assert "hit **100 %**" in status
    assert r"| stuck \| odd | 2 | 25 % | 25 % |" in outcomes


def test_a_page_explains_the_panels_and_has_the_tasks_description(tables: dict[str, Any]) -> None:
    (guide,) = column(tables["/guide"], "TextDocument:text")
    assert guide.startswith(r"**crane \[1\]**: Lift \<loads\>. Cost: how far they swing.")
    assert "0 (best) to 1 (worst)" in guide


def test_every_page_in_the_layout_is_written(tables: dict[str, Any], file: Path) -> None:
    (layout,) = RrdReader(str(file)).blueprints()
    views = [
        batch
        for chunk in RrdReader(str(file)).stream(store=layout).to_chunks()
        if "ViewBlueprint:class_identifier" in (batch := chunk.to_record_batch()).schema.names
    ]
    classes, origins = (column(views, f"ViewBlueprint:{part}") for part in ("class_identifier", "space_origin"))
    pages = {origin for name, origin in zip(classes, origins, strict=True) if name == "TextDocument"}
    assert pages == {"/guide", "/outcomes", "/status"}
    assert pages <= set(tables)


def test_the_log_says_how_evaluations_went_and_what_was_skipped(tables: dict[str, Any]) -> None:
    lines = column(tables["/log"], "TextLog:text")
    assert any(line.startswith("epoch 0: hit 0.50 [") for line in lines)
    assert any(line.startswith("skipped 1 unreadable") for line in lines)


def test_the_layout_is_sent_before_any_data(
    recording: Recording, file: Path, in_order: Callable[[Path], list[str]], stored: Make
) -> None:
    feed = Feed(display := RerunDisplay(recording, "crane"))
    now = time.monotonic()
    feed.update(Update(trials=(stored(1),), status=STATUS), now)
    feed.step(now)
    display.finish(feed.progress)
    assert recording.close(5.0)
    assert [store.application_id for store in RrdReader(str(file)).blueprints()] == ["crkr"]
    paths = in_order(file)
    activated = paths.index("BlueprintActivationCommand")
    assert "/viewport" in paths[:activated]
    data = {"/cost/success", "/eye", "/learner/active", "/status", "/world"}
    assert data <= set(paths[activated:])
    assert not data & set(paths[:activated])
    assert paths.count("BlueprintActivationCommand") == 1  # another would undo what a viewer's user has changed


def test_durations_with_too_many_names_count_as_other(
    recording: Recording, file: Path, read: Read, stored: Make, message: Message
) -> None:
    display = RerunDisplay(recording, "crane")
    feed = Feed(display)
    feed.update(Update(trials=tuple(stored(seq) for seq in range(1, 60))), 0.0)
    for seq in range(1, 60):
        feed.publication("trial", message(seq, timing={f"step {seq}": 1.0, f"wait {seq}": 2.0}))
    feed.step(0.0)
    display.finish(feed.progress)
    assert recording.close(5.0)
    names = [path for path in read(file) if path.startswith("/latency/worker_")]
    assert len(names) == MAX_PHASES + 1
    assert "/latency/worker_other" in names
