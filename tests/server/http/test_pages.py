"""The pages for people, read as a browser reads them: elements, links and words."""

from __future__ import annotations

import base64
import hashlib
import re
from collections.abc import Callable, Iterator
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import urljoin, urlsplit

import httpx
import pytest
from pyproj import Geod

from fleetmap.jobs import DriveFinding, DriveSummary
from fleetmap.manifest import make_manifest, parse_manifest
from fleetmap_server.http import map_pages
from fleetmap_server.http.app import create_app
from fleetmap_server.http.negotiation import prefers_html
from fleetmap_server.library import MapLibrary, open_library
from fleetmap_server.map_names import map_ids_with
from fleetmap_server.settings import ServerSettings

HOSTILE = """<script>alert(1)</script>'"><img src=x onerror=alert(2)>&amp;"""
VOID = {"meta", "input", "link", "br"}


class Page(HTMLParser):
    """A page's elements in order, its words, and whether every element that begins also ends."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.words = ""
        self._open: list[str] = []
        self.feed(text)
        self.close()
        assert self._open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))
        if tag not in VOID:
            self._open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self._open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self._open[-1:] != ["style"]:
            self.words += f"{data} "

    def all(self, tag: str, **attributes: str) -> list[dict[str, str | None]]:
        return [
            found
            for name, found in self.elements
            if name == tag and all(found.get(key.rstrip("_")) == value for key, value in attributes.items())
        ]

    @property
    def links(self) -> list[str]:
        return [str(found["href"]) for found in self.all("a")]


@pytest.fixture
def library(tmp_path: Path) -> Iterator[MapLibrary]:
    """A library on SQLite: what the pages ask of a catalogue is tested with both where it is made."""
    with open_library(ServerSettings(store=tmp_path / "store")) as library:
        yield library


@pytest.fixture
def look(library: MapLibrary, serving) -> Iterator[Callable[..., Page]]:
    """Opens a page as a browser does, and closely."""
    headers = {"Accept": "text/html,application/xhtml+xml,application/xml;q=0.9,*/*;q=0.8"}
    with serving(create_app(library)) as address, httpx.Client(base_url=address, headers=headers) as browser:

        def look(path: str, status: int = 200, **asked: str) -> Page:
            answer = browser.get(path, params=asked or None)
            assert (answer.status_code, answer.headers["content-type"]) == (status, "text/html; charset=utf-8"), (
                path
            )
            _lets_nothing_in(answer)
            return Page(answer.text)

        yield look


def _lets_nothing_in(answer: httpx.Response) -> None:
    policy = answer.headers["content-security-policy"]
    assert "default-src 'none'" in policy
    assert "script" not in policy
    (style,) = re.findall(r"<style>(.*?)</style>", answer.text, re.DOTALL)
    digest = base64.b64encode(hashlib.sha256(style.encode()).digest()).decode()
    assert f"style-src 'sha256-{digest}'" in policy
    page = Page(answer.text)
    assert not page.all("script")
    for tag, attributes in page.elements:
        assert not any(name.startswith("on") or name == "style" for name in attributes), tag
        for name in ("src", "href", "action"):
            assert not urlsplit(attributes.get(name) or "").netloc, (tag, attributes)


def with_changes(make_map, quality: dict[str, object], **kwargs: object):
    """A handmade map with other quality figures."""
    one = make_map(**kwargs)
    fields = one.manifest.model_dump(mode="json")
    fields["quality"] |= quality
    fields["provenance"] |= {"drive": HOSTILE}
    manifest = make_manifest(fields, "the changed map")
    return type(one)(manifest, manifest.to_bytes(), one.parts)


WEAK = {
    "from_m": 425.0,
    "to_m": 850.0,
    "start_ns": 1,
    "end_ns": 2,
    "start_lonlat": (8.405, 49.0),
    "end_lonlat": (8.41, 49.0),
    "reasons": [{"kind": "position", "worst": 0.31, "limit": 0.2, "text": f"position 0.31 m {HOSTILE}"}],
}


@pytest.mark.parametrize(
    ("accept", "page"),
    [
        ("text/html", True),
        ("text/html,application/xhtml+xml,application/xml;q=0.9,*/*;q=0.8", True),
        ("TEXT/HTML;q=0.9, application/json;q=0.5", True),
        ("*/*", False),
        ("", False),
        ("text/*", False),
        ("application/json", False),
        ("application/json, text/html;q=0.9", False),
        ("application/geo+json, text/html;q=0.9", False),
        ("text/html;q=0, */*", False),
        ("text/html;q=0.5, */*;q=0.8", False),
        ("text/html;q=nonsense", False),
    ],
)
def test_only_who_prefers_html_gets_pages(accept, page):
    assert prefers_html(accept) is page


def test_the_front_page_is_there_beside_the_landing_page(look, library, serving):
    assert "No maps yet." in look("/").words
    with serving(create_app(library)) as address:
        for accept in ("*/*", "application/json"):
            answer = httpx.get(f"{address}/", headers={"Accept": accept})
            assert answer.json()["type"] == "Catalog"
            assert "accept" in answer.headers["vary"].lower()


def test_whatever_a_map_says_is_text_and_never_markup(look, library, publish, make_map):
    hostile = {"warnings": [HOSTILE], "remarks": [HOSTILE], "weak_stretches": [WEAK], "weak_length_m": 425.0}
    publish(library, with_changes(make_map, hostile, publishable=False, part_sizes=(10,)))
    page = look("/maps/karlsruhe")
    assert page.words.count(HOSTILE) == 4  # warning, remark, weak stretch, name of the drive
    assert not page.all("img")
    for words in (HOSTILE, "49.0, 8.4" + HOSTILE):
        for page in (look("/maps", name=words), look("/maps", status=400, place=words)):
            assert not page.all("script")
            assert not page.all("img")
    assert look("/maps", name=HOSTILE).all("input", name="name")[0]["value"] == HOSTILE


def test_a_map_tells_every_figure_of_its_quality(look, library, publish, make_map):
    measured = {
        "position_sigma_m": 0.0212,
        "position_sigma_p95_m": 0.0461,
        "height_sigma_m": 0.0353,
        "gnss_residual_sigmas": 1.7,
        "gnss_sigma_m": 0.0184,
        "gnss_fixes_rejected": 13,
        "clock_offset_s": 0.0423,
        "clock_offset_sigma_s": 0.0061,
        "landmarks_per_m": 47.4,
        "segments": 3,
        "weak_length_m": 425.0,
        "weak_stretches": [WEAK],
    }
    publish(library, with_changes(make_map, measured, part_sizes=(10,)))
    words = look("/maps/karlsruhe").words
    for figure in (
        *(
            "0.021 m",
            "0.046 m",
            "0.035 m",
            "1.7 sigma",
            "0.018 m",
            "13 rejected",
            "42 ms ± 6 ms",
            "47.4 per metre",
        ),
        *(
            "3 segments",
            "425.0 m",
            "0.31 m",
            "0.050 m RMS",
            "0.70 px",
            "20000 observations",
            "300 of 300",
            "1700 m",
        ),
    ):
        assert figure in words, figure


def test_the_footprint_is_true_to_scale_with_north_up(look, library, publish, make_map):
    """A way to the north-east; its ends and the scale bar measured in the drawing."""
    start, end = (8.400, 49.000), (8.410, 49.004)
    publish(
        library, with_changes(make_map, {"weak_stretches": [WEAK]}, path_lonlat=(start, end), part_sizes=(10,))
    )
    page = look("/maps/karlsruhe")
    (circle,), (square,) = page.all("circle", class_="end"), page.all("rect", class_="end")
    east_px = float(square["x"]) + 6.0 - float(circle["cx"])
    north_px = float(circle["cy"]) - (float(square["y"]) + 6.0)
    (bar,) = [shape for shape in page.all("path", class_="ink") if "H" in str(shape["d"])]
    bar_px = float(re.search(r"H([\d.]+)", bar["d"])[1]) - float(re.search(r"M([\d.]+)", bar["d"])[1])
    bar_m = float(re.search(r"(\d+) m", page.words[page.words.index("from above") :])[1])
    azimuth_deg, _, distance_m = Geod(ellps="WGS84").inv(*start, *end)
    assert (east_px**2 + north_px**2) ** 0.5 / bar_px * bar_m == pytest.approx(distance_m, rel=0.005)
    assert 0.0 < north_px < east_px
    assert 45.0 < azimuth_deg < 90.0
    (weak,) = page.all("polyline", class_="weak")
    xs = [float(place.split(",")[0]) for place in str(weak["points"]).split()]
    assert xs[0] - float(circle["cx"]) == pytest.approx(0.25 * east_px, abs=0.2)  # 425 m of 1700 m
    assert xs[-1] - float(circle["cx"]) == pytest.approx(0.50 * east_px, abs=0.2)
    assert page.all("svg", role="img")


def test_long_tables_are_cut_and_say_so(look, library, publish, make_map, monkeypatch):
    monkeypatch.setattr(map_pages, "_SHOWN", 3)
    stretches = {"weak_stretches": [WEAK] * 4, "weak_length_m": 1.0}
    publish(library, with_changes(make_map, stretches, part_sizes=(5,) * 5))
    page = look("/maps/karlsruhe")
    assert page.words.count("position 0.31 m") == 3
    assert len([link for link in page.links if "/parts/" in link]) == 3
    assert "And 1 more" in page.words
    assert "And 2 more" in page.words


def test_the_pages_name_the_server_as_the_reader_does(tmp_path, serving):
    settings = ServerSettings(tmp_path / "store", zenoh_endpoint="tcp/0.0.0.0:7447")
    with open_library(settings) as library, serving(create_app(library)) as address:
        for host, named in (("maps.example:8000", "tcp/maps.example:7447"), ("[::1]:8000", "tcp/[::1]:7447")):
            answer = httpx.get(address, headers={"Host": host, "Accept": "text/html"})
            assert f"--server {named}" in Page(answer.text).words
        for host in ("a:b", "[", "a/b", '"><script>'):  # none: the address that was connected to counts
            answer = httpx.get(address, headers={"Host": host, "Accept": "text/html"})
            assert "--server tcp/127.0.0.1:7447" in Page(answer.text).words, host


def test_a_map_outside_utm_has_a_page_too(look, library, publish, make_map):
    publish(library, make_map(part_sizes=(10,), path_lonlat=((-70.0, 89.0), (-69.0, 89.1))))
    assert "Map karlsruhe" in look("/maps/karlsruhe").words


def test_old_versions_have_pages_and_retired_ones_say_so(look, library, publish, make_map):
    for seed in (1, 2, 3):
        publish(library, make_map(seed=seed, part_sizes=(10,)))
    library.retire("karlsruhe", 1)
    old = look("/maps/karlsruhe", version="2")
    assert "older version" in old.words
    assert "/maps/karlsruhe" in old.links
    assert "retired" in look("/maps/karlsruhe", status=410, version="1").words
    assert "no map 'none'" in look("/maps/none", status=404).words
    assert "/maps/karlsruhe?version=1" not in look("/maps/karlsruhe").links


def test_names_and_places_are_found(look, library, publish, make_map):
    for map_id, lon_deg in (("north-a_1", 8.0), ("north-b", 9.0), ("south", 10.0)):
        path = ((lon_deg, 49.0), (lon_deg + 0.01, 49.0))
        publish(library, make_map(map_id=map_id, seed=len(map_id), part_sizes=(10,), path_lonlat=path))

    def found(**asked: str) -> list[str]:
        return [link.removeprefix("/maps/") for link in look("/maps", **asked).links if link.startswith("/maps/")]

    assert found() == ["south", "north-b", "north-a_1"]
    assert found(name="NORTH") == ["north-b", "north-a_1"]
    assert found(name="_") == ["north-a_1"]  # not any character
    assert found(name="%") == []
    assert found(place="49.0, 10.005") == ["south"]
    assert sorted(found(place="49 9.5", radius_km="50")) == ["north-b", "south"]
    assert found(name="north", place="49 9.5", radius_km="50") == ["north-b"]
    for place, radius_km in (("49", ""), ("91, 8", ""), ("a, b", ""), ("49, 8", "-1"), ("49, 8", "nan")):
        assert "is no place" in look("/maps", status=400, place=place, radius_km=radius_km).words


def test_names_are_found_in_either_database(database_url, tmp_path, publish, make_map):
    with open_library(ServerSettings(store=tmp_path / "store", catalogue=database_url)) as library:
        for map_id in ("old-town_1", "old-town-2", "harbour"):
            publish(library, make_map(map_id=map_id, part_sizes=(10,)))
        library.retire("old-town-2")
        assert map_ids_with(library.storage.database, "OLD") == ("old-town_1",)
        assert map_ids_with(library.storage.database, "n_") == ("old-town_1",)
        assert map_ids_with(library.storage.database, "") == ("harbour", "old-town_1")
        assert map_ids_with(library.storage.database, "%") == ()


def test_the_list_goes_on_page_by_page(look, library, publish, make_map):
    for number in range(55):
        publish(library, make_map(map_id=f"m{number}", seed=number, part_sizes=(5,)))
    first = look("/maps")
    (following,) = [str(link["href"]) for link in first.all("a", rel="next")]
    second = look(following)
    listed = [link for page in (first, second) for link in page.links if link.startswith("/maps/")]
    assert len(listed) == len(set(listed)) == 55
    assert second.all("a", rel="next") == []
    assert "is no page" in look("/maps", status=400, after="nonsense").words


@pytest.fixture
def drive(library: MapLibrary) -> str:
    """A drive with a summary, and its job."""
    sha256 = hashlib.sha256(b"a drive").hexdigest()
    summary = DriveSummary(
        verdict="no",
        reasons=f"too dark {HOSTILE}",
        findings=(DriveFinding(aspect="light", severity="bad", text=HOSTILE),),
        start_ns=1_700_000_000_000_000_000,
        end_ns=1_700_000_060_000_000_000,
        trajectory_lonlat=((8.4, 49.0), (8.41, 49.0)),
        length_m=731.0,
        image_count=1234,
    )
    with library.storage.database.writing() as connection:
        library.drives.add(connection, sha256, f"{HOSTILE.replace('/', '')}.mcap", 1_234_567_890)
        library.drives.summarise(connection, sha256, summary, checked=False)
        library.jobs.queue(connection, sha256, "karlsruhe")
    return sha256


def test_drives_and_jobs_have_pages(look, library, drive):
    listed = look("/drives")
    assert f"/drives/{drive}" in listed.links
    assert "1.2 GB" in listed.words
    page = look(f"/drives/{drive}")
    for words in ("1234", "731 m", f"too dark {HOSTILE}", "who sent it", "queued", "karlsruhe"):
        assert words in page.words, words
    assert page.all("svg", role="img")
    taken = library.jobs.take("worker-7")
    library.jobs.report(taken.job_id, taken.fence, "features", 42)
    jobs = look("/jobs").words
    for words in ("1 running", "features 42 %", "worker-7"):
        assert words in jobs, words
    assert "no drive" in look(f"/drives/{64 * '0'}", status=404).words


def golden_map(make_map):
    """A map whose parts can be read."""
    folder = Path(__file__).parents[2] / "shared" / "golden" / "map_format_1"
    data = (folder / "manifest.json").read_bytes()
    contents = [file.read_bytes() for file in (folder / "parts").iterdir()]
    parts = {hashlib.sha256(content).hexdigest(): content for content in contents}
    return type(make_map())(parse_manifest(data, "the golden map"), data, parts)


def test_every_link_of_every_page_leads_somewhere(look, library, publish, make_map, drive, serving):
    for seed in (1, 2):
        publish(library, make_map(seed=seed, part_sizes=(10, 20)))
    publish(library, golden_map(make_map))
    waiting, seen = ["/"], set()
    with serving(create_app(library)) as address, httpx.Client(base_url=address) as browser:
        while waiting:
            path = waiting.pop()
            if (
                path in seen or path == f"/blobs/{drive}" or "karlsruhe/preview.ply" in path
            ):  # their bytes are made up
                continue
            seen.add(path)
            answer = browser.get(path, headers={"Accept": "text/html,*/*;q=0.8"})
            assert answer.status_code == 200, path
            if answer.headers["content-type"].startswith("text/html"):
                waiting += [urljoin(path, link) for link in Page(answer.text).links]
    assert {"/maps", "/drives", "/jobs", "/metrics", "/readyz", "/maps/karlsruhe?version=1"} <= seen
    assert len(seen) > 15
