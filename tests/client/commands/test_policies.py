"""Policies that are gone back to, written to files, and begun from another task's trials."""

import json
import re
import shlex
from collections.abc import Callable
from pathlib import Path
from typing import Any
from uuid import uuid4

import numpy as np
import onnxruntime
import pytest
from typer.testing import Result

from crkr.client import Client, Task
from crkr.client.trial_files import warm_start
from crkr.protocol import Invalid

Run = Callable[..., Result]
PAGE = (Path(__file__).parents[3] / "docs" / "policies.md").read_text()
FAR = """
name = "throw-far"
state = [{name = "distance", low = 0.0, high = 4.0}]
goal = [
  {name = "speed", low = 0.0, high = 3.0},
  {name = "angle", low = -1.0, high = 1.0},
  {name = "spin", low = -1.0, high = 1.0},
]
outcome = [{name = "miss", tolerance = 0.1}, {name = "height", tolerance = 0.1}]
"""


def taught(client: Client, name: str, count: int = 60, **settings: Any) -> Task:
    """A task whose goals lie on a curve, in log positions 2 to count + 1."""
    spec = {
        "name": name,
        "state": [{"name": "distance", "low": 0.0, "high": 4.0}],
        "goal": [{"name": "v", "low": 0.0, "high": 400.0}, {"name": "angle", "low": -1.0, "high": 1.0}],
        "outcome": [{"name": "miss", "tolerance": 0.1}],
        "exploration": {"type": "gaussian"},
        "budget": 40,
        **settings,
    }
    task, rng = client.create_task(spec), np.random.default_rng(0)
    states = rng.uniform(0, 4, (count, 1))
    goals = np.concatenate([100 * np.sqrt(states) + rng.normal(size=states.shape), np.sin(states)], axis=1)
    trials: dict[str, Any] = {"state": states, "goal": goals, "cost": rng.uniform(size=count), "success": True}
    task.report(**trials, outcome=rng.normal(size=(count, 1)), wait=True)
    return task


