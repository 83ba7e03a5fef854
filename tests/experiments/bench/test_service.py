"""The parts of `crkr bench` measure what they say, on real processes; how fast they are is not tested."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from processes import Processes

from crkr.experiments.bench import workload
from crkr.experiments.bench.bare_zenoh import KEY, BareQuerier, echo_server
from crkr.experiments.bench.load import Load, running_load
from crkr.experiments.bench.measurements import Measurement, in_turns, p50, p99, ratio, show
from crkr.experiments.bench.predict import restart_figures
from crkr.experiments.bench.processes import running_server
from crkr.experiments.bench.scale import measure_tasks
from crkr.protocol import Internal, ReportRequest, Unavailable, unpack


def test_an_echo_answers_every_question_with_as_many_bytes() -> None:
    with echo_server(37) as endpoint, BareQuerier(endpoint, KEY) as bare:
        assert len(bare.ask(b"whatever")) == 37
        assert bare.rate([b"x"] * 200, 64) > 0


def test_the_bare_arithmetic_answers_with_as_many_bytes_as_the_server() -> None:
    with echo_server(500, 40) as endpoint, BareQuerier(endpoint, KEY) as bare:
        answers = {bare.ask(workload.predict_payload()), bare.ask(workload.predict_payload())}
    assert [len(one) for one in answers] == [500]
    sigmas = np.frombuffer(answers.pop()[:208])[13:]
    assert (sigmas == sigmas[0]).all()
    assert 0 < sigmas[0] <= 1


def refusals(load: Load) -> int:
    """Error replies so far, after some more queries."""
    load.go()
    return load.stop()[1]


def test_a_load_reports_between_go_and_stop_only(tmp_path: Path, processes: Processes) -> None:
    with running_server(tmp_path / "data") as client:
        task = client.create_task(workload.bench_spec())
        workload.fill(task, 40)
        with BareQuerier(client.endpoint, workload.key("predict")) as bare:
            assert unpack(bare.ask(workload.predict_payload()))["active"] == 40
            with pytest.raises(Internal, match="INVALID"):
                bare.ask(b"\xc1")
        with running_load(client.endpoint, workload.key("report"), "report", 1, 10**9) as load:
            assert load.stop() == (0, 0)
            load.go()
            processes.wait_until(lambda: task.status()["samples"]["trial"] >= 60)
            load.stop()
        with running_load(client.endpoint, workload.key("explain"), "explain", 700, 0) as flood:
            processes.wait_until(lambda: refusals(flood) > 0)
        status = task.status()
    assert status["samples"]["trial"] >= 60
    assert status["active"] == 40  # what the load reports is not learned from


def test_a_load_that_gets_no_answers_gives_no_numbers(processes: Processes) -> None:
    ended = r"bench\.load ended with status 1: .* did not answer a query of the load"
    with (
        pytest.raises(Unavailable, match=ended),
        echo_server(8) as endpoint,
        running_load(endpoint, "bench/nobody", "explain", 4, 0) as load,
    ):
        processes.wait_until(lambda: refusals(load) > 0)


def test_a_server_that_cannot_start_is_an_error_with_its_reason(tmp_path: Path) -> None:
    (tmp_path / "data").write_text("a file where the folder should be")
    reason = r"ended with status 1: data directory \S+ cannot be written"
    with pytest.raises(Unavailable, match=reason) as caught, running_server(tmp_path / "data"):
        pytest.fail("it answered")
    assert "\n" not in caught.value.message


def test_a_server_that_dies_while_it_is_measured_ends_the_measurement(tmp_path: Path, processes: Processes) -> None:
    def measure() -> None:
        with running_server(tmp_path / "data") as client:
            task = client.create_task(workload.bench_spec())
            [server] = [pid for pid in processes.children(os.getpid()) if str(tmp_path) in processes.command_line(pid)]
            with running_load(client.endpoint, workload.key("report"), "report", 1, 0) as load:
                load.go()
                processes.wait_until(lambda: task.status()["samples"]["trial"] > 0)
                os.kill(server, signal.SIGKILL)
                task.report_trials([], wait=True, timeout_s=300.0)

    with pytest.raises(Unavailable, match=r"^crkr server ended by signal 9$"):
        measure()


def test_an_error_beside_a_healthy_server_is_raised_unchanged(tmp_path: Path) -> None:
    with pytest.raises(KeyError), running_server(tmp_path / "data"):
        raise KeyError


def test_the_command_fails_in_one_line_when_its_server_dies(tmp_path: Path, processes: Processes) -> None:
    command = [sys.executable, "-m", "crkr.client", "bench", "report"]
    environment = {**os.environ, "TMPDIR": str(tmp_path)}
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment) as bench:
        [server] = processes.wait_until(
            lambda: [pid for pid in processes.children(bench.pid) if "--data" in processes.command_line(pid)]
        )
        os.kill(server, signal.SIGKILL)
        out, err = bench.communicate(timeout=60)
    assert bench.returncode == 1
    assert (out, err) == ("", "error: crkr server ended by signal 9\n")


def test_a_long_log_is_written_and_restarted_on(tmp_path: Path) -> None:
    figures = list(restart_figures(tmp_path, 300))
    assert [figure.bar for figure in figures] == [6.0, 3.0, 1.1]
    assert all(figure.value > 0 for figure in figures)


def test_a_report_of_the_bench_is_one_the_protocol_accepts() -> None:
    trials = [ReportRequest.from_wire(unpack(workload.report_payload(n)), workload.bench_spec()).trials for n in (1, 2)]
    assert trials[0][0].id != trials[1][0].id
    assert trials[0][0].state.shape == (workload.D,)


def test_calls_are_timed_in_turns() -> None:
    order: list[str] = []
    found = in_turns({"a": lambda: order.append("a"), "b": lambda: order.append("b")}, 3, 2)
    assert "".join(order) == "aabb" + "aabb" * 3
    assert {name: len(times) for name, times in found.items()} == {"a": 6, "b": 6}
    assert p50(np.array([1e-6, 2e-6, 9e-6], dtype=np.float64)) == pytest.approx(2.0)
    assert p99(np.linspace(0.0, 1e-3, 101)) == pytest.approx(990.0)


def test_a_measurement_is_compared_with_its_bar(capsys: pytest.CaptureFixture[str]) -> None:
    figures = [
        Measurement("quick", 1.0, 1.15, False, {"us": 150.0}),
        Measurement("slow", 1.2, 1.15, False, {"us": 180.0}),
        Measurement("rate", 0.7, 0.6, True, {}),
        Measurement("shown", 9.0),
        ratio("quotient", {"ours": 3.0, "theirs": 2.0, "others": 9.0}, "ours", "theirs", 1.5),
    ]
    assert [figure.reached for figure in figures] == [True, False, True, True, True]
    assert figures[-1] == Measurement("quotient", 1.5, 1.5, False, {"ours us": 3.0, "theirs us": 2.0})
    show(figures, "title", False)
    lines = capsys.readouterr().out.splitlines()
    assert "<= 1.15" in lines[2]
    assert "NOT REACHED" in lines[3]
    show(figures, "title", True)
    assert '"reached": false' in capsys.readouterr().out


def test_a_log_that_cannot_be_written_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "few").write_text("a file where the folder should be")
    with pytest.raises(Unavailable, match="the log of 1000 trials was not written: its process ended with 1"):
        list(restart_figures(tmp_path, 10))


def test_one_task_of_many_is_compared_with_one_alone(tmp_path: Path) -> None:
    figures = list(measure_tasks(tmp_path, 20))
    assert [len(one.behind) for one in figures] == [2, 2, 1]
    assert all(number > 0 for one in figures for number in one.behind.values())
