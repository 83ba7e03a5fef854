"""The figure of a demo."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any
from uuid import uuid4

import pytest
from matplotlib.figure import Figure

from crkr.protocol import StoredTrial, TaskSpec, Trial
from crkr.sim_worker.demo.learning_curve import draw_learning_curve
from crkr.sim_worker.evaluation.run_history import RunHistory

AXES = [{"name": "x", "unit": "m", "low": -1.0, "high": 1.0}]
SPEC = TaskSpec.from_dict({"name": "small", "state": AXES, "goal": AXES, "budget": 1})


def rows(filled_at: int | None) -> Iterator[dict[str, Any]]:
    """500 trials, judged every 50; the active set of one sample is full at some trial, or never."""
    if filled_at == 0:
        yield {"kind": "demonstration", "success": True}
    for trained in range(501):
        if trained:
            yield {"kind": "trial", "success": trained == filled_at}
        if trained % 50 == 0:
            strict = min(trained // 50 * 4, 40)
            for context in range(50):
                outcomes = {"paper": context < strict + 5, "strict": context < strict}
                info = {"epoch": trained // 50, "trained": trained, "outcomes": outcomes}
                yield {"kind": "evaluation", "success": outcomes["strict"], "info": info}


def history(filled_at: int | None) -> RunHistory:
    made = RunHistory(SPEC)
    for seq, row in enumerate(rows(filled_at), 2):
        made.add(StoredTrial(Trial.create(SPEC, id=uuid4(), state=[0.0], goal=[0.0], cost=0.5, **row), seq, 0.1 * seq))
    assert made.filled_at == filled_at
    return made


@pytest.mark.parametrize("filled_at", [None, 0, 100, 240, 260, 400, 500])
def test_labels_neither_overlap_nor_leave_the_figure(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, filled_at: int | None
) -> None:
    figures = []
    save = Figure.savefig

    def keep(figure: Figure, *args: Any, **options: Any) -> None:
        figures.append(figure)
        save(figure, *args, **options)

    monkeypatch.setattr(Figure, "savefig", keep)
    assert draw_learning_curve(history(filled_at), "reach, seed 0", 100, tmp_path / "curve.png")
    (figure,) = figures
    (axes,) = figure.axes
    (legend,) = figure.legends
    labels = [*axes.texts, legend, axes.title, axes.xaxis.label]
    assert len(axes.texts) == (filled_at is not None)
    boxes = [label.get_window_extent() for label in labels]
    assert not [(a, b) for n, a in enumerate(boxes) for b in boxes[:n] if a.overlaps(b)]
    for box in boxes:
        assert figure.bbox.x0 <= box.x0 < box.x1 <= figure.bbox.x1
        assert figure.bbox.y0 <= box.y0 < box.y1 <= figure.bbox.y1


def test_a_run_that_was_not_judged_has_no_figure(tmp_path: Path) -> None:
    assert not draw_learning_curve(RunHistory(SPEC), "reach", 100, tmp_path / "curve.png")
    assert not (tmp_path / "curve.png").exists()
