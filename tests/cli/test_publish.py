"""``fleetmap publish`` as a user types it, to a server in another process."""

from __future__ import annotations

import json

from fleetmap.manifest import manifest_version


def test_a_package_is_published_and_again_without_harm(fleetmap, map_package, map_server):
    manifest = (map_package / "manifest.json").read_bytes()
    map_id, version = json.loads(manifest)["map_id"], manifest_version(manifest)
    for _ in range(2):
        code, out, err = fleetmap("publish", map_package, "--server", map_server)
        assert code == 0, err
        assert out.startswith(f"published {map_id}  version {version[:12]}  ")
        assert out.endswith(" MB\n")
        assert "error" not in err
        assert "warning" not in err


def test_a_tampered_part_is_named_and_nothing_is_sent(fleetmap, map_package, map_server):
    part = sorted((map_package / "parts").iterdir())[1]
    data = bytearray(part.read_bytes())
    data[-1] ^= 1
    part.write_bytes(data)
    code, out, err = fleetmap("publish", map_package, "--server", map_server)
    assert (code, out) == (2, "")
    assert err.startswith("error: ")
    assert part.name in err
    assert err.count("\n") == 1
    assert fleetmap("maps", "list", "--server", map_server)[1] == "no maps\n"


def test_a_map_not_fit_to_publish_is_sent_with_a_warning(fleetmap, map_package, map_server):
    path = map_package / "manifest.json"
    manifest = json.loads(path.read_bytes())
    manifest["quality"] |= {"publishable": False, "warnings": ["too few landmarks", "gaps"]}
    path.write_text(json.dumps(manifest))
    code, out, err = fleetmap("publish", map_package, "--server", map_server)
    assert (code, out[:10]) == (0, "published ")
    assert f"warning: map '{manifest['map_id']}' should not be published: too few landmarks; gaps" in err
    assert "not fit to publish" in fleetmap("maps", "list", "--server", map_server)[1]


def test_a_folder_that_is_no_package_is_bad_input(fleetmap, tmp_path, absent_server):
    code, _, err = fleetmap("publish", tmp_path / "nothing", "--server", absent_server)
    assert code == 2
    assert "nothing" in err
    (tmp_path / "empty").mkdir()
    assert fleetmap("publish", tmp_path / "empty", "--server", absent_server)[0] == 2


def test_an_absent_server_is_one_line(fleetmap, map_package, absent_server):
    code, out, err = fleetmap("publish", map_package, "--server", absent_server)
    assert (code, out) == (1, "")
    assert err.splitlines()[-1].startswith(f"error: no map server answers at {absent_server}; ")


def test_an_endpoint_that_is_none_is_a_usage_error(fleetmap, map_package):
    code, _, err = fleetmap("publish", map_package, "--server", "localhost")
    assert code == 2
    assert "'localhost' is no Zenoh endpoint" in err
