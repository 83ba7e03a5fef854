"""A user's skill behind checks: its faults become failed trials, or end the run with one line."""

from __future__ import annotations

import logging
import os
import sys
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext, redirect_stdout, suppress
from pathlib import Path
from typing import Any, Final, NoReturn, final
from uuid import UUID

import numpy as np

from crkr.client.tally import success_by_criterion
from crkr.protocol import Array, CrkrError, Geom, TaskSpec, Trace, Trial
from crkr.protocol.checks import finite_array
from crkr.sim_worker.skill import (
    Demonstration,
    HasContexts,
    HasDemonstrations,
    HasPlanner,
    HasScene,
    HasStates,
    Skill,
    TrialResult,
    judged_state,
)

__all__ = ["GuardedSkill", "SkillFault", "guarded_plan", "keep_standard_output", "one_line", "skill_code"]

logger = logging.getLogger(__name__)

MOST_FAULTS: Final = 10
"""Failures of `execute` in a row that end the run."""

LONGEST: Final = 300
NOBODY: Final = UUID(int=0)


class SkillFault(CrkrError):
    """A skill failed or broke its contract; the message names the method and the line of code."""


@contextmanager
def skill_code(fault: Callable[[BaseException], NoReturn]) -> Iterator[None]:
    """Runs code of a skill: sends its output to standard error and its exceptions, `SystemExit` too, to `fault`.

    Standard output is for the command's result. Only `KeyboardInterrupt` passes.
    """
    try:
        with redirect_stdout(sys.stderr):
            yield
    except KeyboardInterrupt:
        raise
    except BaseException as error:
        fault(error)


def keep_standard_output() -> None:
    """Redirects this process's standard output to standard error, also for C libraries."""
    with suppress(OSError):  # there may be no standard error
        os.dup2(2, 1)


def one_line(error: BaseException) -> str:
    """An exception in one line: its type, its message, and the line of code that raised it."""
    said = " ".join(str(error).split())[:LONGEST]
    frames = traceback.extract_tb(error.__traceback__)
    where = f" ({Path(frames[-1].filename).name}, line {frames[-1].lineno})" if frames else ""
    return f"{type(error).__name__}{': ' if said else ''}{said}{where}"


