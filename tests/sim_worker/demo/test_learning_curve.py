"""The figure of a demo."""

from collections import Counter
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from matplotlib.figure import Figure

from crkr.client.tally import Tally
from crkr.sim_worker.demo.learning_curve import draw_learning_curve
from crkr.sim_worker.evaluation.run_history import EpochScore


def history(filled_at: int | None) -> Any:
    """A run of 500 trials, judged every 50, whose active set was full at some trial."""
    epochs = [
        EpochScore(epoch, 50 * epoch, Tally(50, Counter(paper=50, strict=50), Counter(paper=met + 5, strict=met)))
        for epoch, met in enumerate(range(0, 44, 4))
    ]
    return SimpleNamespace(epochs=epochs, filled_at=filled_at)


@pytest.mark.parametrize("filled_at", [None, 0, 100, 240, 260, 400, 500])
def test_no_words_lie_on_one_another_or_outside(
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
    assert not draw_learning_curve(SimpleNamespace(epochs=[], filled_at=None), "reach", 100, tmp_path / "curve.png")  # type: ignore[arg-type]  # the part that is asked for
    assert not (tmp_path / "curve.png").exists()
