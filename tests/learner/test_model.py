from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from uuid import uuid4

import numpy as np
import pytest

from crkr.learner import Learner, Model
from crkr.protocol import Array, Invalid, NoSamples, TaskSpec, pack, unpack

MakeSpec = Callable[..., TaskSpec]


def taught(spec: TaskSpec, count: int = 40) -> Learner:
    rng = np.random.default_rng(1)
    learner = Learner(spec)
    learner.report(
        state=rng.uniform(-2, 2, (count, 2)),
        goal=rng.uniform(-1, 1, (count, 2)),
        cost=rng.uniform(size=count),
        success=True,
        kind="demonstration",
    )
    return learner


def arrays(model: Model) -> list[Array]:
    regression, own = model.regression, model.parameters
    assert regression is not None
    return [
        model.states,
        model.goals,
        model.costs,
        regression.Z,
        regression.L,
        regression.W,
        regression.noise,
        own.prior,
        own.scales,
        own.low,
        own.high,
        own.kernel.centre,
        own.kernel.lengthscales,
    ]


def test_every_array_of_a_model_is_read_only(make_spec: MakeSpec) -> None:
    learner = taught(make_spec())
    learner.refit()
    for array in arrays(learner.model):
        with pytest.raises(ValueError, match="read-only"):
            array.flat[0] = 7.0


def test_a_model_answers_the_same_after_the_learner_has_moved_on(make_spec: MakeSpec) -> None:
    learner = taught(make_spec(budget=20))
    model, states, ids = learner.model, np.random.default_rng(2).uniform(-2, 2, (30, 2)), [uuid4() for _ in range(30)]
    before = model.predict(states, True, ids)
    learner.report(state=states, goal=np.zeros((30, 2)), cost=np.zeros(30), success=True)
    learner.recost(learner.active_ids[:5], np.full(5, 0.9))
    learner.configure({"budget": 5, "regularisation": 9.0})
    learner.refit()
    assert model.predict(states, True, ids).goals.tobytes() == before.goals.tobytes()
    assert learner.model.predict(states, True, ids).goals.tobytes() != before.goals.tobytes()


def test_threads_may_predict_while_learning_goes_on(make_spec: MakeSpec) -> None:
    learner = taught(make_spec(budget=20))
    states = np.random.default_rng(3).uniform(-2, 2, (50, 2))

    def ask(model: Model) -> tuple[int, bytes]:
        return model.version, model.predict(states).means.tobytes()

    with ThreadPoolExecutor(2) as pool:
        models, answers = [], []
        for state in states:
            models.append(learner.model)
            answers.append(pool.submit(ask, learner.model))
            learner.report(state=state, goal=[0.0, 0.0], cost=0.01, success=True)
    assert [answer.result() for answer in answers] == [ask(model) for model in models]


def test_a_model_rebuilt_from_its_message_answers_with_the_same_bits(make_spec: MakeSpec) -> None:
    learner = taught(make_spec(kernel={"linear_weight": 0.3}, cost_map="odds", novel="refuse", novelty_limit=1.0))
    learner.refit()
    rebuilt = Model.from_wire(unpack(pack(learner.model.to_wire())))
    states, ids = np.random.default_rng(4).uniform(-3, 3, (20, 2)), [uuid4() for _ in range(20)]
    ours, theirs = learner.model.predict(states, True, ids), rebuilt.predict(states, True, ids)
    for name in ("goals", "means", "sigmas", "novelty"):
        assert getattr(ours, name).tobytes() == getattr(theirs, name).tobytes()
    assert (theirs.model_version, theirs.active, theirs.trial_ids) == (ours.model_version, ours.active, ids)
    assert rebuilt.ids == learner.model.ids


def test_an_empty_model_travels_too(make_spec: MakeSpec) -> None:
    rebuilt = Model.from_wire(unpack(pack(Learner(make_spec()).model.to_wire())))
    assert rebuilt.active == 0
    with pytest.raises(NoSamples):
        rebuilt.predict([0.0, 0.0])


