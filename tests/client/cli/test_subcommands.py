"""The `crkr` command: one process start loads one subcommand, and nothing missing breaks the rest."""

import signal
import subprocess
import sys
from importlib.metadata import EntryPoint, version
from typing import Any

import pytest
import typer
from typer.testing import CliRunner

from crkr.client.cli import subcommands as frame
from crkr.client.cli.error_lines import guarded, reason_missing, require
from crkr.protocol import Busy


def crkr(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "crkr.client", *arguments], capture_output=True, text=True, timeout=60, check=False
    )


def entry(name: str, value: str) -> EntryPoint:
    return EntryPoint(name, value, frame.GROUP)


@pytest.fixture
def entries(monkeypatch: pytest.MonkeyPatch) -> list[EntryPoint]:
    found = [
        entry("status", "crkr.client.commands.status:status"),
        entry("watch", "crkr.no_such_part.command:watch"),
        entry("bench.one", "crkr.client.commands.tasks:tasks"),
        entry("bench.two", "crkr.client.commands.tasks:create"),
        entry("stranger", "crkr.client.commands.tasks:tasks"),
    ]
    monkeypatch.setattr(frame, "entry_points", lambda **group: found if group == {"group": frame.GROUP} else [])
    return found


def invoke(*arguments: str) -> Any:
    return CliRunner().invoke(frame.build(list(arguments)), list(arguments))


def names(app: typer.Typer, prefix: str = "") -> set[str]:
    found = {f"{prefix}{command.name}" for command in app.registered_commands}
    for group in app.registered_groups:
        assert group.typer_instance is not None
        found |= names(group.typer_instance, f"{group.name}.")
    return found


def test_an_unknown_command_of_a_group_lists_the_known_ones(entries: list[EntryPoint]) -> None:
    done = invoke("bench", "three")
    assert done.exit_code == 2
    assert "no command 'three'; there are: one, two" in done.stderr


@pytest.mark.parametrize(
    ("arguments", "loaded"),
    [
        (["status", "throw"], {"status"}),
        (["bench", "two", "--help"], {"bench.two"}),
        (["bench"], {"bench.one", "bench.two"}),
        (["--help"], {"status", "watch", "bench.one", "bench.two", "stranger"}),
        ([], {"status", "watch", "bench.one", "bench.two", "stranger"}),
        (["stats"], {"status", "watch", "bench.one", "bench.two", "stranger"}),
    ],
)
def test_only_what_is_asked_for_is_loaded(entries: list[EntryPoint], arguments: list[str], loaded: set[str]) -> None:
    assert names(frame.build(arguments)) == loaded


def test_help_shows_every_command_even_one_that_cannot_be_loaded(entries: list[EntryPoint]) -> None:
    result = invoke("--help")
    assert result.exit_code == 0
    for name in ("status", "watch", "bench", "stranger", "not installed", "From other packages"):
        assert name in result.stdout


def test_a_command_that_cannot_be_loaded_says_so_in_one_line(entries: list[EntryPoint]) -> None:
    result = invoke("watch", "throw", "--web")
    assert result.exit_code == 1
    assert result.stderr.count("\n") == 1
    assert "crkr watch" in result.stderr


def test_a_mistyped_command_is_wrong_usage_with_a_suggestion(entries: list[EntryPoint]) -> None:
    result = invoke("stats")
    assert result.exit_code == 2
    assert "'status'" in result.stderr


@pytest.mark.parametrize(
    ("package", "module", "extra"),
    [
        ("mujoco", "crkr.sim_worker.commands.workers", "sim"),
        ("rerun", "crkr.dashboard.command", "dashboard"),
        ("scipy", "crkr.server.command", "server"),
        ("scipy", "crkr.client.mirror", "mirror"),
        ("scipy", "crkr.experiments.bench.commands", "experiments"),
        ("sklearn.linear_model", "crkr.experiments.study", "experiments"),
        ("matplotlib", "crkr.experiments.figures.command", "sim"),
    ],
)
def test_a_missing_package_is_translated_to_the_extra_that_brings_it(package: str, module: str, extra: str) -> None:
    reason = reason_missing(ModuleNotFoundError(f"No module named {package!r}", name=package), "it", module)
    assert reason == f"crkr it needs the extra '{extra}': pip install 'crkr[{extra}]'"


