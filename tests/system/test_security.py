"""The recipe for a server beyond loopback: certificates, and who may do what; its files as they are in the examples."""

import json
import os
import re
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import msgpack
import pytest
import zenoh
from processes import Processes

from crkr.client import Client
from crkr.client.network.config import Connection
from crkr.client.network.tls_handshake import refusal
from crkr.client.network.zenoh_transport import ZenohTransport
from crkr.client.rpc import Rpc
from crkr.protocol import Invalid, Unavailable
from crkr.server.session import _config

REPOSITORY = Path(__file__).parents[2]
RECIPE, DOCUMENT = REPOSITORY / "examples" / "security", REPOSITORY / "docs" / "security.md"
DEADLINE_S, A_BIT_S = 6.0, 3.0
INFO = "crkr/@v1/rpc/info"
REACH = {
    "name": "reach",
    "state": [{"name": "x", "unit": "m", "low": 0.0, "high": 1.0, "lengthscale": 0.2}],
    "goal": [{"name": "angle", "unit": "rad", "low": -2.0, "high": 2.0, "scale": 1.0}],
}
TRIAL: dict[str, Any] = {"state": [0.5], "goal": [0.1], "cost": 0.2, "success": True}

As = Callable[..., Client]


def make(keys: Path, *words: str, days: int = 2) -> None:
    if shutil.which("openssl") is None:
        pytest.fail("these tests make certificates with the program openssl, which is not installed here")
    command = ["sh", str(RECIPE / "make_certificates.sh"), str(keys), *words]
    subprocess.run(command, check=True, env={**os.environ, "DAYS": str(days)}, stdout=subprocess.DEVNULL)


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folders of the server and its clients, and of a client of another authority."""
    keys = tmp_path_factory.mktemp("keys")
    make(keys, "client", "robot-2", days=0)  # it expires in this very second
    make(keys, "server", "127.0.0.1")
    make(keys, "client", "robot-1", "player-1", "dashboard", "admin", "stranger")
    make(keys / "other", "client", "admin")
    return keys


@contextmanager
def serving(config: Path, data: Path) -> Iterator[str]:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        endpoint = f"tls/127.0.0.1:{probe.getsockname()[1]}"
    command = [sys.executable, "-m", "crkr.client", "server", "--listen", endpoint, "--zenoh-config", str(config)]
    with subprocess.Popen([*command, "--data", str(data)], stderr=subprocess.PIPE, text=True) as process:
        try:
            assert process.stderr is not None
            assert f"listening on {endpoint}" in process.stderr.readline()
            yield endpoint
        finally:
            process.terminate()
            assert process.wait(timeout=10) == 0


@pytest.fixture(scope="module")
def endpoint(keys: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """A server that follows the recipe, with a task."""
    with serving(keys / "server" / "server.json5", tmp_path_factory.mktemp("data")) as endpoint:
        with Client(endpoint, zenoh_config=keys / "admin" / "client.json5") as admin:
            task = admin.create_task(REACH)
            task.report(**TRIAL, kind="demonstration", wait=True)
        yield endpoint


@pytest.fixture
def identity(endpoint: str, keys: Path) -> Iterator[As]:
    """`identity("robot-1")`: a client with that certificate."""
    clients: list[Client] = []

    def client(name: str, timeout_s: float = DEADLINE_S) -> Client:
        clients.append(Client(endpoint, timeout_s=timeout_s, zenoh_config=keys / name / "client.json5"))
        return clients[-1]

    yield client
    for each in clients:
        each.close()


def has_expired(certificate: Path) -> bool:
    command = ["openssl", "x509", "-noout", "-checkend", "0", "-in", str(certificate)]
    return subprocess.run(command, stdout=subprocess.DEVNULL, check=False).returncode == 1


def raw(endpoint: str, keys: Path, name: str) -> zenoh.Session:
    """A session of plain Zenoh with a client's certificate."""
    return zenoh.open(Connection.choose(endpoint, keys / name / "client.json5").zenoh(DEADLINE_S))


def doctor(endpoint: str, config: Path | None = None) -> dict[str, tuple[bool, str]]:
    """What `crkr doctor` says, by the name of the check."""
    command = [sys.executable, "-m", "crkr.client", "doctor", "--json", "--connect", endpoint, "--timeout", "1"]
    options = [] if config is None else ["--zenoh-config", str(config)]
    done = subprocess.run([*command, *options], stdout=subprocess.PIPE, timeout=30, check=False)
    answer = json.loads(done.stdout)
    assert done.returncode == (0 if answer["ok"] else 1)
    return {check["check"]: (check["ok"], check["detail"]) for check in answer["checks"]}


def test_a_robot_with_a_certificate_learns_as_on_loopback(identity: As) -> None:
    robot = identity("robot-1").task("reach")
    answer = robot.predict([0.4], explore=True)
    with robot.announce("arm"), robot.mirror() as mirror:
        assert robot.report(answer, cost=0.1, success=True, worker="arm", wait=True).accepted == 1
        assert next(worker for worker in robot.status()["workers"] if worker["id"] == "arm")["state"] == "alive"
        mirror.wait_for(robot.status()["model_version"], DEADLINE_S)
    assert [stored.trial.id for stored in robot.iter_samples()][-1] == answer.trial_id


