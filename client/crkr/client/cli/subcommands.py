"""The `crkr` application: finds subcommands by entry point and loads only the one that is called."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from importlib.metadata import EntryPoint, entry_points, version
from typing import Annotated, Any, Final, final

import typer
from typer.core import TyperCommand, TyperGroup

from crkr.client.cli.error_lines import guarded, later_python, reason_missing

__all__ = ["build"]

GROUP: Final = "crkr.commands"
_PANELS: Final[Mapping[str, tuple[str, ...]]] = {
    "Run": ("demo", "new", "check-skill", "server", "workers", "watch"),
    "Ask and report": ("create", "tasks", "status", "predict", "report", "ask", "trials", "explain", "doctor"),
    "Judge": ("page", "evaluate", "oracle", "render", "plot", "experiment", "bench"),
    "Correct a task": ("amend", "undo", "recost", "remove", "rollback"),
    "Manage a task": ("refit", "configure", "rename", "archive", "delete"),
    "Data": ("export", "import", "warm-start", "backup", "copy", "replay", "purge"),
}
_GROUP_HELP: Final[Mapping[str, str]] = {
    "bench": "Measure this machine, side by side with a bare baseline.\n\nExample: crkr bench predict",
    "plot": "Draw what was learned.\n\nExample: crkr plot policy table-tennis --vary ball_y",
    "experiment": "Repeat learning runs over seeds and judge them.\n\nExample: crkr experiment learning --seeds 3",
}
_VECTORS: Final = ("--state", "--goal", "--outcome")
_HELP: Final = """A policy service for robots that learn by trying.

Start with `crkr demo`, or with `crkr server` and `crkr create`.
"""


@final
class _Group(TyperGroup):
    """Commands of a group; the error for an unknown one lists them."""

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        if args and args[0] not in self.commands:
            ctx.fail(f"no command {args[0]!r}; there are: {', '.join(self.list_commands(ctx))}")
        return super().resolve_command(ctx, args)


@final
class _Command(TyperCommand):
    """A command that points out missing quotes around a vector."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        vector = next((word for word in args if word in _VECTORS), None)  # parsing takes them out of the list
        try:
            return super().parse_args(ctx, args)
        except Exception as error:  # the class is Typer's or Click's, by Typer's version
            if vector is None or "unexpected extra argument" not in str(error):
                raise
            raise typer.BadParameter(
                f'its numbers need quotes, as in {vector} "0.1 0.2"', ctx, param_hint=vector
            ) from None


def build(arguments: list[str]) -> typer.Typer:
    """The application with the command that the arguments name, or with all commands for help and mistakes."""
    available = {entry.name: entry for entry in entry_points(group=GROUP)}
    app = _application(_HELP)
    app.callback()(_options)
    _add(app, _invoked(available, arguments))
    return app


def _invoked(available: Mapping[str, EntryPoint], arguments: list[str]) -> list[EntryPoint]:
    """The entry points to load: one command, one group, or all."""
    if arguments[:1] == ["--version"]:
        return []
    first, second = [*arguments[:2], "", ""][:2]
    for name in (first, f"{first}.{second}"):
        if name in available:
            return [available[name]]
    group = [entry for name, entry in available.items() if name.startswith(f"{first}.")] if first else []
    return group or list(available.values())


def _add(app: typer.Typer, entries: Iterable[EntryPoint]) -> None:
    groups: dict[str, typer.Typer] = {}
    order = [name for panel in _PANELS.values() for name in panel]
    rank = {name: place for place, name in enumerate(order)}
    for entry in sorted(entries, key=lambda entry: (rank.get(entry.name.split(".")[0], len(order)), entry.name)):
        group, _, name = entry.name.rpartition(".")
        if not group:
            _register(app, name, entry, _panel(name))
            continue
        if group not in groups:
            groups[group] = _application(_GROUP_HELP.get(group, f"Commands of {group}."), _Group)
            groups[group].callback()(lambda: None)  # stays a group even with one command
            app.add_typer(groups[group], name=group, rich_help_panel=_panel(group))
        _register(groups[group], name, entry, None)


def _application(text: str, cls: type[TyperGroup] = TyperGroup) -> typer.Typer:
    return typer.Typer(
        cls=cls,
        help=text,
        no_args_is_help=True,
        pretty_exceptions_enable=False,
        context_settings={"help_option_names": ["-h", "--help"]},
    )


def _panel(name: str) -> str:
    return next((panel for panel, names in _PANELS.items() if name in names), "From other packages")


def _register(app: typer.Typer, name: str, entry: EntryPoint, panel: str | None) -> None:
    """Adds the command; where it cannot be imported, adds one that takes any arguments and says why."""
    command, module = entry.name.replace(".", " "), entry.value.split(":")[0]
    reason = later_python(command, module)
    if reason is None:
        try:
            app.command(name, cls=_Command, rich_help_panel=panel)(guarded(entry.load(), command, module))
        except (ImportError, AttributeError) as error:
            reason = reason_missing(error, command, module)
        else:
            return
    lenient = {"ignore_unknown_options": True, "allow_extra_args": True}
    app.command(name, rich_help_panel=panel, context_settings=lenient)(_absent(reason))


def _absent(reason: str) -> Callable[[], None]:
    def absent() -> None:
        typer.echo(f"error: {reason}", err=True)
        raise typer.Exit(1)

    absent.__doc__ = f"(not installed) {reason}"
    return absent


def _show_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"crkr {version('crkr')}")
        raise typer.Exit


def _options(
    show_version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version and exit.")
    ] = False,
) -> None:
    del show_version  # its callback has acted
