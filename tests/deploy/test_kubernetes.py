"""deploy/kubernetes.yaml asks for nothing that the service and its image do not offer."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
import yaml

from app.main import create_app
from app.settings import ENV_PREFIX, Settings, load_settings

ROOT = Path(__file__).parents[2]
DOCKERFILE = (ROOT / "Dockerfile").read_text()
NAME = {"app.kubernetes.io/name": "posematch"}


@pytest.fixture(scope="module")
def objects() -> dict[str, dict[str, Any]]:
    """The manifest's objects by kind; each kind occurs once."""
    documents = list(yaml.safe_load_all((ROOT / "deploy" / "kubernetes.yaml").read_text()))
    by_kind = {document["kind"]: document for document in documents}
    assert len(by_kind) == len(documents)
    return by_kind


@pytest.fixture(scope="module")
def pod(objects: dict[str, dict[str, Any]]) -> dict[str, Any]:
    spec: dict[str, Any] = objects["Deployment"]["spec"]["template"]["spec"]
    return spec


@pytest.fixture(scope="module")
def container(pod: dict[str, Any]) -> dict[str, Any]:
    (only,) = pod["containers"]
    assert isinstance(only, dict)
    return only


@pytest.fixture(scope="module")
def variables(
    objects: dict[str, dict[str, Any]], container: dict[str, Any]
) -> dict[str, str | None]:
    """The container's environment; None where a secret gives the value."""
    shared: dict[str, str | None] = objects["ConfigMap"]["data"]
    return shared | {item["name"]: item.get("value") for item in container["env"]}


def test_every_variable_is_a_setting_and_its_value_is_accepted(
    variables: dict[str, str | None], monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in variables.items():
        assert name.startswith(ENV_PREFIX)
        monkeypatch.setenv(name, value or "a-key-of-thirty-two-characters-00")
    settings = load_settings()
    for name, value in variables.items():
        assert name.removeprefix(ENV_PREFIX).lower() in Settings.model_fields
        assert isinstance(value, str | None), "Kubernetes takes text alone"
    assert settings.host == "0.0.0.0"


def test_kubernetes_adds_no_variables_of_its_own(
    objects: dict[str, dict[str, Any]], pod: dict[str, Any]
) -> None:
    """A Service called posematch is announced as POSEMATCH_PORT=tcp://…, which is no port."""
    assert objects["Service"]["metadata"]["name"].upper() + "_" == ENV_PREFIX
    assert pod["enableServiceLinks"] is False


def test_the_probes_ask_what_the_service_answers(
    container: dict[str, Any], variables: dict[str, str | None]
) -> None:
    paths = set(create_app(Settings()).openapi()["paths"])
    ports = {port["name"]: port["containerPort"] for port in container["ports"]}
    asked = {}
    for kind in ("startupProbe", "readinessProbe", "livenessProbe"):
        probe = container[kind]["httpGet"]
        asked[kind] = probe["path"]
        assert probe["path"] in paths
        assert str(ports[probe["port"]]) == variables["POSEMATCH_PORT"]
    assert asked["livenessProbe"] == "/livez", "a service that is loading must not be restarted"
    assert asked["startupProbe"] == asked["readinessProbe"] == "/readyz"
    startup = container["startupProbe"]
    assert startup["periodSeconds"] * startup["failureThreshold"] >= 300, "the library is built"


def test_the_scraper_is_led_to_the_metrics(
    objects: dict[str, dict[str, Any]], variables: dict[str, str | None]
) -> None:
    annotations = objects["Deployment"]["spec"]["template"]["metadata"]["annotations"]
    assert annotations["prometheus.io/path"] in create_app(Settings()).openapi()["paths"]
    assert annotations["prometheus.io/port"] == variables["POSEMATCH_PORT"]


def test_the_objects_find_each_other(objects: dict[str, dict[str, Any]]) -> None:
    deployment = objects["Deployment"]
    labels = deployment["spec"]["template"]["metadata"]["labels"]
    assert labels == NAME
    assert deployment["spec"]["selector"]["matchLabels"] == NAME
    assert objects["Service"]["spec"]["selector"] == NAME
    assert objects["PodDisruptionBudget"]["spec"]["selector"]["matchLabels"] == NAME
    target = objects["HorizontalPodAutoscaler"]["spec"]["scaleTargetRef"]
    assert target == {
        "apiVersion": deployment["apiVersion"],
        "kind": "Deployment",
        "name": deployment["metadata"]["name"],
    }
    (source,) = deployment["spec"]["template"]["spec"]["containers"][0]["envFrom"]
    assert source["configMapRef"]["name"] == objects["ConfigMap"]["metadata"]["name"]
    assert "replicas" not in deployment["spec"], "each apply would undo the autoscaler's work"


def test_the_pod_fits_the_image(
    pod: dict[str, Any], container: dict[str, Any], variables: dict[str, str | None]
) -> None:
    user = re.search(r"^USER (\d+)$", DOCKERFILE, re.MULTILINE)
    assert user is not None
    assert pod["securityContext"]["runAsUser"] == int(user[1])
    assert 'ENTRYPOINT ["posematch"]' in DOCKERFILE
    assert container["args"] == ["serve"]
    mounted = {mount["mountPath"]: mount["name"] for mount in container["volumeMounts"]}
    assert set(mounted.values()) == {volume["name"] for volume in pod["volumes"]}
    assert variables["POSEMATCH_CACHE_DIR"] in mounted, "the root file system is read-only"


def test_workers_have_cores_and_answers_have_time(
    pod: dict[str, Any], container: dict[str, Any], variables: dict[str, str | None]
) -> None:
    limits, requests = container["resources"]["limits"], container["resources"]["requests"]
    assert limits["cpu"] == requests["cpu"] == variables["POSEMATCH_WORKERS"]
    pause_s = int(container["lifecycle"]["preStop"]["exec"]["command"][1])
    grace_s = int(variables["POSEMATCH_SHUTDOWN_GRACE_S"] or 0)
    readiness = container["readinessProbe"]
    assert pause_s >= readiness["periodSeconds"] * readiness["failureThreshold"]
    assert pod["terminationGracePeriodSeconds"] > pause_s + grace_s
