from __future__ import annotations

import importlib

import click
import pytest

from fleetmap import __version__
from fleetmap_cli.main import VERBS, main


def run(*arguments: str) -> int:
    with pytest.raises(SystemExit) as ended:
        main(arguments)
    assert isinstance(ended.value.code, int)
    return ended.value.code


def test_help_lists_every_verb(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("--help") == 0
    shown = capsys.readouterr().out
    assert all(f"  {verb} " in shown for verb in VERBS)
    assert "Exit codes" in shown


def test_the_version_is_the_packages(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("--version") == 0
    assert __version__ in capsys.readouterr().out


@pytest.mark.parametrize("verb", VERBS)
def test_every_verb_exists_and_its_help_teaches_by_an_example(
    verb: str, capsys: pytest.CaptureFixture[str]
) -> None:
    module, command = VERBS[verb][0].split(":")
    found = getattr(importlib.import_module(f"fleetmap_cli.verbs.{module}"), command)
    assert isinstance(found, click.Command)
    assert run(verb, "--help") == 0
    assert capsys.readouterr().out.startswith(f"Usage: fleetmap {verb}")


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["drive"], "No such command 'drive'"),
        (["map"], "RECORDING and --output"),
        (["map", "x.mcap", "--output", "m", "--antenna-offset", "-1,2"], "is not X,Y,Z"),
        (["localize", "x.mcap", "--trajectory", "t.tum", "--near", "91"], "is not LAT,LON"),
    ],
)
def test_wrong_usage_is_one_line_that_says_where_to_read_on(
    arguments: list[str], complaint: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(*arguments) == 2
    complained = capsys.readouterr().err.strip()
    assert complained.startswith("error: ")
    assert complaint in complained
    assert "--help' shows how" in complained
    assert "\n" not in complained


def test_a_missing_package_is_answered_with_the_extra_that_brings_it(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def not_installed(name: str) -> None:
        raise ModuleNotFoundError(f"No module named 'gtsam' (for {name})", name="gtsam")

    monkeypatch.setattr(importlib, "import_module", not_installed)
    assert run("map", "--help") == 2
    assert "pip install 'fleetmap[mapper]'" in capsys.readouterr().err
