"""The STAC API on both databases: what it lists, finds and says of itself."""

from __future__ import annotations

import hashlib
import json

import httpx
import pytest

from fleetmap.jobs import DriveSummary
from fleetmap_server.http.app import create_app
from fleetmap_server.http.stac_search import MAX_LIMIT
from fleetmap_server.library import open_library
from fleetmap_server.settings import ServerSettings

ITEMS = "/collections/maps/items"
FIJI = ((179.95, -16.9), (-179.95, -16.8))


@pytest.fixture(scope="module")
def three_maps(make_map):
    """In the order of their publication; the last crosses 180 degrees."""
    return [
        make_map(map_id="old", part_sizes=(1000, 2000)),
        make_map(map_id="point", part_sizes=(10,), path_lonlat=((11.5, 48.1),), publishable=False),
        make_map(map_id="fiji", part_sizes=(70_000,), seed=3, path_lonlat=FIJI),
    ]


@pytest.fixture(scope="module", params=["sqlite", "postgresql"])
def stocked(request, tmp_path_factory, three_maps, publish, serving):
    """A server with three maps, of either kind, for tests that change nothing."""
    store = tmp_path_factory.mktemp("three")
    sqlite = f"sqlite:///{store / 'catalogue.sqlite'}"
    catalogue = sqlite if request.param == "sqlite" else request.getfixturevalue("postgresql").new_database()
    with open_library(ServerSettings(store=store / "store", catalogue=catalogue)) as library:
        for one in three_maps:
            publish(library, one)
        with serving(create_app(library)) as address, httpx.Client(base_url=address, timeout=30.0) as web:
            yield web


@pytest.fixture
def drive(library):
    """A drive with its way and time known."""
    sha256 = hashlib.sha256(b"a drive").hexdigest()
    summary = DriveSummary(
        verdict="yes", start_ns=1_700_000_000_000_000_000, end_ns=1_700_000_060_000_000_000,
        trajectory_lonlat=((8.40, 49.00), (8.42, 49.00)), length_m=1500.0, image_count=600,
    )  # fmt: skip
    with library.storage.database.writing() as connection:
        library.drives.add(connection, sha256, "survey.mcap", 1234)
        return library.drives.summarise(connection, sha256, summary, checked=True)


def features(answer: httpx.Response) -> list[dict]:
    assert answer.status_code == 200, answer.text
    assert answer.headers["content-type"] == "application/geo+json"
    page = answer.json()
    assert page["numberReturned"] == len(page["features"])
    return page["features"]


def ids(answer: httpx.Response) -> list[str]:
    return [feature["id"] for feature in features(answer)]


def href(document: dict, rel: str) -> str:
    (found,) = [link["href"] for link in document["links"] if link["rel"] == rel]
    return found


def all_ids(web: httpx.Client, answer: httpx.Response) -> list[str]:
    """Of this page and of all that follow, by their own links."""
    found = ids(answer)
    while further := [link for link in answer.json()["links"] if link["rel"] == "next"]:
        answer = web.request(further[0]["method"], further[0]["href"], json=further[0].get("body"))
        found += ids(answer)
    return found


def test_the_landing_page_and_the_collections_lead_everywhere(stocked):
    answer = stocked.get("/", headers={"Accept": "*/*"})
    assert "Accept" in answer.headers["vary"]
    page = answer.json()
    assert page["type"] == "Catalog"
    assert page["conformsTo"] == stocked.get("/conformance").json()["conformsTo"]
    for link in page["links"]:
        if link["type"] != "text/html" and link["rel"] != "health":
            answer = stocked.get(link["href"])
            assert answer.status_code == 200
            assert answer.headers["content-type"] == link["type"]
    collections = stocked.get("/collections").json()["collections"]
    assert [one["id"] for one in collections] == ["maps", "drives"]
    for one in collections:
        assert stocked.get(href(one, "self")).json() == one
        features(stocked.get(href(one, "items")))


