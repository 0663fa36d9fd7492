"""``fleetmap report``: text, JSON, a page that needs nothing else, and a picture; also of maps that know less."""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Callable
from html.parser import HTMLParser
from pathlib import Path

import cv2
import numpy as np
import pytest

from fleetmap.manifest import Provenance, WeakReason, WeakStretch
from fleetmap.map_package import MapPackage, open_package, write_package
from fleetmap.road_quality import FixQuality, KeyframeQuality, RoadQuality

VOID = {"meta", "img", "br"}
LIMITS = {"weak_position_sigma_m": 1.0, "weak_landmarks_per_m": 5.0, "weak_gnss_sigmas": 4.0}


class Page(HTMLParser):
    """Tags that open are closed in order; what the page asks for is gathered."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[str] = []
        self.sources: list[str] = []
        self.text = ""
        self.feed(text)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.sources += [
            value or "" for name, value in attrs if name in ("src", "href", "srcset", "data", "action")
        ]
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data + " "


def road_of(package: MapPackage, sigma_m: float = 0.05) -> RoadQuality:
    """A road along the package's keyframes: uncertain in the middle, one fix far off."""
    keyframes = package.visual_map().keyframes
    steps_m = np.linalg.norm(np.diff(keyframes.positions_m, axis=0), axis=1)
    along_m = np.concatenate([[0.0], np.cumsum(steps_m)])
    count, length_m = len(keyframes), float(along_m[-1])
    sigmas_m = np.where(np.abs(along_m - length_m / 2.0) < length_m / 6.0, 1.5, sigma_m)
    return RoadQuality(
        KeyframeQuality(
            keyframes.stamps_ns,
            along_m,
            keyframes.positions_m,
            (np.eye(3) * (sigmas_m**2)[:, None, None]).astype(np.float32),
            np.full(count, 0.9, np.float32),
            np.full(count, 80, np.int32),
        ),
        FixQuality(
            keyframes.stamps_ns[::3],
            along_m[::3],
            np.tile(np.array([[0.03, -0.04, 0.02]], np.float32), (len(along_m[::3]), 1)),
            np.linspace(0.5, 5.0, len(along_m[::3]), dtype=np.float32),
            np.full(len(along_m[::3]), 0.05, np.float32),
        ),
        np.linspace(0.0, length_m, 16),
        np.full(15, 10.0, np.float32),
        keyframes.stamps_ns[[2, 3]][None],
        along_m[[2, 3]][None],
    )


@pytest.fixture
def rewritten(map_package: Path, tmp_path: Path) -> Callable[..., Path]:
    """The golden map written again with quality along its road and one weak stretch."""

    def write(road: RoadQuality | None = None, map_id: str = "street", **changes: object) -> Path:
        package = open_package(map_package)
        weak = WeakStretch(
            from_m=50.0,
            to_m=100.0,
            start_ns=1_700_000_000_000_000_000,
            end_ns=1_700_000_001_000_000_000,
            start_lonlat=(8.4123456, 49.0034567),
            end_lonlat=(8.4129, 49.0041),
            reasons=(
                WeakReason(kind="position", worst=1.5, limit=1.0, text="uncertain by 1.50 m <limit> & so on"),
            ),
        )
        quality = package.manifest.quality.model_copy(
            update={"weak_stretches": (weak,), "weak_length_m": 50.0, "position_sigma_m": 0.05, **changes}
        )
        provenance = Provenance(**{**dict(package.manifest.provenance), "settings": {"quality": LIMITS}})
        folder = tmp_path / map_id
        write_package(
            folder,
            package.visual_map(),
            map_id=map_id,
            quality=quality,
            provenance=provenance,
            road_quality=road_of(package) if road is None else road,
        )
        return folder

    return write


def test_help_teaches(fleetmap):
    code, out, _ = fleetmap("report", "--help")
    assert code == 0
    for word in ("report.html", "report.png", "--output", "--json", "--set quality.", "Examples:"):
        assert word in out


def test_page_and_picture_lie_beside_the_map_and_the_figures_are_printed(fleetmap, rewritten):
    folder = rewritten()
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    code, out, err = fleetmap("report", folder)
    assert (code, err) == (0, "")
    target = folder.with_name("street_report")
    assert {path.name for path in target.iterdir()} == {"report.html", "report.png"}
    assert f"written:        {target / 'report.html'}, {target / 'report.png'}\n" in out
    assert "verdict:        fit to publish\n" in out
    assert "weak stretches: 1, 50.0 m of " in out
    assert "50.0 to 100.0 m (49.003457,8.412346 to 49.004100,8.412900): uncertain by 1.50 m" in out
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before


def test_the_page_is_valid_and_needs_nothing_else(fleetmap, rewritten, tmp_path):
    fleetmap("report", rewritten(), "--output", tmp_path / "look")
    text = (tmp_path / "look" / "report.html").read_text(encoding="utf-8")
    assert text.startswith("<!DOCTYPE html>")
    page = Page(text)
    assert page.open == []
    assert (page.tags.count("html"), page.tags.count("body"), page.tags.count("img")) == (1, 1, 1)
    assert "script" not in page.tags
    assert "link" not in page.tags
    (source,) = page.sources
    kind, _, data = source.partition(",")
    assert kind == "data:image/png;base64"
    assert base64.b64decode(data) == (tmp_path / "look" / "report.png").read_bytes()
    assert not re.search(r"https?://|url\(|@import", text)
    assert "uncertain by 1.50 m <limit> & so on" in page.text  # escaped in the source, whole to the reader
    assert "weak_position_sigma_m" in page.text


