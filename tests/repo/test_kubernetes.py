"""The Kubernetes manifests fit the published schemas, and their containers run commands that exist."""

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import kubernetes_validate
import pytest
import yaml

MANIFESTS = sorted((Path(__file__).parents[2] / "deploy" / "kubernetes").glob("*.yaml"))
WIDE = {**os.environ, "COLUMNS": "200"}
VERSION = kubernetes_validate.latest_version()


def documents(path: Path) -> list[dict[str, Any]]:
    return [document for document in yaml.safe_load_all(path.read_text()) if document is not None]


def pod_templates(node: Any) -> list[dict[str, Any]]:
    """Templates of pods anywhere in a document."""
    if isinstance(node, list):
        return [found for each in node for found in pod_templates(each)]
    if not isinstance(node, dict):
        return []
    own = [node["template"]] if "containers" in node.get("template", {}).get("spec", {}) else []
    return own + [found for each in node.values() for found in pod_templates(each)]


@pytest.mark.parametrize("path", MANIFESTS, ids=lambda path: path.stem)
def test_manifests_fit_the_schemas(path: Path) -> None:
    """A resource of an operator has no schema here; the pods in it have."""
    for document in documents(path):
        if document["apiVersion"].startswith("ray.io/"):
            for number, template in enumerate(pod_templates(document)):
                pod = {
                    "apiVersion": "v1",
                    "kind": "Pod",
                    "metadata": {"name": f"pod-{number}"},
                    "spec": template["spec"],
                }
                kubernetes_validate.validate(pod, VERSION, strict=True)
        else:
            kubernetes_validate.validate(document, VERSION, strict=True)


def test_a_misspelt_field_is_found() -> None:
    pod = {"apiVersion": "v1", "kind": "Pod", "metadata": {"name": "pod"}, "spec": {"containers": [{"nmae": "a"}]}}
    with pytest.raises(kubernetes_validate.ValidationError):
        kubernetes_validate.validate(pod, VERSION, strict=True)


def command_lines(path: Path) -> list[list[str]]:
    found = [
        container["args"]
        for document in documents(path)
        for template in pod_templates(document)
        for container in template["spec"]["containers"]
        if "args" in container
    ]
    jobs = [document["spec"]["entrypoint"].split()[1:] for document in documents(path) if document["kind"] == "RayJob"]
    return found + jobs


@pytest.mark.parametrize("path", MANIFESTS, ids=lambda path: path.stem)
def test_every_option_of_a_container_exists(path: Path) -> None:
    lines = command_lines(path)
    assert lines
    for command, *words in lines:
        done = subprocess.run(
            [sys.executable, "-m", "crkr.client", command, "--help"],
            capture_output=True,
            text=True,
            check=True,
            env=WIDE,
        )
        options = {word for word in words if word.startswith("-")}
        assert options <= {word.strip(",|│") for word in done.stdout.split()}
