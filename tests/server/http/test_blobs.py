"""Blobs over HTTP: whole, in part, not again, never damaged or secret ones; from a folder and a bucket."""

from __future__ import annotations

import base64
import hashlib
import json
import tracemalloc
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest

from fleetmap.transport.protocol import BeginRequest
from fleetmap_server.access import read_access
from fleetmap_server.http.app import create_app
from fleetmap_server.library import MapLibrary, open_library
from fleetmap_server.settings import ServerSettings

IMMUTABLE = "public, max-age=31536000, immutable"


@pytest.fixture
def library(store_url: str, tmp_path: Path) -> Iterator[MapLibrary]:
    catalogue = f"sqlite:///{tmp_path / 'catalogue.sqlite'}"
    with open_library(ServerSettings(store=store_url, catalogue=catalogue)) as library:
        yield library


@pytest.fixture
def folder_library(tmp_path: Path) -> Iterator[MapLibrary]:
    with open_library(ServerSettings(store=tmp_path / "store")) as library:
        yield library


def digest(data: bytes) -> str:
    return f"sha-256=:{base64.b64encode(hashlib.sha256(data).digest()).decode()}:"


def test_a_part_comes_whole_in_part_and_not_again(web, library, publish, make_map):
    """All of HTTP's ways of asking for one blob; compared with slices of its bytes."""
    one = make_map(part_sizes=(9_000_000,))
    publish(library, one)
    ((sha256, data),) = one.parts.items()
    path, size = f"/maps/karlsruhe/parts/{sha256}", len(data)

    whole = web.get(path)
    assert (whole.status_code, whole.content) == (200, data)
    assert whole.headers["etag"] == f'"{sha256}"'
    assert whole.headers["cache-control"] == IMMUTABLE
    assert whole.headers["accept-ranges"] == "bytes"
    assert whole.headers["content-digest"] == whole.headers["repr-digest"] == digest(data)
    assert web.get(f"/blobs/{sha256}").content == data

    head = web.head(path)
    assert (head.status_code, head.content, head.headers["content-length"]) == (200, b"", str(size))
    assert head.headers["etag"] == whole.headers["etag"]
    assert "content-digest" not in head.headers  # of no content

    for asked, start, end in (
        ("bytes=0-0", 0, 1),
        ("bytes=5-14", 5, 15),
        (f"bytes={size - 3}-", size - 3, size),
        ("bytes=-7", size - 7, size),
        (f"bytes=-{10 * size}", 0, size),
        (f"bytes=1000-{10**30}", 1000, size),  # longer than what is digested twice
        ("Bytes = 2 - 4", 2, 5),
    ):
        part = web.get(path, headers={"Range": asked})
        assert (part.status_code, part.content) == (206, data[start:end]), asked
        assert part.headers["content-range"] == f"bytes {start}-{end - 1}/{size}"
        assert part.headers["repr-digest"] == digest(data)
        assert part.headers.get("content-digest", digest(data[start:end])) == digest(data[start:end])
    assert web.get(path, headers={"Range": "bytes=5-14"}).headers["content-digest"] == digest(data[5:15])

    for ignored in ("bytes=0-1,5-6", "bytes=9-5", "bytes=-", "bytes=x-y", "lines=1-2", "bytes=1", "bytes=--5"):
        assert web.get(path, headers={"Range": ignored}).content == data, ignored
    for nothing in (f"bytes={size}-", "bytes=-0", f"bytes={10**30}-"):
        refused = web.get(path, headers={"Range": nothing})
        assert (refused.status_code, refused.headers["content-range"]) == (416, f"bytes */{size}"), nothing
        assert refused.headers["content-type"] == "application/problem+json"

    some = {"Range": "bytes=5-14"}
    assert web.get(path, headers={**some, "If-Range": f'"{sha256}"'}).status_code == 206
    for other in (f'W/"{sha256}"', '"other"', "Wed, 21 Oct 2015 07:28:00 GMT"):
        assert web.get(path, headers={**some, "If-Range": other}).content == data

    for known in (f'"{sha256}"', f'W/"{sha256}"', f'"a", "{sha256}"', "*"):
        unchanged = web.get(path, headers={"If-None-Match": known, **some})
        assert (unchanged.status_code, unchanged.content) == (304, b"")
        assert unchanged.headers["cache-control"] == IMMUTABLE
    assert web.get(path, headers={"If-None-Match": '"other"'}).content == data


def test_manifests_are_kept_for_ever_only_by_their_hash(web, library, publish, make_map):
    first, second = make_map(seed=1, part_sizes=(10,)), make_map(seed=2, part_sizes=(10,))
    publish(library, first)
    publish(library, second)
    path = "/maps/karlsruhe/manifest.json"
    latest = web.get(path)
    assert (latest.content, latest.headers["cache-control"]) == (second.manifest_bytes, "no-cache")
    assert latest.headers["etag"] == f'"{second.version}"'
    assert web.get(path, params={"version": "1"}).content == first.manifest_bytes
    exact = web.get(path, params={"version": first.version})
    assert (exact.content, exact.headers["cache-control"]) == (first.manifest_bytes, IMMUTABLE)
    tag = {"If-None-Match": latest.headers["etag"]}
    assert web.get(path, headers=tag).status_code == 304
    publish(library, make_map(seed=3, part_sizes=(10,)))
    assert web.get(path, headers=tag).status_code == 200