def test_an_item_says_where_and_when_and_how_good_and_where_its_bytes_are(stocked, three_maps):
    fiji, point, old = features(stocked.get(ITEMS))
    assert old["geometry"] == {"type": "LineString", "coordinates": [[8.4, 49.0], [8.41, 49.005], [8.42, 49.0]]}
    assert old["bbox"] == [8.4, 49.0, 8.42, 49.005]
    assert point["geometry"] == {"type": "Point", "coordinates": [11.5, 48.1]}
    assert fiji["geometry"]["type"] == "MultiLineString"  # cut at 180 degrees
    assert fiji["bbox"] == [179.95, -16.9, -179.95, -16.8]
    properties = old["properties"]
    assert (properties["proj:code"], properties["fleetmap:length_m"]) == ("EPSG:32632", 1700.0)
    assert (properties["datetime"], properties["end_datetime"]) == (
        "2023-11-14T22:13:20Z", "2023-11-14T22:14:20.500000Z"
    )  # fmt: skip
    assert properties["fleetmap:publishable"] is True
    assert point["properties"]["fleetmap:warnings"] == ["few landmarks"]
    told = {asset.get("file:checksum"): asset.get("file:size") for asset in old["assets"].values()}
    told.pop(None)  # of what is made when it is asked for
    version, manifest_bytes = three_maps[0].version, three_maps[0].manifest_bytes
    parts = {f"1220{sha256}": len(data) for sha256, data in three_maps[0].parts.items()}
    assert told == {f"1220{version}": len(manifest_bytes), **parts}
    for item in (old, point, fiji):
        assert stocked.get(href(item, "self")).json() == item


def test_the_collection_says_what_it_reaches_over(web, library, make_map, publish):
    def extent() -> dict:
        return web.get("/collections/maps").json()["extent"]

    assert extent() == {
        "spatial": {"bbox": [[-180.0, -90.0, 180.0, 90.0]]}, "temporal": {"interval": [[None, None]]}
    }  # fmt: skip
    publish(library, make_map(map_id="a"))
    publish(library, make_map(map_id="b", path_lonlat=((11.5, 48.1),)))
    assert extent()["spatial"]["bbox"] == [[8.4, 48.1, 11.5, 49.005]]
    assert extent()["temporal"]["interval"] == [["2023-11-14T22:13:20Z", "2023-11-14T22:14:20.500000Z"]]
    library.retire("a")
    assert extent()["spatial"]["bbox"] == [[11.5, 48.1, 11.5, 48.1]]
    publish(library, make_map(map_id="c", path_lonlat=FIJI))
    assert extent()["spatial"]["bbox"] == [[-180.0, -16.9, 180.0, 48.1]]


SEARCHES = (
    ({"bbox": "8,48,9,50"}, ["old"]),
    ({"bbox": "8,48,-100,9,50,1000"}, ["old"]),
    ({"bbox": "179,-17,-179,-16"}, ["fiji"]),
    ({"bbox": "8.405,49.0,8.415,49.001"}, []),  # in the bounding box, but not on the way
    ({"intersects": '{"type": "Point", "coordinates": [11.5, 48.1]}'}, ["point"]),
    (
        {"intersects": '{"type": "LineString", "coordinates": [[8.41, 48, 5], [8.41, 50, 5]]}'}, ["old"]
    ),
    ({"datetime": "2023-11-14T22:13:20Z"}, ["fiji", "point", "old"]),
    ({"datetime": "2023-11-14t23:14:00+01:00/.."}, ["fiji", "point", "old"]),
    ({"datetime": "../2023-11-14T22:13:19.999Z"}, []),
    ({"datetime": "2023-11-14T22:14:20.500000001Z/"}, []),
    ({"datetime": "2262-04-11T23:47:16.854775Z"}, []),  # the last whole microsecond of 64 bits
    ({"datetime": "0001-01-01T00:00:00+23:59/9999-12-31T23:59:59-23:59"}, ["fiji", "point", "old"]),
    ({"ids": "old,fiji,other"}, ["fiji", "old"]),
    ({"ids": "old,fiji", "bbox": "8,48,9,50"}, ["old"]),
    ({"collections": "maps"}, ["fiji", "point", "old"]),
    ({"collections": "drives"}, []),
    ({"collections": "others"}, []),
    ({"sortby": "id"}, ["fiji", "old", "point"]),
    ({"sortby": "-properties.fleetmap:size_bytes"}, ["fiji", "old", "point"]),
    ({"sortby": "+updated"}, ["old", "point", "fiji"]),
    ({"sortby": "datetime,-id"}, ["point", "old", "fiji"]),
)  # fmt: skip


def test_a_search_finds_the_same_by_get_and_by_post(stocked):
    for query, found in SEARCHES:
        assert ids(stocked.get("/search", params=query)) == found, query
        assert ids(stocked.post("/search", json=body_of(query))) == found, query
        assert ids(stocked.get(ITEMS, params=query)) == found, query


