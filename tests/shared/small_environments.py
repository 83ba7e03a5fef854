"""Small environments for tests."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

__all__ = ["Aiming", "Walking", "odd", "walking"]


class Aiming(gymnasium.Env[Any, Any]):
    """One decision: a throw at a target; the reward falls with the squared miss."""

    def __init__(self, *, scale: float = 1.0) -> None:
        self.observation_space = spaces.Box(-np.inf, np.inf, (4,))
        self.action_space = spaces.Box(-2.0, 2.0, (1,))
        self.miss = 0.0
        self._scale = scale

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed, options=options)
        self._target = self.np_random.uniform(-1.0, 1.0)
        return np.array([7.0, self._target, 2.0 * self._target + 1.0, 0.0]), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.miss = float(action[0] - self._target)
        return np.zeros(4), -self._scale * self.miss**2, True, False, {"near": abs(self.miss) < 0.1}


class Walking(gymnasium.Env[Any, Any]):
    """Many steps; spaces as given."""

    def __init__(self, observation: spaces.Space[Any] | None = None, action: spaces.Space[Any] | None = None) -> None:
        self.observation_space = observation or spaces.Box(-1.0, 1.0, (2,))
        self.action_space = action or spaces.Box(-1.0, 1.0, (1,))

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed, options=options)
        self.observation_space.seed(seed)
        return self.observation_space.sample(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        return self.observation_space.sample(), -float(np.sum(np.square(action))), False, False, {}


def walking(observation: spaces.Space[Any] | None = None, action: spaces.Space[Any] | None = None) -> Any:
    """What makes a `Walking`."""
    return lambda: Walking(observation, action)


class _Odd(Walking):
    """Says what no environment should."""

    def __init__(self, state: float | None, reward: float, info: dict[str, Any]) -> None:
        super().__init__()
        self._state, self._reward, self._info = state, reward, info

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        observation, info = super().reset(seed=seed, options=options)
        return observation if self._state is None else np.full(2, self._state), info

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        observation, *_ = super().step(action)
        return observation, self._reward, False, False, self._info


def odd(state: float | None = None, reward: float = 0.0, info: dict[str, Any] | None = None) -> Any:
    """What makes an environment that starts from odd states, or rewards or tells oddly."""
    return lambda: _Odd(state, reward, info or {})
