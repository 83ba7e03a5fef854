"""The statements that write to tasks in PostgreSQL.

Each write begins with a fence, which finds no row if another server took the task or added to it. The rest of the
statement depends on that row, so for each task all of it happens or nothing, in one commit and one round trip. %b
stands for a value in binary form; ? for one of a statement that `PostgresDatabase.rows` runs.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from crkr.server.log.rows import ROW_COLUMNS, TRIAL_COLUMNS

__all__ = [
    "ADOPT_EVENTS",
    "ADOPT_TRIALS",
    "APPEND",
    "CACHE",
    "CREATE",
    "DESCRIBE",
    "DESCRIBED",
    "DISOWN",
    "EVENT",
    "KNOWN",
    "NEW_TASK",
    "NOW",
    "PATIENT",
    "ROWS",
]

_EVENT_COLUMNS: Final = "task, seq, time, kind, body, digest"
_TYPES: Final = {
    "task": "bigint",
    "seq": "bigint",
    "time": "double precision",
    "kind": "smallint",
    "success": "smallint",
    "cost": "double precision",
    "model_version": "bigint",
    "present_cost": "double precision",
    "removed": "smallint",
}
_FENCE: Final = """WITH fence AS (UPDATE task SET last = step.last
    FROM unnest(%b::bigint[], %b::bigint[], %b::bigint[], %b::bigint[]) AS step(id, epoch, known, last)
    WHERE task.id = step.id AND task.epoch = step.epoch AND task.last = step.known RETURNING task.id)"""
_FENCE_EVENT: Final = """WITH fence AS (UPDATE task SET last = last + 1, name = coalesce(%b::text, name)
    WHERE id = %b::bigint AND epoch = %b AND last = %b RETURNING id)"""
_TOLD: Final = "told AS (UPDATE log SET epoch = log.epoch + 1 FROM fence WHERE %b::boolean)"


def _arrays(columns: str, types: Mapping[str, str]) -> str:
    return ", ".join(f"%b::{types.get(column, 'bytea')}[]" for column in columns.split(", "))


def _insert(table: str, columns: str, types: Mapping[str, str]) -> str:
    values = f"unnest({_arrays(columns, types)}) AS new({columns})"
    return f"INSERT INTO {table} ({columns}) SELECT new.* FROM fence JOIN {values} ON new.task = fence.id"


_EVENT_TYPES: Final = {**_TYPES, "kind": "text"}
APPEND: Final = f"""{_FENCE}, kept AS ({_insert("trial", f"task, {TRIAL_COLUMNS}", _TYPES)})
                     SELECT id FROM fence"""
EVENT: Final = f"""{_FENCE_EVENT}, kept AS ({_insert("event", _EVENT_COLUMNS, _EVENT_TYPES)}),
    marked AS (UPDATE trial SET present_cost = new.cost, removed = new.removed, digest = new.digest FROM fence,
        unnest(%b::double precision[], %b::smallint[], %b::bytea[], %b::bigint[], %b::bytea[])
            AS new(cost, removed, digest, task, id) WHERE trial.task = new.task AND trial.id = new.id), {_TOLD}
    SELECT id FROM fence"""
NEW_TASK: Final = "INSERT INTO task (name, last, owner) VALUES (%b::text, %b::bigint, %b::uuid) RETURNING id"
CREATE: Final = f"""WITH fence AS ({NEW_TASK}), kept AS (INSERT INTO event ({_EVENT_COLUMNS})
        SELECT id, 1, %b::double precision, %b::text, %b::bytea, %b::bytea FROM fence), {_TOLD}
    SELECT id FROM fence"""
ADOPT_TRIALS: Final = f"INSERT INTO trial (task, {ROW_COLUMNS}) VALUES ({', '.join(['%b'] * 16)})"
ADOPT_EVENTS: Final = f"INSERT INTO event ({_EVENT_COLUMNS}) VALUES ({', '.join(['%b'] * 6)})"
DISOWN: Final = "DELETE FROM task WHERE id = ANY(%s) AND owner = %s"
PATIENT: Final = "SET LOCAL statement_timeout = 0"  # deleting a whole task takes long
KNOWN: Final = "SELECT id, seq, digest FROM trial WHERE task = %b AND id = ANY(%b::bytea[])"
ROWS: Final = f"SELECT {ROW_COLUMNS} FROM trial WHERE task = ? AND id = ?"
CACHE: Final = """INSERT INTO cache (task, version, data, digest) VALUES (%b, %b, %b, %b) ON CONFLICT (task) DO UPDATE
                   SET version = excluded.version, data = excluded.data, digest = excluded.digest"""
NOW: Final = "SELECT id, name, last, epoch FROM task WHERE id = ANY(?)"
DESCRIBE: Final = """INSERT INTO summary (task, entry) SELECT * FROM unnest(%b::bigint[], %b::bytea[])
                      ON CONFLICT (task) DO UPDATE SET entry = excluded.entry"""
DESCRIBED: Final = "SELECT name, entry FROM task JOIN summary ON task = id WHERE name = ANY(?)"
