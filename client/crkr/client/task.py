"""One task of a server: ask for goals, report what they cost, read what was learned."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, final
from uuid import UUID

from crkr.client.administration import Administration
from crkr.client.checks import AnswerCheck, answer_to, check_bounds, check_receipt, plain
from crkr.client.network.presence import Presence
from crkr.client.network.subscription import TOPICS, Subscription
from crkr.client.outbox.outbox import Outbox
from crkr.client.rpc import Rpc
from crkr.client.task_calls import ask, ask_in_parts, look_up, named_trials, newest_trials, worst_trials
from crkr.protocol import (
    MAX_TELEMETRY_BYTES,
    Array,
    Explanation,
    Invalid,
    Prediction,
    PredictRequest,
    Receipt,
    ReportRequest,
    StoredTrial,
    TaskSpec,
    Trial,
    TrialFields,
    admin_key,
    check_states,
    make_trials,
    most_states,
    pack,
    pub_key,
    random_ids,
    task_key,
    trial_ids,
    unpack,
)
from crkr.protocol.checks import finite_array, flag, integer, required, text
from crkr.protocol.earlier_python import Unpack
from crkr.protocol.messages.predict_bytes import packed_question, read_answer

if TYPE_CHECKING:
    from crkr.client.mirror import Mirror

__all__ = ["Task"]


@final
class Task(Administration):
    """A task by name; every call has a deadline and raises the protocol's typed errors.

    Every method may raise `Unavailable` (no answer by the deadline) and `UnknownTask`; only others are listed.

    Attributes:
        name: The task's name.
        created: Whether `Client.create_task` made it just now; None for a task that was looked up.
    """

    def __init__(self, rpc: Rpc, name: str, *, created: bool | None = None) -> None:
        self.name: Final = name
        self.created: Final = created
        self._rpc = rpc
        self._spec: TaskSpec | None = None
        self._answers = AnswerCheck()

    @property
    def spec(self) -> TaskSpec:
        """The specification in force, fetched once; `configure` renews it."""
        return self._spec or self._look(None)[0]

    def predict(
        self,
        states: object,
        explore: bool = False,
        *,
        trial_ids: Sequence[UUID] | None = None,
        worker: str | None = None,
        timeout_s: float | None = None,
    ) -> Prediction:
        """Goals for one state (d,) or a batch (b, d).

        Args:
            states: The situation, or b of them.
            explore: Draw goals to try rather than the best known.
            trial_ids: Ids of the trials to come, which fix the draw; made here where absent.
            worker: Name of the asking process; the server counts its trials as open until they are reported.
            timeout_s: Deadline [s].

        Raises:
            Invalid: States of another shape, or not finite.
            NoSamples: Nothing was learned yet.
            NovelState: The task refuses states this far from its samples.
        """
        spec, timeout_s = self._specified(timeout_s)
        dimensions = len(spec.state)
        if trial_ids is None and getattr(states, "shape", None) == (dimensions,):
            return self._predict_one(check_states(states, dimensions), explore, worker, timeout_s)
        request = PredictRequest.create(
            dimensions,
            states,
            explore=explore,
            trial_ids=None if trial_ids is None else list(trial_ids),
            worker=worker,
        )
        message = request.to_wire()
        if "trial_ids" not in message:  # made here, so that a retry gets the same draw
            message["trial_ids"] = random_ids(request.count)
        ids = [getattr(one, "bytes", one) for one in message["trial_ids"]]  # UUIDs, or bytes made here
        if request.count > (most := most_states(spec)):
            answer = ask_in_parts(self._rpc, self.name, request.states, message, most, timeout_s)
        else:
            answer = ask(self._rpc, self.name, request.states, message, timeout_s)
        with answer_to("predict"):
            return self._answers.check(self.spec, self._look, answer, ids)

    def _predict_one(self, state: Array, explore: object, worker: object, timeout_s: float | None) -> Prediction:
        """One state, the most frequent question, packed and read without intermediate maps."""
        named = None if worker is None else text(worker, "worker", longest=128)
        identity = random_ids(1)[0]
        payload = packed_question(state, flag(explore, "explore"), identity, named)
        reply = self._rpc.exchange(task_key(self.name, "predict"), "predict", payload, timeout_s)
        with answer_to("predict"):
            answer = read_answer(reply, state, len(self.spec.goal))
            if answer is None:
                answer = Prediction.from_wire(unpack(reply), state)
            return self._answers.check(self.spec, self._look, answer, [identity])

    def report(
        self,
        answer: Prediction | None = None,
        *,
        wait: bool = False,
        timeout_s: float | None = None,
        **trial: Unpack[TrialFields],
    ) -> Receipt:
        """Reports one trial or a batch. The trials are on the server's disk when this returns.

        Args:
            answer: The prediction that was tried; or give `state` and `goal`.
            wait: Return only after the model includes it.
            timeout_s: Deadline [s].
            trial: What was tried and its result, see `crkr.protocol.TrialFields`.

        Raises:
            Invalid: A value of the wrong shape or out of range; nothing was stored.
            Conflict: An id is known with other content; nothing was stored.
            StorageError: The server cannot write; nothing was stored.
        """
        spec, timeout_s = self._specified(timeout_s)
        return self.report_trials(make_trials(spec, answer, **trial), wait=wait, timeout_s=timeout_s)

    def report_trials(self, trials: Sequence[Trial], *, wait: bool = False, timeout_s: float | None = None) -> Receipt:
        """Stores trials, all or none, as `report` does."""
        message = ReportRequest(tuple(trials), wait).to_wire()
        reply = self._rpc.call(task_key(self.name, "report"), message, timeout_s)
        with answer_to("report"):
            return check_receipt(Receipt.from_wire(reply), len(trials))

    def status(self, *, brief: bool = False, timeout_s: float | None = None) -> dict[str, Any]:
        """Counts, versions, workers, queues and latencies, as the server sees them.

        Args:
            brief: Counts and versions only, whose cost does not depend on how many workers there are; for polls.
            timeout_s: The client's unless given.
        """
        return self._read("status", {"brief": True} if brief else {}, timeout_s)

    def model(self, known_version: int | None = None, *, timeout_s: float | None = None) -> dict[str, Any]:
        """The model as data (arrays, ids as UUIDs), or `unchanged` if its version still is `known_version`."""
        return self._read("model", {} if known_version is None else {"known_version": known_version}, timeout_s)

    def samples(
        self, after: int = 0, limit: int = 1000, *, timeout_s: float | None = None
    ) -> tuple[list[StoredTrial], int | None]:
        """One page of the log: trials with seq > `after`, and the next `after` (None at the end)."""
        spec, timeout_s = self._specified(timeout_s)
        reply = self._rpc.call(task_key(self.name, "samples"), {"after": after, "limit": limit}, timeout_s)
        with answer_to("samples"):
            following = reply.get("next")
            page = [StoredTrial.from_wire(entry, spec) for entry in required(reply, "samples")]
            return page, None if following is None else integer(following, "next")

    def trials(
        self,
        *,
        last: int | None = None,
        worst: int | None = None,
        id: UUID | Sequence[UUID] | None = None,  # noqa: A002 - the protocol's word
        timeout_s: float | None = None,
    ) -> list[StoredTrial]:
        """Stored trials in their current form, amended and removed ones too; the newest 10 by default.

        Args:
            last: That many of the newest, newest first.
            worst: That many of highest cost, worst first, removed ones left out; reads all trials.
            id: These.
            timeout_s: Deadline of each page [s].

        Raises:
            Invalid: An unknown id, or more than one of the three.
            Unsupported: The server is older than these questions.
        """
        if sum(one is not None for one in (last, worst, id)) > 1:
            raise Invalid("give one of last, worst and id")
        if worst is not None:
            return worst_trials(self.samples, integer(worst, "worst", low=1), timeout_s)
        spec, timeout_s = self._specified(timeout_s)
        if id is not None:
            return named_trials(self._rpc, self.name, spec, trial_ids([id] if isinstance(id, UUID) else id), timeout_s)
        count = integer(10 if last is None else last, "last", low=1)
        return newest_trials(self._rpc, self.name, spec, count, timeout_s)

    def iter_samples(self, after: int = 0) -> Iterator[StoredTrial]:
        """Every stored trial with seq > `after`, in order, page by page."""
        position: int | None = after
        while position is not None:
            page, position = self.samples(position)
            yield from page

    def explain(self, state: object, sample_id: UUID | None = None, *, timeout_s: float | None = None) -> Explanation:
        """The samples that determine the answer for a state (d,), and the status of one sample."""
        spec, timeout_s = self._specified(timeout_s)
        message: dict[str, Any] = {"state": finite_array(state, "state", (len(spec.state),))}
        if sample_id is not None:
            message["sample_id"] = sample_id
        reply = self._rpc.call(task_key(self.name, "explain"), message, timeout_s)
        with answer_to("explain"):
            return Explanation.from_wire(reply)

    def configure(self, changes: Mapping[str, Any], *, timeout_s: float | None = None) -> dict[str, Any]:
        """Changes settings named in `crkr.protocol.CHANGEABLE`; the answer holds the specification in force."""
        reply = self._admin("configure", {"changes": dict(changes)}, timeout_s)
        self._spec = None
        return reply

    def announce(self, worker_id: str, *, timeout_s: float | None = None) -> Presence:
        """Shows a worker as alive until the returned object is closed.

        Raises:
            Invalid: An id that a key cannot contain.
            Conflict: A living worker has that id.
        """
        return self._rpc.transport.announce(self.name, worker_id, self._rpc.deadline(timeout_s))

    def publish(self, topic: str, message: Mapping[str, Any]) -> None:
        """Publishes telemetry ("trial" or "evaluation"); it may be lost, and this never waits.

        Raises:
            Invalid: Another topic, or more than `MAX_TELEMETRY_BYTES`.
        """
        if topic not in ("trial", "evaluation"):
            raise Invalid(f"workers publish on 'trial' or 'evaluation'; got {topic!r}")
        payload = pack(message)
        if len(payload) > MAX_TELEMETRY_BYTES:
            raise Invalid(
                f"{topic} telemetry has {len(payload)} bytes; the limit is {MAX_TELEMETRY_BYTES}: "
                "send fewer points of its trace"
            )
        self._rpc.transport.publish(pub_key(self.name, topic), topic, payload)

    def subscribe(
        self, topics: Sequence[str] = TOPICS, capacity: int = 4096, *, timeout_s: float | None = None
    ) -> Subscription:
        """Receives what workers ("trial", "evaluation") and the server ("model") publish, from now on."""
        return self._rpc.transport.subscribe(self.name, topics, capacity, self._rpc.deadline(timeout_s))

    def mirror(
        self,
        *,
        every_s: float = 1.0,
        pause_s: float = 0.1,
        max_age_s: float | None = None,
        timeout_s: float | None = None,
    ) -> Mirror:
        """A local copy of the policy that follows the server's, and answers without it; arguments as for `Mirror`.

        Raises:
            ModuleNotFoundError: The extra 'mirror' is not installed.
        """
        try:
            from crkr.client.mirror import Mirror  # needs an extra that most clients do without
        except ModuleNotFoundError as error:
            wanted = "a local copy of a policy needs the extra 'mirror': pip install 'crkr[mirror]'"
            raise ModuleNotFoundError(wanted, name=error.name) from error
        return Mirror(
            self,
            self._rpc,
            self._check_bounds,
            every_s=every_s,
            pause_s=pause_s,
            max_age_s=max_age_s,
            timeout_s=timeout_s,
        )

    def outbox(self, path: Path | str, *, timeout_s: float | None = None) -> Outbox:
        """Reports that wait in a file until the server answers; see `Outbox`.

        Args:
            path: The file, made where it is not there.
            timeout_s: Deadline of asking for the specification, for a new file [s].

        Raises:
            StorageError: The file cannot be opened, is no outbox, or is open already.
            Conflict: It belongs to another task.
            Unavailable: The file is new and no server sends the task's specification.
        """
        return Outbox(self._rpc, self.name, Path(path), self._look, timeout_s)

    def __repr__(self) -> str:
        return f"Task({self.name!r})"

    def _specified(self, timeout_s: float | None) -> tuple[TaskSpec, float | None]:
        """The specification, and the remaining time [s] if it had to be asked for."""
        if self._spec is not None:
            return self._spec, timeout_s
        deadline = self._rpc.deadline(timeout_s)
        spec = self._look(timeout_s)[0]
        return spec, max(deadline - time.monotonic(), 0.001)

    def _look(self, timeout_s: float | None) -> tuple[TaskSpec, bool]:
        """The specification in force, and whether the task is archived."""
        self._spec, archived = look_up(self._rpc, self.name, timeout_s)
        return self._spec, archived

    def _check_bounds(self, low: Array, high: Array) -> None:
        check_bounds(self._spec, self._look, low, high)

    def _read(self, verb: str, message: Mapping[str, Any], timeout_s: float | None) -> dict[str, Any]:
        reply = self._rpc.call(task_key(self.name, verb), message, timeout_s)
        with answer_to(verb):
            return {key: plain(value) for key, value in reply.items()}

    def _admin(self, verb: str, message: Mapping[str, Any], timeout_s: float | None) -> dict[str, Any]:
        reply = self._rpc.call(admin_key(self.name, verb), message, timeout_s)
        with answer_to(verb):
            return {key: plain(value) for key, value in reply.items()}
