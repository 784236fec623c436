"""What lies in docker/: the files are well formed, fit together, and ask for metrics that there are."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import promql_parser
import pytest
import yaml

from service import operating_system

ROOT = Path(__file__).parents[1]
DOCKER = ROOT / "docker"
MONITORING = DOCKER / "monitoring"


def ran(*command: object) -> None:
    done = subprocess.run([str(part) for part in command], capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stdout + done.stderr


def installed(name: str) -> Path:
    """A tool of the environment that runs the tests."""
    return Path(sys.executable).with_name(name)


def test_the_dockerfile_is_clean():
    ran(installed("hadolint"), DOCKER / "Dockerfile")


def test_the_compose_file_fits_its_schema():
    ran(installed("check-jsonschema"), "--builtin-schema", "vendor.compose-spec", DOCKER / "compose.yaml")


def test_the_kubernetes_objects_are_valid():
    ran(installed("kubernetes-validate"), "--strict", DOCKER / "kubernetes.yaml")


@pytest.mark.parametrize("script", ["entrypoint", "verify"])
def test_the_scripts_can_be_run(script):
    path = DOCKER / script
    assert path.stat().st_mode & 0o111
    shell = path.read_text().splitlines()[0].removeprefix("#!").split()
    ran(*shell, "-n", path)


def test_what_the_dockerfile_copies_is_there_and_not_ignored():
    """.dockerignore leaves everything out and takes some things back in."""
    kept = [line[1:] for line in (ROOT / ".dockerignore").read_text().splitlines() if line.startswith("!")]
    copied = re.findall(r"^COPY (?!--from)(.+) \S+$", (DOCKER / "Dockerfile").read_text(), re.MULTILINE)
    sources = [source for line in copied for source in line.split()]
    assert {"service", "constraints.txt", "docker/entrypoint"} <= set(sources)
    for source in sources:
        assert (ROOT / source).exists(), source
        assert any(source == entry or entry.startswith(f"{source}/") for entry in kept), source
    for entry in kept:
        assert (ROOT / entry).exists(), entry


@pytest.fixture
def entrypoint(tmp_path) -> Callable[..., str]:
    """The container's entrypoint with a root of its own, and a `splatfix` that tells what it is given."""
    if not Path("/lib64/ld-linux-x86-64.so.2").exists():
        pytest.skip("needs the C library of an x86-64 Linux")
    text = (DOCKER / "entrypoint").read_text()
    text = re.sub(r"(=| )/(opt|scenes|tmp)", rf"\1{tmp_path}/\2", text)
    (tmp_path / "scenes").mkdir()
    (tmp_path / "entrypoint").write_text(text)
    told = 'echo "$1 $NUMBA_CPU_NAME $NUMBA_CPU_FEATURES $SPLATFIX_SCENES $(ls "$NUMBA_CACHE_DIR")"'
    made = 'mkdir -p "$NUMBA_CACHE_DIR" && touch "$NUMBA_CACHE_DIR/kernel"'
    (tmp_path / "splatfix").write_text(f'#!/bin/sh\n[ "$1" != doctor ] || {{ {made}; }}\n{told}\n')
    (tmp_path / "splatfix").chmod(0o755)
    environment = {"PATH": f"{tmp_path}:/usr/bin:/bin", "SPLATFIX_CACHE_DIR": str(tmp_path / "cache")}

    def run(*arguments: str, **more: str) -> str:
        command = ["sh", str(tmp_path / "entrypoint"), *arguments]
        done = subprocess.run(command, env=environment | more, capture_output=True, text=True, check=True)
        return done.stdout + done.stderr

    return run


def test_the_entrypoint_runs_the_kernels_that_were_compiled(entrypoint):
    """numba's key is the processor's name and its features: both the same at build and run."""
    assert "are compiled now" in entrypoint("serve")
    compiled = [line.split()[1:3] for line in entrypoint("compile").splitlines() if line.startswith("doctor")]
    if not compiled:
        pytest.skip("this processor has no AVX2")
    command, *key, _, kernels = entrypoint("serve").split()
    assert (command, kernels) == ("serve", "kernel")
    assert key == compiled[0]  # the best comes first
    assert len({name for name, _ in compiled}) == len({features for _, features in compiled}) == len(compiled)


def test_on_arm_the_entrypoint_runs_its_kernels(entrypoint, tmp_path):
    script = tmp_path / "entrypoint"
    script.write_text(script.read_text().replace("/lib64/ld-linux-x86-64.so.2", str(tmp_path / "absent")))
    (tmp_path / "uname").write_text("#!/bin/sh\necho aarch64\n")
    (tmp_path / "uname").chmod(0o755)
    assert "are compiled now" in entrypoint("serve")
    assert "doctor generic +fp-armv8,+neon" in entrypoint("compile")
    assert entrypoint("serve").startswith("serve generic +fp-armv8,+neon")


def test_the_entrypoint_serves_the_demo_where_there_are_no_scenes(entrypoint, tmp_path):
    assert f'["{tmp_path}/opt/splatfix/demo/studio"]' in entrypoint("serve")
    (tmp_path / "scenes" / "mine").mkdir()
    assert f'["{tmp_path}/scenes"]' in entrypoint("serve")
    assert '["elsewhere"]' in entrypoint("serve", SPLATFIX_SCENES='["elsewhere"]')


def compose() -> dict:
    return yaml.safe_load((DOCKER / "compose.yaml").read_text())


def test_files_that_compose_mounts_are_there():
    for service in compose()["services"].values():
        mounted = [str(volume).split(":")[0] for volume in service.get("volumes", [])]
        for path in mounted:
            assert not path.startswith("./") or (DOCKER / path).exists(), path