@pytest.mark.parametrize(
    ("authority", "folder", "host", "reason"),
    [
        ("authority", None, "127.0.0.1", "this one shows none"),
        ("authority", "other/admin", "127.0.0.1", "of another authority than the server's"),
        ("authority", "robot-2", "127.0.0.1", "it has expired"),
        ("other/authority", "robot-1", "127.0.0.1", "server's certificate is not of the authority"),
        ("authority", "robot-1", "localhost", "not for 'localhost'"),
    ],
    ids=["without a certificate", "of another authority", "expired", "that trusts another", "by another name"],
)
def test_a_client_that_does_not_agree_about_certificates_is_told_why_by_its_deadline(
    endpoint: str,
    keys: Path,
    tmp_path: Path,
    processes: Processes,
    authority: str,
    folder: str | None,
    host: str,
    reason: str,
) -> None:
    if folder == "robot-2":
        processes.wait_until(lambda: has_expired(keys / folder / "client.pem"))
    tls: dict[str, Any] = {"root_ca_certificate": str(keys / authority / "ca.pem")}
    if folder is not None:
        certificate, key = keys / folder / "client.pem", keys / folder / "client.key"
        tls |= {"connect_certificate": str(certificate), "connect_private_key": str(key), "enable_mtls": True}
    file = tmp_path / "client.json5"
    file.write_text(json.dumps({"transport": {"link": {"tls": tls}}}))
    began = time.monotonic()
    with (
        Client(endpoint.replace("127.0.0.1", host), timeout_s=DEADLINE_S, zenoh_config=file) as client,
        pytest.raises(Unavailable, match=reason),
    ):
        client.info()
    assert time.monotonic() - began < DEADLINE_S + A_BIT_S


def test_a_certificate_written_into_the_configuration_is_not_taken_for_none(endpoint: str) -> None:
    config = zenoh.Config()
    assert "shows none" in str(refusal(endpoint, config, DEADLINE_S))
    config.insert_json5("transport/link/tls/enable_mtls", "true")  # with what Zenoh keeps to itself
    assert refusal(endpoint, config, DEADLINE_S) is None


def test_a_client_without_tls_is_refused_and_the_doctor_says_why(endpoint: str) -> None:
    plain = endpoint.replace("tls/", "tcp/")
    with Client(plain, timeout_s=0.7) as client, pytest.raises(Unavailable):
        client.info()
    passed, detail = doctor(plain)["reachable"]
    assert not passed
    assert "speaks TLS" in detail


def test_the_doctor_tells_a_robot_until_when_the_certificate_is_valid_and_what_it_may_do(
    endpoint: str, keys: Path
) -> None:
    checks = doctor(endpoint, keys / "robot-1" / "client.json5")
    assert checks["access"] == (
        True,
        "may look, predict, report; the server's configuration denies: create tasks, administer",
    )
    passed, detail = checks["certificate"]
    assert not passed  # these last two days only
    assert "days are left" in detail


@pytest.mark.parametrize(
    ("name", "may"),
    [
        ("stranger", ""),
        ("dashboard", "look"),
        ("player-1", "look predict"),
        ("robot-1", "look predict report"),
        ("admin", "look predict report create administer"),
    ],
)
def test_a_certificate_gives_the_rights_of_its_name_and_no_more(endpoint: str, keys: Path, name: str, may: str) -> None:
    deeds: dict[str, tuple[str, dict[str, Any]]] = {
        "look": ("task/reach/rpc/samples", {}),
        "predict": ("task/reach/rpc/predict", {"states": [0.5]}),
        "report": ("task/reach/rpc/report", {"trials": []}),
        "create": ("rpc/create_task", REACH),
        "administer": ("task/reach/admin/remove", {"ids": []}),
    }
    expected = may.split()
    with ZenohTransport(Connection.choose(endpoint, keys / name / "client.json5")) as transport:
        transport.connect(time.monotonic() + DEADLINE_S)
        heard = [
            deed
            for deed, (key, message) in deeds.items()
            if is_heard(transport, f"crkr/@v1/{key}", message, DEADLINE_S if deed in expected else 0.3)
        ]
    assert heard == expected


def is_heard(transport: ZenohTransport, key: str, message: dict[str, Any], patience_s: float) -> bool:
    """Whether there is an answer, if only a refusal. Silence is how Zenoh denies, on a connection that works."""
    try:
        Rpc(transport, patience_s).call(key, message)
    except Unavailable as error:
        return not error.details["reason"].startswith("connected, but")
    except Invalid:
        return True
    return True