@pytest.mark.parametrize("field", ["states", "ids", "kernel", "noise", "version", "bounds"])
def test_a_message_that_lacks_a_field_is_refused(make_spec: MakeSpec, field: str) -> None:
    message = taught(make_spec()).model.to_wire()
    del message[field]
    with pytest.raises(Invalid, match="as `model` returns"):
        Model.from_wire(message)


def test_a_message_whose_sizes_disagree_is_refused(make_spec: MakeSpec) -> None:
    message = taught(make_spec()).model.to_wire()
    message["costs"] = message["costs"][:-1]
    with pytest.raises(Invalid, match=r"costs must have shape \(40,\); got \(39,\)"):
        Model.from_wire(message)


def test_one_state_and_a_batch_agree(make_spec: MakeSpec) -> None:
    model = taught(make_spec()).model
    states, ids = np.random.default_rng(5).uniform(-2, 2, (600, 2)), [uuid4() for _ in range(600)]
    batch = model.predict(states, True, ids)
    for index in (0, 1, 127, 128, 599):
        one = model.predict(states[index], True, ids[index])
        assert one.goal.shape == (2,)
        assert one.novelty.shape == ()
        np.testing.assert_allclose(one.goal, batch.goals[index], rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(one.novelty, batch.novelty[index], rtol=1e-9, atol=1e-12)
        assert one.trial_ids == [ids[index]]


def test_exploring_needs_ids_and_repeats_with_them(make_spec: MakeSpec) -> None:
    model, trial = taught(make_spec()).model, uuid4()
    with pytest.raises(Invalid, match="trial_ids are required to explore"):
        model.predict([0.0, 0.0], explore=True)
    first = model.predict([0.0, 0.0], True, trial)
    assert first.policy == "explore"
    assert model.predict([0.0, 0.0], True, trial.bytes).goal.tobytes() == first.goal.tobytes()
    assert model.predict([0.0, 0.0], True, uuid4()).goal.tobytes() != first.goal.tobytes()


def test_without_exploring_goals_are_the_means_clipped_to_the_bounds(make_spec: MakeSpec) -> None:
    learner = Learner(make_spec(prior_mean="zero", kernel={"linear_weight": 5.0}))
    learner.report(state=[[1, 0], [-1, 0]], goal=[[1.0, 0], [-1.0, 0]], cost=[0, 0], success=True)
    answer = learner.predict([[5.0, 0.0]])
    assert answer.means[0, 0] > 1.0
    np.testing.assert_array_equal(answer.goals, np.clip(answer.means, -1, 1))
    assert answer.policy == "mean"


def test_a_model_tells_the_chances_of_its_moment_whenever_it_is_asked(make_spec: MakeSpec) -> None:
    state, ids = np.array([0.3, -0.2]), [uuid4() for _ in range(30)]
    hit = {"cost": 0.5, "success": True, "learn": None, "kind": "trial", "outcome": None, "removed": False}

    def chances(*, at_once: bool) -> list[float]:
        """After misses, after one of them turned out a hit, and once ten are removed."""
        learner = taught(make_spec())
        learner.report(state=np.zeros((30, 2)), goal=np.zeros((30, 2)), cost=0.5, success=False, id=ids)
        models = [learner.model]
        for change in (
            partial(learner.apply_amend, learner.version + 1, ids[:1], [hit]),
            partial(learner.remove, ids[1:11]),
        ):
            if at_once:
                models[-1].predict(state)
            change()
            models.append(learner.model)
        return [float(np.asarray(model.predict(state).success_probability)) for model in models]

    found = chances(at_once=False)
    assert found == chances(at_once=True)
    assert found == sorted(set(found))


def test_nothing_is_said_of_success_far_from_all_samples(make_spec: MakeSpec) -> None:
    learner = taught(make_spec())
    learner.report(state=[0.1, 0.1], goal=[0.0, 0.0], cost=0.4, success=True)
    one, several = learner.predict([50.0, 0.0]), learner.predict([[0.0, 0.0], [50.0, 0.0]])
    assert one.novelty > 0.99
    assert one.success_probability is not None
    assert several.success_probability is not None
    np.testing.assert_array_equal(np.isnan(one.success_probability), True)
    np.testing.assert_array_equal(np.isnan(several.success_probability), [False, True])
