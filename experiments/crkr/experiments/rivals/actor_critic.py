"""Deep reinforcement learning by Stable-Baselines3: one step an episode, actions are offsets from behaviour cloning."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final, final

import gymnasium
import numpy as np
import torch
from stable_baselines3 import PPO, SAC, TD3
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from crkr.experiments.rivals.rival import Offsets, cost_of
from crkr.protocol import Array, TaskSpec
from crkr.sim_worker.skill import Demonstration, TrialResult

__all__ = ["OnPolicy", "OneStepEpisodes", "proximal", "soft_actor_critic", "twin_delayed"]

REACH: Final = 2.0  # of an action of 1 [scales of the goal]
NOISE: Final = 0.1  # of TD3's actions
BATCH: Final = 256
STEPS: Final = 1  # of gradients, a trial
ROLLOUT: Final = 50  # trials before PPO updates its policy; of 25, 50 and 100 the best on seeds 40 to 42
LOG_SD: Final = -2.0  # of PPO's first actions; of 0, -1 and -2 the best on the same seeds


class _Spaces(gymnasium.Env[Any, Any]):
    """The spaces of states and offsets for an algorithm; it is never stepped."""

    def __init__(self, states: int, goals: int) -> None:
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (states,), np.float32)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (goals,), np.float32)


@final
class OneStepEpisodes:
    """An off-policy algorithm; the reward is the cost below zero, and every step is an episode's last."""

    def __init__(self, spec: TaskSpec, seed: int, algorithm: type[OffPolicyAlgorithm], **options: Any) -> None:
        torch.set_num_threads(1)
        spaces = _Spaces(len(spec.state), len(spec.goal))
        self._spec = spec
        self._model: Any = algorithm("MlpPolicy", spaces, seed=seed, device="cpu", buffer_size=100_000, **options)
        self._model.set_logger(Logger(None, []))
        self._noise = options.get("action_noise")

    def start(self, demonstrations: Sequence[Demonstration]) -> None:
        """Clones them, and keeps them as the first episodes."""
        self._policy = _OffsetPolicy(self._spec, demonstrations, self._model)
        for shown in demonstrations:
            self._keep(shown.state, shown.goal, shown.result)

    def ask(self, state: Array) -> Array:
        """A draw of SAC's policy, or TD3's action with noise."""
        noise = 0.0 if self._noise is None else self._noise()
        goal: Array = self._policy.goals(state[None, :], drawn=True, noise=noise)[0]
        return goal

    def tell(self, state: Array, goal: Array, result: TrialResult) -> None:
        """Keeps the episode, and takes steps of gradients."""
        self._keep(state, goal, result)
        self._model.train(gradient_steps=STEPS, batch_size=BATCH)

    def policy(self, states: Array) -> Array:
        """The policy's means."""
        return self._policy.goals(states)

    def _keep(self, state: Array, goal: Array, result: TrialResult) -> None:
        z, action = self._policy.observed(state), self._policy.action(state, goal)
        self._model.replay_buffer.add(z, z, action, np.array([-cost_of(result)]), np.array([True]), [{}])


@final
class OnPolicy:
    """PPO: it learns from the trials of its present policy alone; demonstrations only place that policy."""

    def __init__(self, spec: TaskSpec, seed: int) -> None:
        torch.set_num_threads(1)
        self._spec = spec
        self._model: Any = PPO(
            "MlpPolicy",
            _Spaces(len(spec.state), len(spec.goal)),
            seed=seed,
            device="cpu",
            n_steps=ROLLOUT,
            batch_size=ROLLOUT,
            policy_kwargs={"log_std_init": LOG_SD},
        )
        self._model.set_logger(Logger(None, []))

    def start(self, demonstrations: Sequence[Demonstration]) -> None:
        """Clones them."""
        self._policy = _OffsetPolicy(self._spec, demonstrations, self._model)

    def ask(self, state: Array) -> Array:
        """A draw of the policy."""
        goal: Array = self._policy.goals(state[None, :], drawn=True)[0]
        return goal

    def tell(self, state: Array, goal: Array, result: TrialResult) -> None:
        """Keeps the episode, and improves the policy when a rollout is whole."""
        z, action = self._policy.observed(state), self._policy.action(state, goal)
        rollout, network = self._model.rollout_buffer, self._model.policy
        with torch.no_grad():
            tensors = (torch.as_tensor(array, dtype=torch.float32) for array in (z, action))
            value, probability, _ = network.evaluate_actions(*tensors)
        rollout.add(z, action, np.array([-cost_of(result)]), np.array([1.0]), value, probability)
        if rollout.full:
            rollout.compute_returns_and_advantage(last_values=torch.zeros(1), dones=np.array([1.0]))
            self._model.train()
            rollout.reset()

    def policy(self, states: Array) -> Array:
        """The policy's means."""
        return self._policy.goals(states)


class _OffsetPolicy:
    """A network's actions in [-1, 1] as offsets from behaviour cloning."""

    def __init__(self, spec: TaskSpec, demonstrations: Sequence[Demonstration], model: Any) -> None:
        self._offsets, self._model = Offsets(spec, demonstrations), model

    def goals(self, states: Array, *, drawn: bool = False, noise: Array | float = 0.0) -> Array:
        """Goals (b, p) of the means of actions, or of draws, for states (b, d)."""
        z = self._offsets.scales.states(states).astype(np.float32)
        actions = np.asarray(self._model.predict(z, deterministic=not drawn)[0], np.float64) + noise
        return self._offsets.goals(states, REACH * np.clip(actions, -1.0, 1.0))

    def observed(self, state: Array) -> Array:
        """The network's input (1, d)."""
        scaled: Array = self._offsets.scales.states(state)[None, :]
        return scaled

    def action(self, state: Array, goal: Array) -> Array:
        """The action (1, p) whose goal this is."""
        action: Array = np.clip(self._offsets.of(state, goal) / REACH, -1.0, 1.0)[None, :]
        return action


def soft_actor_critic(spec: TaskSpec, seed: int) -> OneStepEpisodes:
    """SAC with its defaults; it explores by its own entropy."""
    return OneStepEpisodes(spec, seed, SAC)


def twin_delayed(spec: TaskSpec, seed: int) -> OneStepEpisodes:
    """TD3 with its defaults and Gaussian noise on actions."""
    np.random.seed(seed)  # noqa: NPY002 - Stable-Baselines3 draws action noise from the global generator
    count = len(spec.goal)
    return OneStepEpisodes(spec, seed, TD3, action_noise=NormalActionNoise(np.zeros(count), np.full(count, NOISE)))


def proximal(spec: TaskSpec, seed: int) -> OnPolicy:
    """PPO with short rollouts and little noise at first."""
    return OnPolicy(spec, seed)
