"""`crkr ask`: a person tries the goals, and says at the keyboard which of them hit."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Annotated, Any, Final, final
from uuid import UUID

import typer

from crkr.client import Client, Task
from crkr.client.cli.console import print_table, stderr, stdout
from crkr.client.cli.options import TaskName, check_count, connected, parse_vector
from crkr.client.commands.trials import undone
from crkr.protocol import GoalDimension, Invalid, NovelState, OutcomeEntry, Prediction, StateDimension, TaskSpec
from crkr.protocol.checks import cost_number
from crkr.protocol.trial import LABEL_COSTS

__all__ = ["ask"]

_KEYS: Final = "h hit, m miss, f could not be tried, s skip, u undo, q quit"
_LABELS: Final = {"h": "hit", "hit": "hit", "m": "miss", "miss": "miss", "f": "failed", "failed": "failed"}


@connected(10.0)
def ask(
    client: Client,
    task: TaskName,
    state: Annotated[
        str | None, typer.Option("--state", help="State of all trials, in quotes; asked for each time unless given.")
    ] = None,
    best: Annotated[bool, typer.Option("--best", help="Try the best known goals instead of exploring.")] = False,
) -> None:
    """Try goals by hand: show one, wait for h (hit) or m (miss), report it, and show the next.

    A number after the letter is the cost, as in "h 0.3"; without one a hit costs 0.1 and a miss 0.9.

    Example: crkr ask throw --state "1.5"
    """
    fixed = None if state is None else parse_vector(state, "--state")
    handle = client.task(task)
    if fixed is not None:
        check_count(fixed, "--state", handle.spec.state)
    stdout.print(_KEYS)
    session = _Session(handle, fixed, explore=not best)
    while session.step():
        pass
    stdout.print(f"{session.hits} hits in {session.tried} trials")


class _SessionEnded(Exception):
    """The person has ended the session."""


@final
class _Session:
    """Trials of one person, one after the other."""

    def __init__(self, task: Task, state: Sequence[float] | None, *, explore: bool) -> None:
        self.hits = self.tried = 0
        self._task, self._spec, self._explore = task, task.spec, explore
        self._fixed = self._last = state
        self._labels: dict[UUID, str] = {}  # by trial id

    def step(self) -> bool:
        """One trial; False at the end."""
        try:
            answer = self._task.predict(self._state(), explore=self._explore)
            _show(answer, self._spec)
            self._settle(answer)
        except _SessionEnded:
            return False
        except NovelState as error:
            if self._fixed is not None:
                raise
            stderr.print(f"error: {error.message}")
        return True

    def _state(self) -> Sequence[float]:
        while self._fixed is None:
            again = "" if self._last is None else ", Enter for the same"
            words = _read(f"state ({_names(self._spec.state)}){again}: ")
            if self._common(words):
                continue
            if not words and self._last is not None:
                return self._last
            try:
                state = parse_vector(words, "state")
                check_count(state, "state", self._spec.state)
            except (Invalid, typer.BadParameter) as error:
                stderr.print(f"error: {error}")
                continue
            self._last = state
            return state
        return self._fixed

    def _settle(self, answer: Prediction) -> None:
        """Read what became of the trial, and report it."""
        while True:
            letter, _, number = _read("hit or miss? ").partition(" ")
            if self._common(letter):
                continue
            if letter in ("s", "skip"):
                return
            if letter in _LABELS:
                try:
                    self._report(answer, _LABELS[letter], number)
                    return
                except (Invalid, typer.BadParameter) as error:
                    stderr.print(f"error: {error}")
            else:
                stdout.print(_KEYS)

    def _common(self, letter: str) -> bool:
        """Do what u and q ask for at every question; whether it was u."""
        if letter in ("q", "quit"):
            raise _SessionEnded
        if letter not in ("u", "undo"):
            return False
        self._undo()
        return True

    def _report(self, answer: Prediction, label: str, number: str) -> None:
        success, fields = label == "hit", dict[str, Any]()
        if number:
            fields["cost"] = _cost(number)
        elif label != "failed":
            fields["cost"] = LABEL_COSTS[success]
        if self._spec.outcome and label != "failed":
            words = _read(f"measured ({_names(self._spec.outcome)}), Enter if not: ")
            if words:
                fields["outcome"] = parse_vector(words, "measured")
        kind = "failed" if label == "failed" else "trial"
        receipt = self._task.report(answer, success=success, kind=kind, wait=True, **fields)
        self._labels[answer.trial_id] = label
        self.tried, self.hits = self.tried + 1, self.hits + success
        stdout.print(f"{label}: number {receipt.seqs[0]}, trial id {answer.trial_id}")

    def _undo(self) -> None:
        if not self._labels:
            stderr.print("error: nothing was reported in this session; crkr undo goes further back")
            return
        taken = self._task.undo()
        if taken["undone"] == "trial":
            own = [self._labels.pop(one) for one in taken["ids"] if one in self._labels]
            self.tried, self.hits = self.tried - len(own), self.hits - own.count("hit")
        stdout.print(f"taken back: {undone(taken)}")


def _names(axes: Sequence[StateDimension | GoalDimension | OutcomeEntry]) -> str:
    return ", ".join(f"{axis.name} [{axis.unit}]" if axis.unit else axis.name for axis in axes)


def _cost(text: str) -> float:
    try:
        number = float(text)
    except ValueError as error:
        raise Invalid("the cost is one number, as in h 0.3") from error
    return cost_number(number, "cost")


def _read(question: str) -> str:
    """A line from standard input without blanks around it; its end ends the session."""
    stdout.print(question, end="")
    line = sys.stdin.readline()
    if not line:
        stdout.print()  # ends the question's line
        raise _SessionEnded
    return line.strip()


def _show(answer: Prediction, spec: TaskSpec) -> None:
    rows = [(axis.name, f"{value:.5g}", axis.unit) for axis, value in zip(spec.goal, answer.goal, strict=True)]
    print_table(("goal", "value", "unit"), rows)
