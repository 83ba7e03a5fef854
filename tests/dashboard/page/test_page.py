"""The page as a file: what it says, that nothing in it acts, and that a browser shows it offline."""

import json
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from uuid import UUID

import numpy as np
import pytest
from browser import Browser
from typer.testing import CliRunner, Result

from crkr.client import Client
from crkr.client.cli.subcommands import build
from crkr.dashboard.page.markup import html, number, tag
from crkr.protocol import TaskSpec

EVIL = "</title></script><img src=x onerror=owned=1><script>owned=1</script>\"'"
SPEC: dict[str, Any] = {
    "name": "hostile",
    "description": EVIL + " " + "\u202e\x1b[2J",
    "state": [
        {"name": EVIL[:60], "low": 0.0, "high": 1.0},
        {"name": "y<b>", "unit": EVIL[-20:], "low": 0.0, "high": 1.0},
    ],
    "goal": [{"name": "a&b", "low": -1.0, "high": 1.0}],
    "outcome": [{"name": "<svg onload=owned=1>", "target": 0.0, "tolerance": 0.1, "group": "g"}],
}
REACH = Path(__file__).parents[3] / "examples" / "reach.py"
Page = Callable[..., Result]


@pytest.fixture(scope="module")
def hostile(shared_endpoint: str) -> str:
    rng = np.random.default_rng(4)
    with Client(shared_endpoint, timeout_s=30.0) as client:
        client.wait_until_ready(60.0)
        task = client.create_task(TaskSpec.from_dict(SPEC))
        for trial in range(80):
            state, met = rng.uniform(size=2), bool(rng.uniform() < 0.5)
            info = {"reason": EVIL[:40] + str(trial % 3), "outcomes": {EVIL[:30]: met, "plain": not met}}
            task.report(
                state=state, goal=[0.1], cost=0.3, success=met, outcome=[0.05], info=info, worker=f"{EVIL}{trial % 2}"
            )
    return "hostile"


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The data directory of the server."""
    return tmp_path_factory.mktemp("server")


@pytest.fixture(scope="module")
def shared_endpoint(data: Path) -> Iterator[str]:
    from processes import shared_server

    with shared_server(data) as endpoint:
        yield endpoint


@pytest.fixture
def page(shared_endpoint: str) -> Page:
    def run(*words: str, status: int = 0) -> Result:
        arguments = ["page", *words, "--connect", shared_endpoint]
        result = CliRunner().invoke(build(arguments), arguments)
        assert result.exit_code == status, f"{result.stderr}\n{result.exception!r}"
        return result

    return run


@pytest.fixture
def browser(tmp_path: Path) -> Iterator[Browser]:
    with Browser(tmp_path / "profile") as opened:
        opened.size(1280, 900)
        yield opened


def test_text_and_attributes_are_escaped() -> None:
    text = html(tag("p", EVIL, tag("b", EVIL), title=EVIL))
    assert re.findall("<[^>]*>", text.replace(re.findall('title="[^"]*"', text)[0], "")) == [
        "<p >",
        "<b>",
        "</b>",
        "</p>",
    ]


@pytest.mark.parametrize(
    ("value", "text"), [(0.0, "0"), (-1500.0, "\u22121\u202f500"), (0.12345, "0.123"), (1e-7, "1e\u221207")]
)
def test_numbers_are_written_for_people(value: float, text: str) -> None:
    assert number(value) == text


def test_hostile_names_stay_text_in_a_browser(page: Page, hostile: str, browser: Browser, tmp_path: Path) -> None:
    file = tmp_path / "report.html"
    page(hostile, "--out", str(file))
    browser.offline()
    browser.open(file.as_uri())
    assert browser.complaints == []
    assert browser.run("typeof owned") == "undefined"
    assert browser.run("document.querySelectorAll('img, iframe, script:not([type])').length") == 2  # its own scripts
    text = browser.run("document.body.innerText")
    assert EVIL in text
    assert "\\x1b[2J" in text
    assert "\\u202e" in text


def test_a_page_says_what_was_learned_and_a_phone_shows_all_of_it(
    page: Page, hostile: str, browser: Browser, tmp_path: Path
) -> None:
    file = tmp_path / "report.html"
    page(hostile, "--out", str(file))
    browser.size(360, 740, phone=True, dark=True)
    browser.open(file.as_uri())
    assert browser.run("document.documentElement.scrollWidth") <= 360
    headings = browser.run("[...document.querySelectorAll('h2')].map((one) => one.textContent)")
    assert headings == [
        *("Success over trials", "How trials end", "Where it fails", "Measured outcomes", "Cost over trials"),
        *("Workers", "Settings"),
    ]
    assert "trials succeed" in browser.run("document.querySelector('.lead').textContent")
    browser.run(
        "(() => { const hit = document.querySelector('#success .hit'), box = hit.getBoundingClientRect();"
        " hit.dispatchEvent(new PointerEvent('pointerdown', {bubbles: true, clientX: box.x, clientY: box.y})); })()"
    )
    assert "plain: " in browser.run("document.getElementById('tip').textContent")


def test_an_existing_page_is_replaced_only_with_overwrite(page: Page, hostile: str, tmp_path: Path) -> None:
    file = tmp_path / "report.html"
    file.write_text("of yesterday")
    assert (
        page(hostile, "--out", str(file), status=1).stderr
        == f"error: {file} exists; choose another file, or --overwrite\n"
    )
    assert file.read_text() == "of yesterday"
    page(hostile, "--out", str(file), "--overwrite")
    assert "<h1>hostile" in file.read_text()


def test_an_unknown_task_leaves_no_file(page: Page, tmp_path: Path) -> None:
    assert "no task" in page("nowhere", "--out", str(tmp_path / "x.html"), status=1).stderr
    assert list(tmp_path.iterdir()) == []


def test_a_task_without_trials_has_a_page(page: Page, shared_endpoint: str, tmp_path: Path) -> None:
    with Client(shared_endpoint, timeout_s=30.0) as client:
        client.create_task(TaskSpec.from_dict({**SPEC, "name": "empty"}))
    page("empty", "--out", str(tmp_path / "empty.html"))
    assert "No training trial yet." in (tmp_path / "empty.html").read_text()


def test_a_skill_that_cannot_put_states_plays_fresh_trials(
    page: Page, shared_endpoint: str, browser: Browser, tmp_path: Path
) -> None:
    arguments = ["create", "--skill", f"{REACH}:make", "--connect", shared_endpoint]
    assert CliRunner().invoke(build(arguments), arguments).exit_code == 0
    with Client(shared_endpoint, timeout_s=30.0) as client:
        client.task("reach").report(
            state=[0.5, 0.0],
            goal=[-1.0, 2.0],
            cost=0.1,
            success=True,
            kind="demonstration",
            wait=True,
            outcome=[0.0, 0.0],
        )
    file = tmp_path / "reach.html"
    page("reach", "--skill", f"{REACH}:make", "--out", str(file))
    assert len(filmed(file)) == 2
    browser.open(file.as_uri())
    # Somewhere on each canvas a shape is drawn, and the clock goes on.
    painted = (
        "[...document.querySelectorAll('canvas.film')].every((one) => {"
        " const flat = document.createElement('canvas'); [flat.width, flat.height] = [one.width, one.height];"
        " const pen = flat.getContext('2d'); pen.drawImage(one, 0, 0);"
        " return pen.getImageData(0, 0, flat.width, flat.height).data.some((part) => part > 0); })"
    )
    browser.until(f"new Promise((done) => requestAnimationFrame(() => done({painted})))")
    browser.until("document.querySelector('[data-clock=\"0\"]').textContent !== '0.00 s'")
    browser.run("document.querySelector('[data-play=\"0\"]').click()")
    assert browser.run("document.querySelector('[data-play=\"0\"]').textContent") == "Play"
    assert browser.complaints == []


def test_the_film_shows_the_best_and_the_worst_stored_trial_again(
    page: Page, shared_endpoint: str, browser: Browser, tmp_path: Path, data: Path
) -> None:
    arguments = ["new", "thrower", "--in", str(tmp_path)]
    assert CliRunner().invoke(build(arguments), arguments).exit_code == 0
    skill = f"{tmp_path}/thrower.py:make"
    arguments = ["create", "--skill", skill, "--connect", shared_endpoint]
    assert CliRunner().invoke(build(arguments), arguments).exit_code == 0
    fields: dict[str, Any] = {"cost": 0.3, "success": True, "outcome": [0.0], "info": {"reason": "as stored"}}
    trials: list[dict[str, Any]] = [
        {"state": [2.0], "goal": [4.5, 0.7], "id": UUID(int=1)},
        {"state": [3.0], "goal": [9.0, 1.2], "id": UUID(int=2), "cost": 0.2},
        {"state": [2.5], "goal": [1.0, 0.3], "id": UUID(int=3), "cost": 0.9, "success": False},
        {"state": [2.5], "goal": [1.0, 0.3], "id": UUID(int=4), "cost": 1.0, "success": False},
        {"state": [2.5], "goal": [1.0, 0.4], "id": UUID(int=5), "cost": None, "success": False, "kind": "failed"},
    ]
    with Client(shared_endpoint, timeout_s=30.0) as client:
        task = client.task("thrower")
        for trial in trials:
            task.report(**{**fields, **trial, **({"outcome": None} if "kind" in trial else {})}, wait=True)
        task.remove([UUID(int=4)])
    file = tmp_path / "thrower.html"
    page("thrower", "--out", str(file))
    best, worst = filmed(file)
    assert best["poses"] != worst["poses"]
    browser.open(file.as_uri())
    captions = browser.run("[...document.querySelectorAll('#film figcaption')].map((one) => one.innerText)")
    assert [re.sub(r"\s+", " ", one) for one in captions] == [
        "Best trial success number 3 of the log, as stored, cost 0.2, now too far",
        "Worst trial failure number 4 of the log, as stored, cost 0.9",
    ]
    browser.run("document.getElementById('film').scrollIntoView()")  # what nobody sees does not move
    # A throw at 1 m/s lasts 0.06 s.
    browser.until("document.querySelector('[data-clock=\"1\"]').textContent.endsWith(' s, 50 times slower')")
    assert browser.complaints == []
    page("thrower", "--replay", str(data), "--out", str(tmp_path / "stored.html"))
    assert filmed(tmp_path / "stored.html") == [best, worst]


def filmed(file: Path) -> list[dict[str, Any]]:
    """The trials of a page's film."""
    data = re.search('<script type="application/json" id="film-data">(.*?)</script>', file.read_text())
    assert data is not None
    trials: list[dict[str, Any]] = json.loads(data[1])["trials"]
    return trials


def test_a_skill_of_another_size_is_refused(page: Page, hostile: str, tmp_path: Path) -> None:
    words = (hostile, "--skill", "table-tennis", "--out", str(tmp_path / "x.html"))
    assert "maps R^6 to R^13" in page(*words, status=1).stderr


def test_a_data_directory_gives_the_same_curves(page: Page, hostile: str, data: Path, tmp_path: Path) -> None:
    page(hostile, "--out", str(tmp_path / "live.html"))
    arguments = ["page", hostile, "--replay", str(data), "--out", str(tmp_path / "stored.html")]
    assert CliRunner().invoke(build(arguments), arguments).exit_code == 0
    chart = re.compile('<section id="success".*?</section>', re.DOTALL)
    live, stored = ((tmp_path / name).read_text() for name in ("live.html", "stored.html"))
    assert chart.findall(live) == chart.findall(stored) != []