def test_a_dashboard_sees_trials_and_models_and_nobody_else_can_tell_it_of_models(
    identity: As, endpoint: str, keys: Path
) -> None:
    robot = identity("robot-1").task("reach")
    with identity("dashboard").task("reach").subscribe() as news, raw(endpoint, keys, "robot-1") as session:
        session.put("crkr/@v1/task/reach/pub/model", msgpack.packb({"version": 999}))
        receipt = robot.report(**TRIAL, wait=True)
        session.put(
            "crkr/@v1/task/reach/pub/trial", msgpack.packb({"cost": 0.2})
        )  # it overtakes nothing of its session
        heard = dict(filter(None, [news.receive(DEADLINE_S), news.receive(DEADLINE_S)]))
    assert heard.keys() == {"model", "trial"}
    assert heard["model"]["version"] == receipt.seqs[0]
    assert heard["trial"]["cost"] == TRIAL["cost"]


def test_a_robot_cannot_answer_in_the_servers_place(endpoint: str, keys: Path) -> None:
    with raw(endpoint, keys, "robot-1") as robot, raw(endpoint, keys, "admin") as admin:
        queryable = robot.declare_queryable("crkr/@v1/**", zenoh.handlers.FifoChannel(16), complete=True)
        # After its answer, the declaration before it has arrived too.
        everyone = zenoh.QueryTarget.ALL
        robot.get(INFO, target=everyone, timeout=DEADLINE_S, allowed_destination=zenoh.Locality.REMOTE).recv()
        replies = admin.get(INFO, target=everyone, timeout=DEADLINE_S)
        assert [reply.ok is not None for reply in replies] == [True]
        assert queryable.try_recv() is None


@pytest.mark.parametrize("name", ["robot-1", "admin", "dashboard"])
def test_nobody_can_say_what_is_the_servers_to_say(identity: As, endpoint: str, keys: Path, name: str) -> None:
    """Neither that it is a server, nor that there is a new model, nor take the place of another kind of token."""
    robot = identity("robot-1")
    robot.info()
    with raw(endpoint, keys, name) as session, raw(endpoint, keys, "admin") as witness:
        false_news = robot.task("reach").subscribe(("model",))
        [server] = standing(witness, "crkr/@v1/live/server/*")
        tokens = [
            session.liveliness().declare_token(key)
            for key in ("crkr/@v1/live/server/mine", "crkr/@v1/task/reach/live/rumour/x", "crkr/@v1/x", "elsewhere/x")
        ]
        session.put("crkr/@v1/task/reach/pub/model", msgpack.packb({"version": 999}))
        session.put("crkr/@v1/live/server/mine", b"")
        list(session.liveliness().get("crkr/@v1/live/server/*", timeout=DEADLINE_S))  # all of it has arrived
        assert standing(witness, "crkr/@v1/live/server/*") == {server}
        assert standing(witness, "crkr/@v1/task/*/live/**") == set()
        receipt = robot.task("reach").report(**TRIAL, wait=True)
        news = false_news.receive(DEADLINE_S)
        assert news is not None
        assert news[1]["version"] == receipt.seqs[0]
        assert len(tokens) == 4
        false_news.close()


def standing(session: zenoh.Session, key: str) -> set[str]:
    replies = session.liveliness().get(key, timeout=DEADLINE_S)
    return {str(reply.ok.key_expr) for reply in replies if reply.ok is not None}


def test_a_client_without_rights_is_told_that_it_has_none_and_not_that_no_server_is_there(
    endpoint: str, keys: Path
) -> None:
    passed, detail = doctor(endpoint, keys / "stranger" / "client.json5")["reachable"]
    assert not passed
    assert "does the server's access control know this client" in detail


def test_passwords_do_instead_of_clients_certificates_as_the_document_says(keys: Path, tmp_path: Path) -> None:
    of_server, of_client = re.findall(r"```json5\n(.*?)```", DOCUMENT.read_text(), re.DOTALL)
    folder = shutil.copytree(keys / "server", tmp_path / "server")
    config = (folder / "server.json5").read_text()
    for before, after in {
        'root_ca_certificate: "ca.pem",': "",
        "enable_mtls: true,": "",
        "cert_common_names": "usernames",
        "transport: {": "transport: {" + of_server,
    }.items():
        assert before in config
        config = config.replace(before, after)
    (folder / "server.json5").write_text(config)
    (folder / "passwords.txt").write_text("robot-1:a-long-random-word\n")
    known, unknown = folder / "known.json5", folder / "unknown.json5"
    known.write_text(of_client)
    unknown.write_text(of_client.replace("a-long", "another"))
    with serving(folder / "server.json5", tmp_path / "data") as endpoint:
        with Client(endpoint, timeout_s=DEADLINE_S, zenoh_config=known) as robot:
            assert robot.info()["tasks"] == []
        passed, detail = doctor(endpoint, unknown)["reachable"]
        assert not passed
        assert "are user and password?" in detail


def test_the_recipe_keeps_what_protects_the_server(keys: Path) -> None:
    recipe, usual = _config(None, keys / "server" / "server.json5"), _config(None, None)
    for name in (
        "transport/link/tx/lease",
        "transport/link/tx/queue/congestion_control/block/wait_before_close",
        "transport/link/rx/max_message_size",
        "transport/unicast/accept_timeout",
    ):
        assert recipe.get_json(name) == usual.get_json(name)
    assert json.loads(recipe.get_json("listen/endpoints")) == ["tls/127.0.0.1:7447"]