def test_the_service_has_no_way_out():
    """Only the gateway and Grafana publish a port, and only they are in a network that leads out."""
    found = compose()
    assert found["networks"]["inside"] == {"internal": True}
    for name, service in found["services"].items():
        if name not in ("gateway", "grafana"):
            assert list(service["networks"]) == ["inside"], name
            assert "ports" not in service, name


def test_nothing_runs_as_root_or_writes_to_its_image():
    for name, service in compose()["services"].items():
        assert service["read_only"], name
        assert service["cap_drop"] == ["ALL"], name
        assert service["mem_limit"], name
        assert service["cpus"], name
    user = re.findall(r"^USER (.+)$", (DOCKER / "Dockerfile").read_text(), re.MULTILINE)
    assert user == ["10001:10001"]


def queries() -> list[str]:
    board = json.loads((MONITORING / "grafana" / "splatfix.json").read_text())
    shown = [target["expr"] for panel in board["panels"] for target in panel["targets"]]
    rules = yaml.safe_load((MONITORING / "alerts.yaml").read_text())
    return shown + [rule["expr"] for group in rules["groups"] for rule in group["rules"]]


def test_dashboard_and_alerts_ask_for_metrics_that_the_service_has(plugins):
    """Parsed as Prometheus would; names as /metrics has them."""
    from api_server import create_app, serving
    from api_server import settings as few
    from stand_ins import make_scene

    with serving(create_app(few(), {"room": make_scene()})) as client:
        told = client.get("/metrics").text
    families = set(re.findall(r"^# TYPE (\S+) ", told, re.MULTILINE))
    for query in queries():
        promql_parser.parse(query.replace("$__rate_interval", "5m"))
        names = set(re.findall(r"\b((?:splatfix|process)_\w+)", query))
        assert names or "up{" in query
        for name in names:
            assert name in families or re.sub("_(bucket|sum|count)$", "", name) in families, name
    with pytest.raises(ValueError, match="parenthes"):
        promql_parser.parse("sum(rate(x[5m])")


@pytest.mark.parametrize(
    ("text", "expected"), [("max 100000", 64), ("200000 100000", 2), ("50000 100000", 1), ("nonsense", 64)]
)
def test_workers_follow_the_containers_share_of_processors(text, expected, tmp_path, monkeypatch):
    quota = tmp_path / "cpu.max"
    quota.write_text(text)
    monkeypatch.setattr(operating_system, "_CPU_QUOTA", quota)
    monkeypatch.setattr(operating_system.os, "sched_getaffinity", lambda pid: set(range(64)), raising=False)
    assert operating_system.available_cores() == expected


def test_nginx_takes_the_gateways_configuration(tmp_path):
    """With the names of Docker replaced, since nginx looks them up."""
    nginx = shutil.which("nginx")
    if not nginx:
        pytest.skip("there is no nginx on this machine")
    shutil.copy(DOCKER / "nginx" / "splatfix.conf", tmp_path)
    gateway = (DOCKER / "nginx" / "gateway.conf").read_text().replace("/etc/nginx", str(tmp_path))
    main = f"pid {tmp_path}/pid; error_log stderr; events {{}} http {{ access_log off; {gateway} }}"
    (tmp_path / "nginx.conf").write_text(main)
    ran(nginx, "-t", "-p", tmp_path, "-c", tmp_path / "nginx.conf")


def test_the_fleet_on_kubernetes_is_valid(tmp_path):
    """As `kubectl` builds it; what is patched is what the fleet needs otherwise."""
    kubectl = shutil.which("kubectl")
    if not kubectl:
        pytest.skip("there is no kubectl on this machine")
    built = subprocess.run([kubectl, "kustomize", str(DOCKER)], capture_output=True, text=True, check=True).stdout
    (tmp_path / "fleet.yaml").write_text(built)
    ran(installed("kubernetes-validate"), "--strict", tmp_path / "fleet.yaml")
    found = {(item["kind"], item["metadata"]["name"]): item for item in yaml.safe_load_all(built)}
    front = found["Deployment", "splatfix"]["spec"]
    assert (front["replicas"], front["strategy"]["type"]) == (2, "RollingUpdate")
    volumes = {volume["name"]: volume for volume in front["template"]["spec"]["volumes"]}
    assert volumes["jobs"] == {"name": "jobs", "emptyDir": {"sizeLimit": "4Gi"}}
    assert ("PersistentVolumeClaim", "splatfix-jobs") not in found
    images = set()
    for (kind, name), item in found.items():
        if kind != "Deployment":
            continue
        pod = item["spec"]["template"]
        assert pod["metadata"]["labels"]["app.kubernetes.io/part-of"] == "splatfix-fleet", name
        (container,) = pod["spec"]["containers"]
        images.add(container["image"])
        mounted = {mount["name"] for mount in container["volumeMounts"]}
        assert mounted == {volume["name"] for volume in pod["spec"]["volumes"]}, name
        assert container["securityContext"]["readOnlyRootFilesystem"], name
    assert images == {"splatfix:fleet"}


def test_processes_of_ray_run_the_kernels_of_the_image(entrypoint, tmp_path):
    (tmp_path / "ray").write_text('#!/bin/sh\necho "ray $* $NUMBA_CPU_NAME"\n')
    (tmp_path / "ray").chmod(0o755)
    compiled = [line.split()[1] for line in entrypoint("compile").splitlines() if line.startswith("doctor")]
    if not compiled:
        pytest.skip("this processor has no AVX2")
    assert entrypoint("ray", "start", "--head").split() == ["ray", "start", "--head", compiled[0]]
