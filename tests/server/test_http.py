"""The HTTP pages, asked through real sockets."""

from __future__ import annotations

import httpx
import pytest

from fleetmap.transport import MapClient
from fleetmap_server.server import running_server
from fleetmap_server.settings import ServerSettings


@pytest.fixture(scope="module")
def three_maps(make_map):
    return [
        make_map(map_id="old", part_sizes=(1000, 2000)),
        make_map(map_id="point", part_sizes=(10,), path_lonlat=((11.5, 48.1),), publishable=False),
        make_map(map_id="new", part_sizes=(70_000,), seed=3, path_lonlat=((-70.1, -33.5), (-70.0, -33.4))),
    ]


@pytest.fixture(scope="module")
def web(three_maps, tmp_path_factory, module_endpoint):
    store = tmp_path_factory.mktemp("store")
    with running_server(ServerSettings(store, module_endpoint, http_port=0)) as server:
        with MapClient(server.zenoh_endpoint) as client:
            for one in three_maps:
                client.publish(one.manifest_bytes, one.parts.__getitem__)
        with httpx.Client(base_url=server.http_url, timeout=10.0) as web:
            yield web


def ids(answer: httpx.Response) -> list[str]:
    assert answer.status_code == 200, answer.text
    assert answer.headers["content-type"] == "application/geo+json"
    return [feature["id"] for feature in answer.json()["features"]]


def test_the_landing_page_leads_everywhere(web):
    answer = web.get("/")
    assert answer.status_code == 200
    page = answer.json()
    assert "fleetmap" in page["title"]
    paths = {httpx.URL(link["href"]).path for link in page["links"]}
    assert {"/collections", "/collections/maps", "/collections/maps/items", "/healthz", "/api"} <= paths
    for link in page["links"]:
        assert web.get(link["href"]).status_code == 200


def test_the_server_says_that_it_is_well(web):
    assert web.get("/healthz").json()["status"] == "ok"
    assert web.get("/healthz").json()["maps"] == 3


def test_there_is_one_collection(web):
    collections = web.get("/collections").json()["collections"]
    assert [collection["id"] for collection in collections] == ["maps"]
    assert web.get("/collections/maps").json() == collections[0]


def test_maps_are_features_in_lon_lat(web, three_maps):
    answer = web.get("/collections/maps/items")
    assert ids(answer) == ["new", "point", "old"]
    new, point, old = answer.json()["features"]
    assert old["geometry"] == {"type": "LineString", "coordinates": [[8.4, 49.0], [8.41, 49.005], [8.42, 49.0]]}
    assert old["bbox"] == [8.4, 49.0, 8.42, 49.005]
    assert point["geometry"] == {"type": "Point", "coordinates": [11.5, 48.1]}
    assert new["type"] == "Feature"
    assert new["properties"]["proj:code"] == "EPSG:32632"
    assert new["properties"]["version"] == three_maps[2].version
    assert new["properties"]["datetime"] == "2023-11-14T22:13:20Z"
    assert new["properties"]["end_datetime"] == "2023-11-14T22:14:20.500000Z"
    assert new["properties"]["fleetmap:publishable"] is True
    assert point["properties"]["fleetmap:publishable"] is False
    assert web.get("/collections/maps/items/point").json() == point
    assert web.get(new["assets"]["manifest"]["href"]).content == three_maps[2].manifest_bytes


def test_a_bbox_selects(web):
    items = "/collections/maps/items"
    assert ids(web.get(items, params={"bbox": "8,48,9,50"})) == ["old"]
    assert ids(web.get(items, params={"bbox": "-71,-34,-69,-33"})) == ["new"]
    assert ids(web.get(items, params={"bbox": "0,0,1,1"})) == []


def test_pages_follow_each_other(web):
    answer = web.get("/collections/maps/items", params={"limit": 2})
    assert ids(answer) == ["new", "point"]
    assert (answer.json()["numberMatched"], answer.json()["numberReturned"]) == (3, 2)
    (further,) = [link["href"] for link in answer.json()["links"] if link["rel"] == "next"]
    last = web.get(further)
    assert ids(last) == ["old"]
    assert [link["rel"] for link in last.json()["links"]] == ["self"]
    assert len(ids(web.get("/collections/maps/items", params={"limit": 1_000_000}))) == 3  # clamped, not refused


@pytest.mark.parametrize(
    "query",
    [
        *("bbox=1,2,3", "bbox=a,b,c,d", "bbox=0,50,1,40", "bbox=0,0,0,91", "bbox=nan,0,1,1"),
        *("limit=0", "limit=x", "offset=-1"),
    ],
)
def test_a_query_that_does_not_hold_is_a_problem_with_400(web, query):
    answer = web.get(f"/collections/maps/items?{query}")
    assert answer.status_code == 400
    assert answer.headers["content-type"] == "application/problem+json"
    assert query.split("=")[0] in answer.json()["detail"]


@pytest.mark.parametrize(
    "path",
    [
        "/nothing",
        "/collections/other",
        "/collections/maps/items/none",
        "/maps/none/manifest.json",
        "/maps/old/parts/" + 64 * "0",
        "/maps/none/parts/x",
        "/maps/old/parts/..%2F..%2Fcatalogue.sqlite",
    ],
)
def test_what_is_not_there_is_a_problem_with_404(web, path):
    answer = web.get(path)
    assert answer.status_code == 404
    assert answer.headers["content-type"] == "application/problem+json"
    assert answer.json()["status"] == 404


def test_writing_over_http_is_not_allowed(web):
    assert web.post("/collections/maps/items").status_code == 405
    assert web.delete("/maps/old/manifest.json").status_code == 405


def test_parts_come_whole_with_their_hash_as_tag(web, three_maps):
    ((sha256, data),) = three_maps[2].parts.items()
    path = f"/maps/new/parts/{sha256}"
    answer = web.get(path)
    assert answer.content == data
    assert answer.headers["etag"] == f'"{sha256}"'
    assert "immutable" in answer.headers["cache-control"]
    assert web.get(path, headers={"If-None-Match": f'"{sha256}"'}).status_code == 304
    piece = web.get(path, headers={"Range": "bytes=5-14"})
    assert (piece.status_code, piece.content) == (206, data[5:15])


def test_a_part_belongs_to_its_map_only(web, three_maps):
    ((sha256, _),) = three_maps[2].parts.items()
    assert web.get(f"/maps/old/parts/{sha256}").status_code == 404


def test_a_manifest_is_asked_for_again_only_when_it_changed(web, three_maps):
    answer = web.get("/maps/old/manifest.json")
    assert answer.headers["content-type"] == "application/json"
    assert answer.headers["etag"] == f'"{three_maps[0].version}"'
    tag = {"If-None-Match": answer.headers["etag"]}
    assert web.get("/maps/old/manifest.json", headers=tag).status_code == 304


def test_a_part_that_rotted_on_the_disk_is_a_problem_not_bytes(server, make_map, tmp_path):
    one = make_map(part_sizes=(10_000,))
    ((sha256, data),) = one.parts.items()
    with MapClient(server.zenoh_endpoint) as client:
        client.publish(one.manifest_bytes, one.parts.__getitem__)
    path = f"{server.http_url}/maps/karlsruhe/parts/{sha256}"
    assert httpx.get(path).content == data
    (tmp_path / "store" / "blobs" / sha256[:2] / sha256).write_bytes(data[:-1] + b"?")
    answer = httpx.get(path)
    assert answer.status_code == 500
    assert "damaged" in answer.json()["detail"]