def test_the_page_about_policies_runs_as_it_is_printed(
    run: Run, shared_endpoint: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("throw-far.toml").write_text(FAR)
    [commands] = re.findall(r"```sh\n(.*?)```", PAGE, re.DOTALL)
    [program] = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    with Client(shared_endpoint, timeout_s=20.0) as client:
        task = taught(client, "throw")
        before = task.predict([[1.5]]).goals
        outputs = [run(*shlex.split(line, comments=True)[1:]).stdout for line in commands.splitlines()]
        assert Path("policy.onnx").stat().st_size > 1000
        np.testing.assert_allclose(task.predict([[1.5]]).goals, before, rtol=0, atol=1e-9)
        assert "60 trials of throw stored, 0 known already, 0 skipped" in outputs[-1]
        exec(compile(program, "policies.md", "exec"), {})
        said = capsys.readouterr().out.split()
        assert said[:2] == ["throw", "63"]
        far = client.task("throw-far")
        [stored] = far.trials(last=1)
        [original] = [one for one in task.iter_samples() if str(one.trial.id) == stored.trial.info["from"]["id"]]
        v, angle = original.trial.goal
        np.testing.assert_allclose(stored.trial.goal, [0.01 * v, angle, 0.0])
        np.testing.assert_array_equal(stored.trial.outcome, [*original.trial.outcome, np.nan])  # type: ignore[misc]  # there is one
        assert (stored.trial.cost, stored.trial.success) == (original.trial.cost, True)


@pytest.mark.parametrize(
    "settings", [{}, {"kernel": {"linear_weight": 0.3, "signal_variance": 2.0}, "cost_map": "odds", "budget": 7}]
)
def test_a_policys_file_says_what_the_server_says(
    run: Run, shared_endpoint: str, tmp_path: Path, settings: dict[str, Any]
) -> None:
    [program] = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    names: dict[str, Any] = {}
    exec(compile(program.partition("policy = ")[0], "policies.md", "exec"), names)
    with Client(shared_endpoint, timeout_s=20.0) as client:
        task = taught(client, f"file-{uuid4()}", **settings)
        task.refit()
        path = tmp_path / "policy.npz"
        assert "policy of version" in run("export", task.name, str(path), "--policy").stdout
        policy, states = names["Policy"](str(path)), np.linspace(-2, 7, 50)[:, None]
        answer = task.predict(states)
        np.testing.assert_allclose(policy(states), answer.goals, rtol=0, atol=1e-9 * 400)
        np.testing.assert_allclose(policy(states[7]), task.predict(states[7]).goal, rtol=0, atol=1e-9 * 400)
        assert (policy.of["version"], policy.of["task"]) == (answer.model_version, task.name)
        assert "exists" in run("export", task.name, str(path), "--policy", status=1).stderr
        run("export", task.name, str(path), "--policy", "--overwrite")
        run("export", task.name, str(tmp_path / "policy.onnx"), "--policy")
        session = onnxruntime.InferenceSession(tmp_path / "policy.onnx")
        np.testing.assert_allclose(session.run(["goals"], {"states": states})[0], answer.goals, rtol=0, atol=1e-9 * 400)
        told = session.get_modelmeta().custom_metadata_map
        assert (told["task"], told["version"]) == (task.name, str(answer.model_version))
        assert json.loads(told["goal_names"]) == ["v", "angle"]
        assert ".npz" in run("export", task.name, str(tmp_path / "policy.csv"), "--policy", status=1).stderr
        empty = client.create_task({**task.spec.to_dict(), "name": f"empty-{uuid4()}"})
        assert "no active sample" in run("export", empty.name, str(tmp_path / "e.npz"), "--policy", status=1).stderr


def test_a_warm_start_takes_what_fits_once(run: Run, shared_endpoint: str) -> None:
    with Client(shared_endpoint, timeout_s=20.0) as client:
        old = taught(client, f"old-{uuid4()}", 20)
        ids = [one.trial.id for one in old.iter_samples()]
        old.remove(ids[:2])
        old.amend(ids[2:4], kind="evaluation")
        old.amend(ids[4], success=False)
        old.amend(ids[5], kind="demonstration")
        goal = [{"name": "v", "low": 0.0, "high": 150.0}, {"name": "angle", "low": -1.0, "high": 1.0}]
        axis = {"name": "range", "low": 0.0, "high": 400.0}
        new = client.create_task({"name": f"new-{uuid4()}", "state": [axis], "goal": goal})
        outside = sum(one.trial.goal[0] > 150.0 for one in old.iter_samples() if one.trial.id not in ids[:4])
        assert 0 < outside < 16
        done = warm_start(new, old, {"state.range": "100 * state.distance"})
        assert (done.accepted, done.duplicates, done.skipped) == (16 - outside, 0, outside + 4)
        again = warm_start(new, old, {"state.range": "100 * state.distance"})
        assert (again.accepted, again.duplicates) == (0, 16 - outside)
        originals = {str(one.trial.id): one.trial for one in old.iter_samples()}
        for one in new.iter_samples():
            original = originals[one.trial.info["from"]["id"]]
            assert (one.trial.kind, one.trial.success) == (original.kind, original.success)
            assert one.trial.state[0] == 100 * original.state[0]
        other = {"state.range": "-1 * state.distance - 2.5"}
        for columns, says in (
            ({}, "state.range of task .* has no source"),
            ({"state.range": "state.nowhere"}, "cannot come from"),
            ({"state.range": "state.distance ** 2"}, "cannot come from"),
            ({"state.range": 1, "goal.wings": 0}, "no coordinate 'goal.wings'"),
        ):
            with pytest.raises(Invalid, match=says):
                warm_start(new, old, columns)
        words = ["--from", old.name, "--map", f"state.range={other['state.range']}"]
        target = client.create_task({**new.spec.to_dict(), "name": f"new-{uuid4()}"})
        run("warm-start", target.name, *words)
        stored = next(iter(target.iter_samples()))
        original = originals[stored.trial.info["from"]["id"]]
        assert stored.trial.state[0] == -original.state[0] - 2.5
        assert "NEW=OLD" in run("warm-start", target.name, "--from", old.name, "--map", "x", status=2).stderr
