"""The protocol's page, where only a server can say whether it is right: its example, and its table of problems."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

from fleetmap.transport import MapClient, protocol
from fleetmap_server import problems

TEXT = Path(protocol.__file__).with_name("PROTOCOL.md").read_text()


def run_example(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    (code,) = re.findall(r"^```python\n(.*?)^```$", TEXT, flags=re.MULTILINE | re.DOTALL)
    assert "fleetmap" not in re.findall(r"import (\w+)", code)
    (folder / "example.py").write_text(code)
    command = [sys.executable, "-W", "error", str(folder / "example.py"), *arguments]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=60, check=False)


def test_the_example_talks_to_a_real_server(server, tmp_path, make_map):
    ran = run_example(tmp_path, server.zenoh_endpoint)
    assert (ran.stdout, ran.stderr, ran.returncode) == ("", "", 0)
    with MapClient(server.zenoh_endpoint) as client:
        way = tuple((8.0 + number / 80_000, 49.0) for number in range(10_000))
        one = make_map(part_sizes=(1000, 2000, 3000), path_lonlat=way)
        assert len(one.manifest_bytes) > protocol.CHUNK_BYTES
        client.publish(one.manifest_bytes, one.parts.__getitem__)
    ran = run_example(tmp_path, server.zenoh_endpoint)
    assert ran.stdout.splitlines() == ["karlsruhe version 1, 4000 landmarks", "manifest: 3 parts"]
    assert (ran.stderr, ran.returncode) == ("", 0)


def test_every_problem_is_documented_with_its_status():
    told = set(re.findall(r"^\| (\d{3}) \| `([a-z-]+)` \|", TEXT, flags=re.MULTILINE))
    assert told == {(str(status), name) for _, status, name, _ in problems._PROBLEMS}
    assert f"`{protocol.PROBLEM_TYPE_PREFIX}`" in TEXT