def body_of(query: dict[str, str]) -> dict:
    """The same search in the manner of POST."""
    body = dict(query)
    if "bbox" in body:
        body["bbox"] = [float(number) for number in body["bbox"].split(",")]
    if "intersects" in body:
        body["intersects"] = json.loads(body["intersects"])
    for name in ("ids", "collections"):
        if name in body:
            body[name] = body[name].split(",")
    if "sortby" in body:
        body["sortby"] = [
            {"field": field.strip("+-"), "direction": "desc" if field.startswith("-") else "asc"}
            for field in body["sortby"].split(",")
        ]
    return body


WRONG_QUERIES = (
    *("bbox=1,2,3", "bbox=1,2,3,4,5", "bbox=a,b,c,d", "bbox=0,50,1,40", "bbox=0,0,0,91", "bbox=nan,0,1,1"),
    *("bbox=inf,0,1,1", "bbox=-181,0,1,1"),
    *("limit=0", "limit=-1", "limit=x"),
    *("datetime=/", "datetime=../..", "datetime=2020-01-01", "datetime=2020-01-01T00:00:00"),
    *(
        "datetime=2020-01-01T00:00:61Z",
        "datetime=2020-13-01T00:00:00Z",
        "datetime=9999-12-31T23:59:61Z",
        "datetime=2020-01-01T00:00:00%2B0100",
    ),
    "datetime=2021-01-01T00:00:00Z/2020-01-01T00:00:00Z",
    *("sortby=colour", "token=x", "token=maps~x", "token=others~x", "token=%00", "token=x%00"),
    "collour=red",  # not to be taken for a search of everything
)


def test_a_query_that_does_not_hold_is_a_problem_that_names_it(stocked):
    for query in WRONG_QUERIES:
        for path in (ITEMS, "/search"):
            answer = stocked.get(f"{path}?{query}")
            assert (answer.status_code, answer.headers["content-type"]) == (400, "application/problem+json"), query
            assert query.split("=")[0] in answer.json()["detail"] or "token" in query


WRONG_GEOMETRIES = (
    *({}, {"type": "Cube"}, {"type": ["Point"]}, {"type": "Point"}, {"type": "Point", "coordinates": []}),
    {"type": "Point", "coordinates": ["8", "49"]},
    {"type": "Point", "coordinates": [8]},
    {"type": "Point", "coordinates": [True, False]},
    {"type": "Point", "coordinates": [10**400, 0]},
    {"type": "Point", "coordinates": [190, 0]},
    {"type": "LineString", "coordinates": [[8, 49]]},
    {"type": "LineString", "coordinates": [8, 49]},
    {"type": "Polygon", "coordinates": [[[8, 49], [9, 49], [9, 50], [8, 50]]]},
    {"type": "Polygon", "coordinates": []},
    {"type": "MultiPolygon", "coordinates": [[]]},
    *({"type": "GeometryCollection"}, {"type": "GeometryCollection", "geometries": [{}]}),
    {"type": "LineString", "coordinates": [[8, 49]] * 20_001},
)


def test_a_geometry_that_does_not_hold_is_a_problem(stocked):
    for geometry in WRONG_GEOMETRIES:
        answer = stocked.post("/search", json={"intersects": geometry})
        assert answer.status_code == 400, answer.text
        assert "geometry" in answer.json()["detail"]


def test_every_kind_of_geometry_is_searched_with(stocked):
    square = [[8, 48], [9, 48], [9, 50], [8, 50], [8, 48]]
    hole = [[8.3, 48.9], [8.5, 48.9], [8.5, 49.1], [8.3, 49.1], [8.3, 48.9]]
    bow_tie = [[8, 48], [9, 50], [9, 48], [8, 50], [8, 48]]
    for geometry, found in (
        ({"type": "Polygon", "coordinates": [square]}, ["old"]),
        ({"type": "Polygon", "coordinates": [square, hole]}, []),
        ({"type": "Polygon", "coordinates": [bow_tie]}, ["old"]),
        ({"type": "MultiPoint", "coordinates": [[0, 0], [11.5, 48.1]]}, ["point"]),
        ({"type": "MultiLineString", "coordinates": [[[8.41, 48], [8.41, 50]], [[0, 0], [1, 1]]]}, ["old"]),
        ({"type": "MultiPolygon", "coordinates": [[square], [[[0, 0], [1, 0], [0, 1], [0, 0]]]]}, ["old"]),
    ):
        assert ids(stocked.post("/search", json={"intersects": geometry})) == found
    both = {"type": "GeometryCollection", "geometries": [
        {"type": "Polygon", "coordinates": [square]}, {"type": "Point", "coordinates": [11.5, 48.1]},
    ]}  # fmt: skip
    assert ids(stocked.post("/search", json={"intersects": both})) == ["point", "old"]