def test_only_what_is_published_and_not_retired_is_handed_out(web, library, publish, make_map):
    first, second = make_map(seed=1, part_sizes=(10,)), make_map(seed=2, part_sizes=(20,))
    publish(library, first)
    publish(library, second)
    (old,), (new,) = first.parts, second.parts
    for sha256 in (old, new, first.version, second.version):
        assert web.get(f"/blobs/{sha256}").status_code == 200
    library.retire("karlsruhe", 1)
    for gone in (f"/blobs/{old}", f"/blobs/{first.version}", f"/maps/karlsruhe/parts/{old}"):
        assert web.get(gone).status_code == 404, gone
    assert web.get("/maps/karlsruhe/manifest.json?version=1").status_code == 410
    assert web.get(f"/blobs/{new}").status_code == 200

    waiting = make_map(map_id="waiting", seed=3, part_sizes=(30,))
    request = BeginRequest(version=waiting.version, size_bytes=len(waiting.manifest_bytes))
    library.begin(request)
    library.receive(waiting.version, waiting.version, request.size_bytes, 0, waiting.manifest_bytes)
    assert web.get(f"/blobs/{waiting.version}").status_code == 404

    for path in ("/blobs/x", f"/blobs/{64 * '0'}", f"/maps/other/parts/{new}", "/maps/none/trajectory.geojson"):
        answer = web.get(path)
        assert (answer.status_code, answer.headers["content-type"]) == (404, "application/problem+json"), path


def test_the_trajectory_is_cut_where_it_crosses_180_degrees(web, library, publish, make_map):
    publish(library, make_map(part_sizes=(10,), path_lonlat=((179.8, 10.0), (179.9, 10.1), (-179.9, 10.3))))
    answer = web.get("/maps/karlsruhe/trajectory.geojson")
    assert answer.headers["content-type"] == "application/geo+json"
    feature = answer.json()
    assert feature["bbox"] == [179.8, 10.0, -179.9, 10.3]
    assert feature["geometry"]["type"] == "MultiLineString"
    west, east = feature["geometry"]["coordinates"]
    assert west == [[179.8, 10.0], [179.9, 10.1], [180.0, pytest.approx(10.2)]]
    assert east == [[-180.0, pytest.approx(10.2)], [-179.9, 10.3]]
    assert json.loads(answer.content)["properties"]["version"] == library.entry("karlsruhe").version
    again = web.get("/maps/karlsruhe/trajectory.geojson", headers={"If-None-Match": answer.headers["etag"]})
    assert (again.status_code, again.content) == (304, b"")


def test_large_blobs_pass_through_little_memory(folder_library, publish, make_map, serving):
    one = make_map(part_sizes=(24_000_000,))
    publish(folder_library, one)
    (sha256,) = one.parts
    del one
    with serving(create_app(folder_library)) as address:
        tracemalloc.start()
        try:
            hashed = hashlib.sha256()
            with httpx.stream("GET", f"{address}/blobs/{sha256}") as answer:
                for piece in answer.iter_raw(65_536):
                    hashed.update(piece)
            _, peak_bytes = tracemalloc.get_traced_memory()
        finally:
            tracemalloc.stop()
    assert hashed.hexdigest() == sha256
    assert peak_bytes < 8_000_000


def test_a_blob_that_rotted_on_the_disk_is_a_problem_not_bytes(folder_library, publish, make_map, serving):
    one = make_map(part_sizes=(10_000,))
    publish(folder_library, one)
    ((sha256, data),) = one.parts.items()
    with serving(create_app(folder_library)) as address:
        assert httpx.get(f"{address}/blobs/{sha256}").content == data
        folder_library.blobs.local_path(sha256).write_bytes(data[:-1] + b"?")
        answer = httpx.get(f"{address}/blobs/{sha256}")
    assert answer.status_code == 500
    assert "damaged" in answer.json()["detail"]


@pytest.fixture
def guarded(folder_library: MapLibrary, publish, make_map, serving, tmp_path: Path) -> Iterator[str]:
    """The address of a server where two tokens count."""
    publish(folder_library, make_map(part_sizes=(10,)))
    file = tmp_path / "access"
    lines = [
        f"{role} {name} {hashlib.sha256(token.encode()).hexdigest()}"
        for role, name, token in (("read", "vehicle", "see"), ("write", "mapper", "change"))
    ]
    file.write_text("\n".join(lines))
    with serving(create_app(folder_library, read_access(file))) as address:
        yield address


def test_a_token_decides_and_caches_that_others_share_keep_nothing(guarded):
    path = f"{guarded}/maps/karlsruhe/manifest.json"
    refused = httpx.get(path)
    assert refused.status_code == 401
    assert {"Bearer", "Basic"} <= {word.split(" ")[0] for word in refused.headers["www-authenticate"].split(", ")}
    assert httpx.get(path, headers={"Authorization": "Bearer wrong"}).status_code == 401
    assert httpx.get(path, headers={"Authorization": "Bearer see"}).status_code == 200
    answer = httpx.get(path, auth=("anybody", "see"))
    assert answer.status_code == 200
    assert answer.headers["cache-control"].startswith("private")
    for accept in ("*/*", "text/html"):
        for path in ("/", "/collections", "/metrics", "/api"):
            assert httpx.get(f"{guarded}{path}", headers={"Accept": accept}).status_code == 401, (path, accept)
    assert httpx.get(f"{guarded}/maps", headers={"Accept": "text/html"}).status_code == 401
    cancel = f"{guarded}/jobs/{16 * '0'}/cancel"
    assert [httpx.post(cancel, auth=("", token)).status_code for token in ("see", "change")] == [403, 404]
    for path in ("/healthz", "/readyz"):
        assert httpx.get(f"{guarded}{path}").status_code == 200