@pytest.mark.parametrize(
    ("error", "status", "line"),
    [
        (Busy("queue full"), 1, "error: queue full\n"),
        (ModuleNotFoundError("No module named 'mujoco'", name="mujoco"), 1, "error: crkr work needs the extra 'sim'"),
        (FileNotFoundError(2, "No such file or directory", "spec.toml"), 1, "spec.toml"),
        (KeyboardInterrupt(), 130, "interrupted\n"),
    ],
)
def test_an_expected_failure_is_one_line_and_an_exit_status(error: BaseException, status: int, line: str) -> None:
    def work() -> None:
        raise error

    app = typer.Typer()
    app.command()(guarded(work, "work", "crkr.sim_worker.work"))
    result = CliRunner().invoke(app)
    assert result.exit_code == status
    assert line in result.stderr
    assert result.stderr.count("\n") == 1


def test_an_interrupt_while_a_command_is_loaded_is_one_line_too() -> None:
    program = """
import os, signal, sys

class Interrupting:
    def find_spec(self, name, *_):
        if name == "crkr.client.commands.status":
            os.kill(os.getpid(), signal.SIGINT)

sys.meta_path.insert(0, Interrupting())
sys.argv = ["crkr", "status"]
from crkr.client.cli.main import main
main()
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (-signal.SIGINT, "", "interrupted\n")


def test_what_a_child_process_needs_is_missed_before_it_starts() -> None:
    require("numpy", "zenoh")
    with pytest.raises(ModuleNotFoundError) as caught:
        require("numpy", "no_such_package")
    assert caught.value.name == "no_such_package"


def test_a_defect_keeps_its_traceback() -> None:
    def work() -> None:
        raise ZeroDivisionError

    app = typer.Typer()
    app.command()(guarded(work, "work", "crkr.sim_worker.work"))
    assert isinstance(CliRunner().invoke(app).exception, ZeroDivisionError)


def test_the_installed_command_tells_its_version_and_its_parts() -> None:
    assert crkr("--version").stdout == f"crkr {version('crkr')}\n"
    shown = crkr("--help")
    assert shown.returncode == 0
    for name in ("demo", "server", "workers", "watch", "predict", "report", "status", "doctor", "evaluate", "bench"):
        assert f" {name} " in shown.stdout
    assert ("not installed" in shown.stdout) == (sys.version_info < (3, 11))  # where only the client runs


def test_numpy_starts_with_one_thread_unless_the_user_wants_more() -> None:
    program = (
        "import os, sys; sys.argv = ['crkr', '--version']\n"
        "from crkr.client.cli.main import main\n"
        "assert 'numpy' not in sys.modules\n"
        "try: main()\n"
        "except SystemExit: print(os.environ['OPENBLAS_NUM_THREADS'], os.environ['OMP_NUM_THREADS'])"
    )
    run = subprocess.run(
        [sys.executable, "-c", program],
        env={"OMP_NUM_THREADS": "3"},
        capture_output=True,
        text=True,
        check=True,
        timeout=60,
    )
    assert run.stdout.splitlines()[-1] == "1 3"


def test_whoever_forgets_the_quotes_of_a_vector_is_told() -> None:
    shown = crkr("predict", "throw", "--state", "0.3", "1.2")
    assert shown.returncode == 2
    assert 'as in --state "0.1 0.2"' in " ".join(shown.stderr.replace("│", " ").split())
    assert "unexpected extra argument" in crkr("status", "throw", "1.2").stderr
