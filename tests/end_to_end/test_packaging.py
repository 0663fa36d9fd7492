"""Container files name services, extras, verbs and options that exist; nothing here needs a container engine."""

from __future__ import annotations

import re
import subprocess
import tomllib
from pathlib import Path
from typing import Any

import click
import pytest
from ruamel.yaml import YAML

from fleetmap_cli.main import VERBS, cli

ROOT = Path(__file__).resolve().parents[2]
DOCKERFILE = (ROOT / "services" / "Dockerfile").read_text()
CI = ROOT / ".ci" / "run"
SERVICES = {"mapper", "server", "localizer"}


def extras() -> dict[str, list[str]]:
    with (ROOT / "pyproject.toml").open("rb") as file:
        found: dict[str, list[str]] = tomllib.load(file)["project"]["optional-dependencies"]
    return found


@pytest.fixture(scope="module")
def compose() -> dict[str, Any]:
    loaded: dict[str, Any] = YAML(typ="safe").load(ROOT / "docker-compose.yml")
    return loaded["services"]


def test_every_service_of_the_dockerfile_is_an_extra_with_a_package_of_its_own() -> None:
    offered = re.search(r'case "\$SERVICE" in ([a-z|]+)\)', DOCKERFILE)
    assert offered is not None
    assert set(offered[1].split("|")) == SERVICES
    assert set(extras()) >= SERVICES
    assert all((ROOT / "services" / f"fleetmap_{service}" / "__init__.py").is_file() for service in SERVICES)


def test_every_verb_names_an_extra_that_exists() -> None:
    assert {extra for _, _, extra in VERBS.values()} <= set(extras())


def test_the_dockerfile_copies_what_exists_and_what_the_ignore_file_lets_through() -> None:
    copied = [line.split()[1:-1] for line in DOCKERFILE.splitlines() if line.startswith("COPY ")]
    let_through = (ROOT / "services" / "Dockerfile.dockerignore").read_text().splitlines()
    for name in (name for names in copied for name in names):
        assert (ROOT / name).exists()
        assert f"!{name}" in let_through


def test_the_image_runs_the_command_line_as_an_ordinary_user() -> None:
    lines = DOCKERFILE.splitlines()
    assert 'ENTRYPOINT ["fleetmap"]' in lines
    assert lines.index("USER fleetmap") < lines.index('ENTRYPOINT ["fleetmap"]')
    assert 'RUN pip install --no-cache-dir ".[${SERVICE}]"' in lines


@pytest.mark.parametrize(("name", "service"), [("map-server", "server"), ("mapper-agent", "mapper")])
def test_composed_services_run_verbs_with_options_that_exist(
    compose: dict[str, Any], name: str, service: str
) -> None:
    build, words = compose[name]["build"], compose[name]["command"]
    assert (ROOT / build["context"] / build["dockerfile"]).is_file()
    assert build["args"]["SERVICE"] == service
    verb, *arguments = words
    assert VERBS[verb][2] == service
    command = cli.get_command(click.Context(cli), verb)
    assert command is not None
    known = {option for parameter in command.params for option in parameter.opts}
    given = [word for word in arguments if word.startswith("--")]
    assert given
    assert set(given) <= known


def test_folders_ports_and_endpoints_of_the_composed_services_fit_together(compose: dict[str, Any]) -> None:
    server, agent = compose["map-server"], compose["mapper-agent"]
    assert _value(server, "--store") == server["volumes"][0].split(":")[1]
    assert _value(agent, "--watch") == agent["volumes"][0].split(":")[1]
    ports = {port.split(":")[1] for port in server["ports"]}
    assert ports == {_value(server, "--zenoh").split(":")[-1], _value(server, "--http").split(":")[-1]}
    assert _value(agent, "--server") == f"tcp/map-server:{_value(server, '--zenoh').split(':')[-1]}"
    assert f":{_value(server, '--http').split(':')[-1]}/readyz" in server["healthcheck"]["test"][-1]
    assert agent["depends_on"] == {"map-server": {"condition": "service_healthy"}}


def _value(service: dict[str, Any], option: str) -> str:
    words: list[str] = service["command"]
    return words[words.index(option) + 1]


def test_the_health_check_is_python_that_compiles(compose: dict[str, Any]) -> None:
    compile(compose["map-server"]["healthcheck"]["test"][-1], "healthcheck", "exec")


def test_ci_checks_every_service_in_a_clean_environment_and_is_a_sound_script() -> None:
    checked = re.findall(r"^check_service (\w+) fleetmap_(\w+) (\w+)", CI.read_text(), flags=re.MULTILINE)
    assert {extra for extra, _, _ in checked} == SERVICES
    for extra, package, verb in checked:
        assert package == extra
        assert VERBS[verb][2] == extra
    assert subprocess.run(["bash", "-n", str(CI)], check=False).returncode == 0
