"""Makes an environment by name, and finds its actions and the length of an episode."""

from __future__ import annotations

import enum
import importlib.util
import io
import types
from collections.abc import Callable, Mapping
from contextlib import redirect_stderr
from dataclasses import dataclass
from typing import Any, Final, final

import gymnasium
import numpy as np
from gymnasium.spaces import Box

from crkr.protocol import Array, Invalid
from crkr.protocol.errors import shown

__all__ = ["Bounds", "Environment", "make_environment", "narrowed"]

Bounds = float | tuple[Any, Any]
"""The greatest size of all numbers of a goal; or their (low, high), each a number or (n,)."""

ROBOTICS: Final = "gymnasium_robotics"
MOST_STEPS: Final = 1_000_000
WIDEST: Final = 1e300  # range of an action's number
PROBES: Final = 3  # random episodes that show whether one action ends an episode


@final
@dataclass(frozen=True, slots=True)
class Environment:
    """An environment whose episodes a skill can run.

    Attributes:
        env: With Gymnasium's wrappers.
        name: For messages.
        steps: Most steps of an episode; 1 where an action is a whole trial.
        low: (n,) least action.
        high: (n,) greatest action.
    """

    env: gymnasium.Env[Any, Any]
    name: str
    steps: int
    low: Array
    high: Array

    def act(self, action: Array) -> tuple[Any, float, bool, Mapping[str, Any]]:
        """One step: the observation, the reward, whether the episode is over, and the environment's info."""
        space: Any = self.env.action_space
        clipped = np.clip(action, self.low, self.high).reshape(space.shape).astype(space.dtype)
        observation, reward, terminated, truncated, info = self.env.step(clipped)
        return observation, float(reward), bool(terminated or truncated), info


def make_environment(
    source: str | Callable[[], gymnasium.Env[Any, Any]],
    settings: Mapping[str, Any],
    goal_bounds: Bounds | None = None,
    steps: int | None = None,
) -> Environment:
    """Makes an environment and finds how its episodes end.

    Args:
        source: Its name, also as package:name; or what makes it.
        settings: Keyword arguments of the environment.
        goal_bounds: For actions without bounds.
        steps: Of an episode, where the environment has no time limit.

    Raises:
        Invalid: There is no such environment, or its episodes cannot be trials; the message says what to do.
    """
    if steps is not None and not (isinstance(steps, int) and 1 <= steps <= MOST_STEPS):
        raise Invalid(f"steps must be a whole number from 1 to {MOST_STEPS}; got {shown(steps)}")
    env, name = _made(source, settings)
    space = env.action_space
    if not isinstance(space, Box):
        raise Invalid(
            f"{name} takes actions of {type(space).__name__}, but a goal is a vector of numbers; "
            "use an environment with a Box of actions, or wrap this one by gymnasium.wrappers.TransformAction"
        )
    low, high = _action_bounds(space, goal_bounds, name)
    made = Environment(env, name, 2, low, high)
    if all(_ends_at_once(made, seed) for seed in range(PROBES)):
        return Environment(env, name, 1, low, high)
    limit = steps if steps is not None else env.spec.max_episode_steps if env.spec is not None else None
    if limit is None:
        raise Invalid(
            f"{name} needs many steps and has no time limit; "
            f"say how many make a trial: gymnasium_skill({name!r}, steps=100)"
        )
    return Environment(env, name, int(limit), low, high)


def _made(
    source: str | Callable[[], gymnasium.Env[Any, Any]], settings: Mapping[str, Any]
) -> tuple[gymnasium.Env[Any, Any], str]:
    if callable(source):
        env = source()
        if not isinstance(env, gymnasium.Env):
            raise Invalid(f"what makes the environment must return a gymnasium.Env; got {type(env).__name__}")
        return env, env.spec.id if env.spec is not None else type(env.unwrapped).__name__
    if source not in gymnasium.registry and importlib.util.find_spec(ROBOTICS) is not None:
        _register_robotics()
    try:
        return gymnasium.make(source, disable_env_checker=True, **settings), source.rpartition(":")[2]
    except (gymnasium.error.Error, ModuleNotFoundError, TypeError) as error:
        reason = " ".join(str(error).split()).rstrip(".")
        raise Invalid(
            f"there is no environment {source!r}: {reason}; "
            "an environment of another package is named PACKAGE:ENV-ID, after `pip install` of the package"
        ) from error


def _register_robotics() -> None:
    """Registers gymnasium-robotics' environments."""
    with redirect_stderr(io.StringIO()):  # it always warns of versions of other environments
        import gymnasium_robotics
    import mujoco
    from gymnasium_robotics.utils import mujoco_utils

    hinge = mujoco.mjtJoint.mjJNT_HINGE
    if np.int32(int(hinge)) not in (hinge,):  # its release 1.4.2 compares joint types so, which MuJoCo 4 answers by no
        whole = {name: int(value) for name, value in mujoco.mjtJoint.__members__.items()}
        stand_in = types.ModuleType("mujoco")
        vars(stand_in).update(vars(mujoco), mjtJoint=enum.IntEnum("mjtJoint", whole))
        mujoco_utils.mujoco = stand_in
    gymnasium.register_envs(gymnasium_robotics)


def _action_bounds(space: Box, given: Bounds | None, name: str) -> tuple[Array, Array]:
    low, high = (np.asarray(side, dtype=np.float64).ravel() for side in (space.low, space.high))
    if not low.size:
        raise Invalid(f"{name} takes actions without numbers: there is nothing to learn")
    if not (np.isfinite(low).all() and np.isfinite(high).all()):
        if given is None:
            first = int(np.argmax(~np.isfinite(low) | ~np.isfinite(high)))
            raise Invalid(
                f"{name}: action {first} has no bounds; give them: gymnasium_skill({name!r}, goal_bounds=1.0)"
            )
        low, high = narrowed(low, high, given, name)
    if (high / 2 - low / 2 > WIDEST / 2).any():
        raise Invalid(f"{name}: its actions' bounds are wider than numbers reach; give narrower goal_bounds")
    return low, high


def narrowed(low: Array, high: Array, given: Bounds | None, name: str) -> tuple[Array, Array]:
    """The intersection of [low, high] (n,) and `goal_bounds`; raises `Invalid` if it is empty."""
    if given is None:
        return low, high
    least, most = given if isinstance(given, tuple) else (-given, given)
    try:
        low = np.maximum(low, np.broadcast_to(np.asarray(least, dtype=np.float64), low.shape))
        high = np.minimum(high, np.broadcast_to(np.asarray(most, dtype=np.float64), high.shape))
    except ValueError as error:
        raise Invalid(f"{name}: goal_bounds need one number or {low.size}; got {shown(given)}") from error
    if not (low < high).all():
        raise Invalid(f"{name}: goal_bounds {shown(given)} leave goals no room within {low.tolist()}..{high.tolist()}")
    return low, high


def _ends_at_once(environment: Environment, seed: int) -> bool:
    rng = np.random.default_rng(seed)
    environment.env.reset(seed=seed)
    return environment.act(rng.uniform(environment.low, environment.high))[2]
