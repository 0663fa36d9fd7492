"""``fleetmap demo``'s options, and the processes that it starts; all of it together is tested end to end."""

from __future__ import annotations

import urllib.request
from pathlib import Path

import pytest

from fleetmap.errors import RunError
from fleetmap_cli.demo_processes import run_verb, running_map_server


def test_help_says_what_is_shown(fleetmap):
    code, out, _ = fleetmap("demo", "--help")
    assert code == 0
    for word in ("simulated street", "UTM", "Zenoh", "HTTP", "truth", "fleetmap_demo.png", "--keep", "Example"):
        assert word in out


@pytest.mark.parametrize(
    ("arguments", "code", "told"),
    [
        (["--output", "picture.txt"], 2, "cannot draw picture.txt: the name must end in .png, .pdf, .svg"),
        (["--output", "folder.png"], 2, "cannot draw folder.png: it is a folder; name a file in it"),
        (["--output", "away/picture.png"], 1, "cannot write away/picture.png: its folder is not there"),
        (["--keep", "full"], 2, "full exists already and is no empty folder; give another name to --keep"),
        (["--keep", "full/file"], 2, "full/file exists already and is no empty folder"),
        (["--keep", "away/kept"], 1, "cannot write away/kept: its folder is not there"),
    ],
)
def test_what_could_not_be_written_in_the_end_is_told_at_once(
    fleetmap, tmp_path, monkeypatch, arguments, code, told
):
    monkeypatch.chdir(tmp_path)
    for folder in ("full", "folder.png"):
        (tmp_path / folder).mkdir()
    (tmp_path / "full" / "file").touch()
    ended, out, err = fleetmap("demo", *arguments)
    assert (ended, out) == (code, "")
    assert err.startswith(f"error: {told}")
    assert err.count("\n") == 1
    assert sorted(item.name for item in tmp_path.iterdir()) == ["folder.png", "full"]


@pytest.mark.parametrize("arguments", [["--length-m", "5"], ["--length-m", "501"], ["--seed", "-1"]])
def test_a_street_that_cannot_be_built_is_a_usage_error(fleetmap, tmp_path, monkeypatch, arguments):
    monkeypatch.chdir(tmp_path)
    code, out, err = fleetmap("demo", *arguments)
    assert (code, out) == (2, "")
    assert arguments[0] in err
    assert list(tmp_path.iterdir()) == []


def test_a_map_server_answers_while_the_block_runs_and_not_after(tmp_path: Path) -> None:
    with (
        running_map_server("store", tmp_path) as server,
        urllib.request.urlopen(f"{server.http_url}/healthz", timeout=5) as answer,
    ):
        assert answer.status == 200
    with pytest.raises(OSError, match="refused"):
        urllib.request.urlopen(f"{server.http_url}/healthz", timeout=5)


def test_a_server_that_does_not_start_is_told(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "store").touch()
    with pytest.raises(RunError, match="'fleetmap serve' did not start"), running_map_server("store", tmp_path):
        pass
    assert "'store' is a file" in capfd.readouterr().err


def test_a_verb_that_fails_is_shown_with_what_it_said(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(RunError, match="'fleetmap publish' ended with exit code 2"):
        run_verb(["publish", "no map"], tmp_path)
    out, err = capfd.readouterr()
    assert out == "$ fleetmap publish 'no map'\n"
    assert err.startswith("error: ")