WRONG_BODIES = (
    *(b"", b"[]", b"{", b"[" * 100_000, b'{"limit": true}', b'{"limit": "5"}'),
    *(b'{"bbox": "1,2,3,4"}', b"\xff"),
    *(b'{"sortby": [{"field": "\\ud800"}]}', b'{"token": "\\u0000"}', b'{"query": {}}', b'{"limit": 1e999}'),
    b'{"bbox": [0, 0, 1, 1], "intersects": {"type": "Point", "coordinates": [0, 0]}}',
)


def test_a_body_that_does_not_hold_is_a_problem(stocked):
    for content in WRONG_BODIES:
        answer = stocked.post("/search", content=content, headers={"Content-Type": "application/json"})
        assert (answer.status_code, answer.headers["content-type"]) == (400, "application/problem+json"), content


def test_a_body_that_is_too_large_is_not_read(stocked):
    answer = stocked.post(
        "/search", content=b" " * (1024 * 1024 + 1), headers={"Content-Type": "application/json"}
    )
    assert (answer.status_code, answer.json()["status"]) == (413, 413)


def test_ids_that_no_item_can_have_are_not_found(stocked):
    assert ids(stocked.post("/search", json={"ids": ["\0", "old\n", "Ä", "x" * 100_000, "old"]})) == ["old"]
    assert ids(stocked.post("/search", json={"ids": []})) == []


def test_pages_follow_each_other_whatever_comes_in_between(web, library, make_map, publish, drive):
    names = [f"map{number}" for number in range(7)]
    for number, name in enumerate(names):
        publish(library, make_map(map_id=name, part_sizes=(10 + number,), seed=number))
    newest_first = [*reversed(names), drive.sha256]
    for limit in (1, 3, 1_000_000):
        assert all_ids(web, web.get("/search", params={"limit": limit})) == newest_first
        assert all_ids(web, web.post("/search", json={"limit": limit})) == newest_first
        oldest_first = {"limit": limit, "sortby": "+updated", "collections": "maps,drives"}
        assert all_ids(web, web.get("/search", params=oldest_first)) == newest_first[::-1]
        assert all_ids(web, web.get(ITEMS, params={"limit": limit, "sortby": "-id"})) == names[::-1]
    first = web.get("/search", params={"limit": 3})
    publish(library, make_map(map_id="later"))
    assert all_ids(web, first) == newest_first
    assert len(features(web.get(ITEMS, params={"limit": MAX_LIMIT + 1}))) == 8  # clamped, not refused


def test_a_token_belongs_to_its_search(stocked):
    (further,) = [link for link in stocked.get("/search?limit=1").json()["links"] if link["rel"] == "next"]
    token = httpx.URL(further["href"]).params["token"]
    assert stocked.get("/search", params={"token": token, "sortby": "id"}).status_code == 400
    assert stocked.get("/search", params={"token": token, "collections": "drives"}).status_code == 400
    assert stocked.get("/search", params={"token": f"{token}.{token}"}).status_code == 400