@final
class GuardedSkill:
    """A skill with checked results; implements `Skill` and the other interfaces that a run needs.

    An exception of `execute`, or a result that no trial can hold, gives a failed trial with its reason. An exception of
    any other method ends the run with one line.

    Args:
        skill: As its user wrote it.
        within: Returns the context in which a method of the skill, given by name, is called.

    Raises:
        SkillFault: By each method, for an exception or a bad result of the skill; by `execute` at the tenth failure in
            a row.
    """

    def __init__(
        self, skill: Skill, within: Callable[[str], AbstractContextManager[object]] = lambda _: nullcontext()
    ) -> None:
        self._skill, self._within = skill, within
        self._name = type(skill).__name__
        self._spec: TaskSpec | None = None
        self._state: Array | None = None
        self._faults = 0
        self._criteria: tuple[str, ...] = ()

    @property
    def can_demonstrate(self) -> bool:
        """Whether the skill has demonstrations."""
        return isinstance(self._skill, HasDemonstrations)

    @property
    def can_restore(self) -> bool:
        """Whether the skill can be put into any state."""
        return isinstance(self._skill, HasStates)

    @property
    def lacks(self) -> Sequence[str]:
        """Missing features of the skill and their consequences for a run, one line each."""
        lines = []
        if not self.can_demonstrate:
            lines.append("no demonstrations: training starts from what the server proposes")
        if not isinstance(self._skill, HasScene):
            lines.append("no scene: displays show no shapes")
        return lines

    def spec(self) -> TaskSpec:
        """The skill's specification."""
        with skill_code(self._fault("spec")), self._within("spec"):
            spec = self._skill.spec()
        if not isinstance(spec, TaskSpec):
            raise SkillFault(f"{self._name}.spec must return a TaskSpec; got {type(spec).__name__}")
        self._spec = spec
        return spec

    def reset(self, rng: np.random.Generator) -> Array:
        """A new situation's state (d,)."""
        return self._put("reset", lambda: self._skill.reset(rng))

    def evaluation_context(self, number: int, rng: np.random.Generator) -> Array:
        """The state (d,) of situation `number` of an evaluation, the skill's own or drawn by `reset`."""
        method = "evaluation_context" if isinstance(self._skill, HasContexts) else "reset"
        return self._put(method, lambda: judged_state(self._skill, number, rng))

    def restore(self, state: Array) -> None:
        """Sets up a state (d,); raises `SkillFault` if the skill cannot."""
        if not isinstance(self._skill, HasStates):
            raise SkillFault(f"{self._name} cannot put a stored state (a method `restore`)")
        with skill_code(self._fault("restore")), self._within("restore"):
            self._skill.restore(state)
        self._state = state

    def execute(self, goal: Array) -> TrialResult:
        """The result of a goal (p,); a fault of the skill gives a failed trial."""
        reasons: list[BaseException] = []
        try:
            with redirect_stdout(sys.stderr), self._within("execute"):
                result = self._checked(self._skill.execute(goal), goal)
        except KeyboardInterrupt:
            raise
        except BaseException as error:  # also SystemExit, and the panics of bindings
            reasons.append(error)
            result = self._failed(error)
        self._faults = self._faults + 1 if reasons else 0
        if self._faults >= MOST_FAULTS:
            raise SkillFault(f"{self._name}.execute failed {self._faults} times in a row: {one_line(reasons[0])}")
        return result

    def demonstrations(self, count: int, rng: np.random.Generator) -> Sequence[Demonstration]:
        """Successful goals; raises `SkillFault` where the skill has no demonstrations."""
        if not isinstance(self._skill, HasDemonstrations):
            raise SkillFault(f"{self._name} has no demonstrations (a method `demonstrations`)")
        with skill_code(self._fault("demonstrations")), self._within("demonstrations"):
            shown = list(self._skill.demonstrations(count, rng))
            for number, one in enumerate(shown):
                self._check_demonstration(number, one)
        return shown

    def scene(self) -> Sequence[Geom]:
        """The shapes for displays; empty where the skill has none or they cannot be drawn."""
        return self.shapes() or []

    def shapes(self) -> Sequence[Geom] | None:
        """As `scene`, but None where they cannot be drawn."""
        if not isinstance(self._skill, HasScene):
            return []
        try:
            with redirect_stdout(sys.stderr), self._within("scene"):
                shapes = list(self._skill.scene())
        except Exception as error:
            logger.warning("%s.scene: %s; displays show no shapes", self._name, one_line(error))
            return None
        strange = [type(shape).__name__ for shape in shapes if not isinstance(shape, Geom)]
        if strange:
            logger.warning("%s.scene must return Geoms; got %s; displays show no shapes", self._name, strange[0])
            return None
        return shapes

    def _put(self, method: str, call: Callable[[], Array]) -> Array:
        size = len(self._checked_spec.state)
        with skill_code(self._fault(method)), self._within(method):
            self._state = finite_array(call(), "the state", (size,))
        return self._state

    @property
    def _checked_spec(self) -> TaskSpec:
        return self.spec() if self._spec is None else self._spec

    def _fault(self, method: str) -> Callable[[BaseException], NoReturn]:
        def fault(error: BaseException) -> NoReturn:
            raise SkillFault(f"{self._name}.{method}: {one_line(error)}") from error

        return fault

    def _checked(self, result: TrialResult, goal: Array) -> TrialResult:
        """The result with plain numbers; raises if no trial can hold it."""
        if not isinstance(result, TrialResult):
            raise TypeError(f"execute must return a TrialResult; got {type(result).__name__}")
        spec, cost = self._checked_spec, _scalar(result.cost)
        trial = Trial.create(
            spec,
            id=NOBODY,
            state=np.zeros(len(spec.state)) if self._state is None else self._state,
            goal=goal,
            cost=cost,
            success=_scalar(result.success) and bool(_scalar(result.executed)),
            kind="trial" if _scalar(result.executed) else "failed",
            outcome=result.outcome,
            info=result.info,
            learn=_scalar(result.learn) if _scalar(result.executed) else None,
        )
        if trial.kind == "trial":
            self._criteria = tuple(success_by_criterion(trial.success, trial.info))
        trace = result.trace if isinstance(result.trace, Trace) else None
        measured = trial.outcome, trial.info, trace, trial.learn
        return TrialResult(trial.cost, trial.success, trial.kind == "trial", *measured)

    def _failed(self, error: BaseException) -> TrialResult:
        """A failed trial, which meets none of the criteria of the trials before it."""
        if not self._faults:
            logger.warning("%s.execute: %s; the trial counts as failed", self._name, one_line(error))
            logger.debug("traceback", exc_info=error)
        info: dict[str, Any] = {"reason": f"error: {type(error).__name__}", "error": one_line(error)}
        if self._criteria != ("success",):
            info["outcomes"] = dict.fromkeys(self._criteria, False)
        return TrialResult(None, False, False, None, info, None)

    def _check_demonstration(self, number: int, one: Demonstration) -> None:
        if not isinstance(one, Demonstration):
            raise TypeError(f"demonstration {number} must be a Demonstration; got {type(one).__name__}")
        if not isinstance(one.result, TrialResult) or not isinstance(one.result.info, Mapping):
            raise TypeError(f"the result of demonstration {number} must be a TrialResult with a map of info")
        finite_array(one.state, f"the state of demonstration {number}", (len(self._checked_spec.state),))
        finite_array(one.goal, f"the goal of demonstration {number}", (len(self._checked_spec.goal),))


def guarded_plan(planner: HasPlanner, state: Array) -> dict[str, bool]:
    """Success of a skill's best plan for a state (d,), by criterion; raises `SkillFault` for any exception of it."""

    def fault(error: BaseException) -> NoReturn:
        raise SkillFault(f"{type(planner).__name__}.best_plan: {one_line(error)}") from error

    with skill_code(fault):
        return {str(name): bool(met) for name, met in planner.best_plan(state).items()}


def _scalar(value: Any) -> Any:
    """The number or truth value in an array without axes, NumPy's or another library's."""
    return value.item() if hasattr(value, "item") and np.ndim(value) == 0 else value
