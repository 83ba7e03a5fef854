"""How much one message holds, worked out from a task's dimensions before anything is computed or sent.

d, p and q are how many numbers a state, a goal and an outcome have.
"""

from __future__ import annotations

from typing import Final

from crkr.protocol.codec import MAX_MESSAGE_BYTES, MAX_STATES
from crkr.protocol.errors import Invalid
from crkr.protocol.specification.task_spec import TaskSpec

__all__ = ["MOST_RECENT", "check_model_fits", "most_active", "most_states", "most_states_answered"]

_NUMBER: Final = 8
_ID: Final = 18  # with its header
MOST_RECENT: Final = 200  # newest trials in a model
_REST: Final = 4096  # names of fields, and what comes once in a message


def most_states_answered(outputs: int, measured: int) -> int:
    """States whose predictions fit into one answer.

    Args:
        outputs: p.
        measured: q where outcomes guide the goals, so that an answer predicts them; else 0.
    """
    numbers = 3 * outputs + 2 + 2 * measured  # goals, means, sigmas, novelty, P(success); outcomes, deviations
    return min((MAX_MESSAGE_BYTES - _REST) // (_NUMBER * numbers + _ID), MAX_STATES)


def most_states(spec: TaskSpec) -> int:
    """States that fit into one question, with an id each, and their predictions into its answer."""
    asked = (MAX_MESSAGE_BYTES - _REST) // (_NUMBER * len(spec.state) + _ID)
    return min(asked, most_states_answered(len(spec.goal), len(spec.outcome)))


def most_active(states: int, goals: int) -> int:
    """Active samples of a model that fits into one answer, for d = `states` and p = `goals`."""
    recent = MOST_RECENT * (states + 1)  # trials that tell how likely a success is
    once = _REST + _NUMBER * (2 * states + 4 * goals + recent)  # the settings
    return (MAX_MESSAGE_BYTES - once) // (_NUMBER * (states + goals + 1) + _ID)


def check_model_fits(spec: TaskSpec) -> None:
    """Raises `Invalid` for a budget whose model no message could carry to a mirror."""
    states, goals = len(spec.state), len(spec.goal)
    most = most_active(states, goals)
    if spec.budget > most:
        raise Invalid(
            f"budget must be at most {most} with {states} states and {goals} goals, so that the model fits into a "
            f"message of {MAX_MESSAGE_BYTES} bytes; got {spec.budget}",
            details={"field": "budget", "most": most},
        )
