"""The check of crash safety, with few kills; and that it sees what it is meant to see."""

from __future__ import annotations

import re

from fleetmap_cli.benchmarks import server_kills


def test_a_server_killed_at_any_instant_loses_nothing(fleetmap):
    code, out, _ = fleetmap("benchmark", "server", "--kills", 20)
    assert out.rstrip().splitlines()[-1] == "20 kills: 0 lost, 0 half-visible maps"
    assert code == 0
    assert len(re.findall(r"\d+ in ", out)) >= 3  # several kinds of operation


def test_a_server_that_forgets_is_found_out(fleetmap, monkeypatch):
    start = server_kills._Site._start

    def start_with_less(site) -> None:
        blobs = sorted((site._settings.store / "blobs").glob("*/*"))
        if site._report.kills == 3:
            blobs[0].unlink()
        start(site)

    monkeypatch.setattr(server_kills._Site, "_start", start_with_less)
    code, out, _ = fleetmap("benchmark", "server", "--kills", 4)
    assert code == 1
    assert re.search(r"4 kills: \d+ lost, [1-9]\d* half-visible maps$", out.rstrip())


def test_kills_are_for_the_server_only(fleetmap):
    code, _, err = fleetmap("benchmark", "drives", "--kills", 1)
    assert (code, "--kills goes with" in err) == (2, True)