def test_the_picture_shows_the_weak_stretch_in_red(fleetmap, rewritten, tmp_path):
    """The same map without it holds next to no red on its road."""
    fleetmap("report", rewritten(map_id="weak"), "--output", tmp_path / "a")
    fleetmap("report", rewritten(map_id="sound", weak_stretches=(), weak_length_m=0.0), "--output", tmp_path / "b")
    weak, sound = (cv2.imread(str(tmp_path / name / "report.png")).astype(int) for name in ("a", "b"))
    assert weak.shape == (1080, 1920, 3)
    red = [int((picture[..., 2] - picture[..., :2].max(axis=2) > 15).sum()) for picture in (weak, sound)]
    assert red[0] > red[1] + 40_000


def test_programs_get_everything_in_json(fleetmap, rewritten, tmp_path):
    folder = rewritten()
    code, out, _ = fleetmap("report", folder, "--output", tmp_path / "look", "--json")
    assert code == 0
    told = json.loads(out)
    assert (told["map_id"], told["missing"], told["limits"]) == ("street", [], LIMITS)
    assert told["version"] == open_package(folder).version
    assert told["quality"]["weak_stretches"][0]["reasons"][0]["kind"] == "position"
    keyframes = told["along_the_road"]["keyframes"]
    assert (min(keyframes["horizontal_sigma_m"]), max(keyframes["horizontal_sigma_m"])) == (0.05, 1.5)
    assert told["along_the_road"]["fixes"]["residual_m"][0] == [0.03, -0.04, 0.02]
    assert [Path(path).name for path in told["written"]] == ["report.html", "report.png"]


def test_a_map_that_is_unfit_says_why(fleetmap, rewritten, tmp_path):
    """It also takes the place of an older report."""
    folder = rewritten(publishable=False, warnings=("only 20 of 71 images could be posed",))
    (tmp_path / "look").mkdir()
    (tmp_path / "look" / "report.html").write_text("old")
    code, out, _ = fleetmap("report", folder, "--output", tmp_path / "look")
    assert code == 0
    assert "verdict:        not fit to publish\nwarning:        only 20 of 71 images could be posed\n" in out
    assert "not fit to publish" in Page((tmp_path / "look" / "report.html").read_text()).text


def test_a_map_of_format_1_0_is_reported_as_far_as_it_goes(fleetmap, map_package, tmp_path):
    code, out, err = fleetmap("report", map_package, "--output", tmp_path / "look")
    assert (code, err) == (0, "")
    assert "position:       uncertainty unknown\n" in out
    assert "weak stretches: unknown\n" in out
    assert (
        "missing:        a map of format 1.0 without a quality part: nothing is known from place to place; " in out
    )
    assert "without a quality part" in Page((tmp_path / "look" / "report.html").read_text()).text


def test_a_map_without_joint_adjustment_has_no_uncertainty_and_the_rest(
    fleetmap, rewritten, map_package, tmp_path
):
    road = road_of(open_package(map_package), sigma_m=np.nan)
    road.keyframes.covariances_m2[:] = np.nan
    folder = rewritten(road, position_sigma_m=None, gnss_mode="none", weak_stretches=(), weak_length_m=0.0)
    told = json.loads(fleetmap("report", folder, "--output", tmp_path / "look", "--json")[1])
    assert told["missing"][0].startswith("no position uncertainty: with --gnss none no joint adjustment ties")
    assert set(told["along_the_road"]["keyframes"]["horizontal_sigma_m"]) == {None}
    assert told["along_the_road"]["steps"]["landmarks_per_m"] == [10.0] * 15


@pytest.mark.parametrize("place", ["nowhere", "empty", "damaged"])
def test_what_is_no_map_is_refused_in_one_line_and_nothing_is_written(fleetmap, rewritten, tmp_path, place):
    (tmp_path / "empty").mkdir()
    damaged = rewritten(map_id="damaged")
    record = next(part for part in open_package(damaged).manifest.parts if part.kind == "quality")
    (damaged / "parts" / f"{record.sha256}.bin").write_bytes(b"\0" * record.size_bytes)
    code, out, err = fleetmap("report", tmp_path / place, "--output", tmp_path / "look")
    assert (code, out) == (2, "")
    assert err.startswith("error: ")
    assert err.count("\n") == 1
    assert not (tmp_path / "look").exists()


def test_a_folder_that_cannot_be_written_is_an_error_in_one_line(fleetmap, rewritten, tmp_path):
    (tmp_path / "file").write_text("in the way")
    code, _, err = fleetmap("report", rewritten(), "--output", tmp_path / "file")
    assert code == 1
    assert err.startswith(f"error: cannot write {tmp_path / 'file' / 'report.png'}: ")
    assert err.count("\n") == 1
