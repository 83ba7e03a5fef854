"""Deep reinforcement learning by Stable-Baselines3: one step an episode, actions are offsets from behaviour cloning."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final, final

import gymnasium
import numpy as np
import torch
from stable_baselines3 import SAC, TD3
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from crkr.experiments.rivals.rival import Offsets, cost_of
from crkr.protocol import Array, TaskSpec
from crkr.sim_worker.skill import Demonstration, TrialResult

__all__ = ["OneStepEpisodes", "soft_actor_critic", "twin_delayed"]

REACH: Final = 2.0  # of an action of 1 [scales of the goal]
NOISE: Final = 0.1  # of TD3's actions
BATCH: Final = 256
STEPS: Final = 1  # of gradients, a trial


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
        self._offsets = Offsets(self._spec, demonstrations)
        for shown in demonstrations:
            self._keep(shown.state, shown.goal, shown.result)

    def ask(self, state: Array) -> Array:
        """A draw of SAC's policy, or TD3's action with noise."""
        noise = 0.0 if self._noise is None else self._noise()
        goal: Array = self._goals(state[None, :], self._actions(state[None, :], deterministic=False) + noise)[0]
        return goal

    def tell(self, state: Array, goal: Array, result: TrialResult) -> None:
        """Keeps the episode, and takes steps of gradients."""
        self._keep(state, goal, result)
        self._model.train(gradient_steps=STEPS, batch_size=BATCH)

    def policy(self, states: Array) -> Array:
        """The policy's means."""
        return self._goals(states, self._actions(states, deterministic=True))

    def _keep(self, state: Array, goal: Array, result: TrialResult) -> None:
        z = self._offsets.scales.states(state)[None, :]
        action = np.clip(self._offsets.of(state, goal) / REACH, -1.0, 1.0)
        reward = np.array([-cost_of(result)])
        self._model.replay_buffer.add(z, z, action, reward, np.array([True]), [{}])

    def _actions(self, states: Array, *, deterministic: bool) -> Array:
        z = self._offsets.scales.states(states).astype(np.float32)
        return np.asarray(self._model.predict(z, deterministic=deterministic)[0], np.float64)

    def _goals(self, states: Array, actions: Array) -> Array:
        return self._offsets.goals(states, REACH * np.clip(actions, -1.0, 1.0))


def soft_actor_critic(spec: TaskSpec, seed: int) -> OneStepEpisodes:
    """SAC with its defaults; it explores by its own entropy."""
    return OneStepEpisodes(spec, seed, SAC)


def twin_delayed(spec: TaskSpec, seed: int) -> OneStepEpisodes:
    """TD3 with its defaults and Gaussian noise on actions."""
    np.random.seed(seed)  # noqa: NPY002 - Stable-Baselines3 draws action noise from the global generator
    count = len(spec.goal)
    return OneStepEpisodes(spec, seed, TD3, action_noise=NormalActionNoise(np.zeros(count), np.full(count, NOISE)))