def test_a_map_s_history_is_linked_and_readable(web, library, make_map, publish):
    versions = [publish(library, make_map(part_sizes=(10,), seed=seed)).version for seed in range(3)]
    assert ids(web.get(ITEMS)) == ["karlsruhe"]
    latest = web.get(f"{ITEMS}/karlsruhe").json()
    assert (latest["properties"]["version"], latest["properties"]["deprecated"]) == (versions[2], False)
    middle = web.get(href(latest, "predecessor-version")).json()
    assert (middle["id"], middle["properties"]["version"]) == ("karlsruhe.v2", versions[1])
    assert middle["properties"]["deprecated"] is True
    assert web.get(href(middle, "self")).json() == middle
    assert web.get(href(middle, "successor-version")).json() == latest
    assert web.get(href(middle, "latest-version")).json() == latest
    assert all(versions[1] in middle["assets"][name]["href"] for name in ("manifest", "trajectory", "preview"))
    first = web.get(href(middle, "predecessor-version")).json()
    assert not [link for link in first["links"] if link["rel"] == "predecessor-version"]

    library.retire("karlsruhe", 2)
    gone = web.get(f"{ITEMS}/karlsruhe.v2")
    assert (gone.status_code, gone.headers["content-type"]) == (410, "application/problem+json")
    assert href(web.get(f"{ITEMS}/karlsruhe").json(), "predecessor-version").endswith("karlsruhe.v1")

    back = library.rollback("karlsruhe", 1)
    assert web.get(f"{ITEMS}/karlsruhe").json()["properties"]["version"] == back.version == versions[0]
    assert web.get(f"{ITEMS}/karlsruhe").json()["properties"]["fleetmap:origin"] == "rollback"

    library.retire("karlsruhe")
    assert web.get(f"{ITEMS}/karlsruhe").status_code == 410
    assert web.get(f"{ITEMS}/karlsruhe.v1").status_code == 410
    assert ids(web.get(ITEMS)) == []


NOWHERE = (
    *("/nothing", "/collections/other", "/collections/other/items", f"{ITEMS}/none", f"{ITEMS}/old.v2"),
    *(f"{ITEMS}/old.v0", f"{ITEMS}/old.v99999999999", f"{ITEMS}/old%0A", f"{ITEMS}/OLD"),
    *("/collections/drives/items/0", f"/collections/drives/items/{64 * '0'}", "/maps/none/preview.ply"),
)


def test_what_is_not_there_is_a_problem_with_404(stocked):
    for path in NOWHERE:
        answer = stocked.get(path)
        assert (answer.status_code, answer.headers["content-type"]) == (404, "application/problem+json"), path
        assert answer.json()["status"] == 404
    assert stocked.get(f"{ITEMS}/%00").status_code == 400


def test_drives_are_items_with_their_way_and_recording(web, library, drive):
    (item,) = features(web.get("/collections/drives/items"))
    assert (item["id"], item["properties"]["title"]) == (drive.sha256, "survey.mcap")
    assert item["geometry"] == {"type": "LineString", "coordinates": [[8.4, 49.0], [8.42, 49.0]]}
    assert item["properties"]["datetime"] == "2023-11-14T22:13:20Z"
    assert item["assets"]["recording"]["file:checksum"] == f"1220{drive.sha256}"
    assert item["assets"]["recording"]["href"].endswith(f"/blobs/{drive.sha256}")
    assert web.get(href(item, "self")).json() == item
    assert ids(web.get("/search", params={"bbox": "8,48,9,50"})) == [drive.sha256]
    assert ids(web.get("/search", params={"bbox": "0,0,1,1"})) == []
    assert web.get("/collections/drives").json()["extent"]["spatial"]["bbox"] == [[8.4, 49.0, 8.42, 49.0]]


def test_a_drive_of_which_nobody_knows_more_is_an_item_too(web, library):
    sha256 = hashlib.sha256(b"unknown").hexdigest()
    with library.storage.database.writing() as connection:
        entry = library.drives.add(connection, sha256, "unknown.mcap", 99)
    (item,) = features(web.get("/search"))
    assert (item["id"], item["geometry"]) == (entry.sha256, None)
    assert "bbox" not in item
    assert ids(web.get("/search", params={"datetime": item["properties"]["datetime"]})) == [sha256]


def test_a_page_of_another_origin_may_read_but_change_nothing(stocked):
    elsewhere = {"Origin": "https://stac-browser.example"}
    answer = stocked.get("/collections", headers=elsewhere)
    assert (answer.status_code, answer.headers["access-control-allow-origin"]) == (200, "*")
    assert stocked.post("/search", json={}, headers=elsewhere).status_code == 200
    retry = f"/jobs/{32 * '0'}/retry"
    assert stocked.post(retry, headers=elsewhere).status_code == 403
    assert stocked.post(retry, headers={"Origin": str(stocked.base_url).rstrip("/")}).status_code == 404


def test_what_is_not_allowed_is_told_with_what_is(stocked):
    answer = stocked.delete("/search")
    assert (answer.status_code, answer.headers["allow"]) == (405, "GET, POST")
    assert answer.headers["content-type"] == "application/problem+json"
