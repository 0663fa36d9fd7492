"""A folder of images and a table of times and positions, as phones and dash cams give them."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import cv2
import numpy as np
import pytest

from fleetmap.camera import Camera
from fleetmap.drive import START_NS
from fleetmap.drives import open_drive
from fleetmap.drives.image_folder import ImageClock, convert_image_folder
from fleetmap.drives.image_folder_tables import UNKNOWN_HEIGHT_SIGMA_M, PositionDefaults
from fleetmap.errors import CalibrationError, DriveError, InputError
from fleetmap.geodesy import UtmGrid

NOON_NS = 1_714_564_800_000_000_000  # 2024-05-01T12:00:00Z
IMAGE_NS, FIX_NS = 100_000_000, 250_000_000
COUNT, FIXES = 10, 5
PHONE = Camera(64, 48, 50.0, 51.0, 31.5, 23.5, (0.1, -0.2, 0.001, 0.002, 0.3))


def position(index: int) -> tuple[float, float, float]:
    return 48.0 + 1e-5 * index, 11.0 - 2e-5 * index, 520.0 + 0.25 * index


def write_images(folder: Path, pictures: list[np.ndarray], names: list[str]) -> None:
    folder.mkdir()
    for name, picture in zip(names, pictures, strict=True):
        cv2.imwrite(str(folder / name), cv2.merge([picture, picture // 2, 255 - picture]))


def write_csv(path: Path, header: str, rows: list[str]) -> Path:
    path.write_text("\n".join([header, *rows]) + "\n")
    return path


@pytest.fixture
def photos(tmp_path, pictures) -> Path:
    """Ten JPEGs named by their times in ms."""
    folder = tmp_path / "photos"
    write_images(folder, pictures, [f"{NOON_NS // 10**6 + 100 * index}.jpg" for index in range(COUNT)])
    return folder


@pytest.fixture
def counted(tmp_path, pictures) -> Path:
    """Ten JPEGs with counters for names."""
    folder = tmp_path / "counted"
    write_images(folder, pictures, [f"frame_{index}.jpg" for index in range(1, COUNT + 1)])
    return folder


@pytest.fixture
def track(tmp_path) -> Path:
    rows = []
    for index in range(FIXES):
        lat, lon, height = position(index)
        rows.append(f"{(NOON_NS + index * FIX_NS) / 1e9:.3f},{lat:.7f},{lon:.7f},{height},{2.0 + index},{4.0}")
    return write_csv(tmp_path / "track.csv", "Timestamp,lat,lon,altitude,accuracy,vertical accuracy", rows)


def stamps_of(recording: Path) -> list[int]:
    return [frame.stamp_ns for frame in open_drive(recording).frames()]


def test_another_tool_reads_back_what_the_folder_and_the_table_hold(photos, track, tmp_path, read_by_rosbags):
    done = convert_image_folder(photos, track, tmp_path / "out.mcap", camera=PHONE)
    assert (done.frame_count, done.fix_count, done.reference, done.remarks) == (COUNT, FIXES, None, ())
    messages = read_by_rosbags(tmp_path / "out.mcap")
    assert sorted(messages) == ["/camera/camera_info", "/camera/image/compressed", "/gnss/fix"]
    for index, image in enumerate(messages["/camera/image/compressed"]):
        path = photos / f"{NOON_NS // 10**6 + 100 * index}.jpg"
        assert image.data.tobytes() == path.read_bytes()
        assert image.format == "jpeg"
        assert image.header.stamp.sec * 10**9 + image.header.stamp.nanosec == NOON_NS + index * IMAGE_NS
    for index, fix in enumerate(messages["/gnss/fix"]):
        assert (fix.latitude, fix.longitude, fix.altitude) == pytest.approx(position(index), abs=1e-9)
        assert fix.header.stamp.sec * 10**9 + fix.header.stamp.nanosec == NOON_NS + index * FIX_NS
        variances = np.diag([(2.0 + index) ** 2, (2.0 + index) ** 2, 16.0])
        assert fix.position_covariance == pytest.approx(variances.reshape(9))


def test_the_drive_is_the_folder(photos, track, tmp_path):
    convert_image_folder(photos, track, tmp_path / "out.mcap", camera=PHONE)
    drive = open_drive(tmp_path / "out.mcap")
    assert drive.camera == PHONE
    frames = list(drive.frames())
    assert [frame.stamp_ns for frame in frames] == [NOON_NS + index * IMAGE_NS for index in range(COUNT)]
    path = photos / f"{NOON_NS // 10**6 + 300}.jpg"
    assert np.array_equal(frames[3].image, cv2.imread(str(path), cv2.IMREAD_GRAYSCALE))
    assert [(f.lat_deg, f.lon_deg, f.height_m) for f in drive.gnss_fixes()] == [
        pytest.approx(position(index), abs=1e-9) for index in range(FIXES)
    ]
    assert drive.antenna().position_in_cam_m == pytest.approx([0.0, 0.0, 0.0])


@pytest.mark.parametrize(("suffix", "image_format"), [(".png", "png"), (".JPG", "jpeg"), (".jpeg", "jpeg")])
def test_jpeg_and_png_pass_through_byte_by_byte(tmp_path, pictures, track, read_by_rosbags, suffix, image_format):
    names = [f"{NOON_NS + index * IMAGE_NS}{suffix}" for index in range(COUNT)]
    write_images(tmp_path / "images", pictures, names)
    convert_image_folder(tmp_path / "images", track, tmp_path / "out.mcap", camera=PHONE)
    images = read_by_rosbags(tmp_path / "out.mcap")["/camera/image/compressed"]
    assert [image.data.tobytes() for image in images] == [(tmp_path / "images" / n).read_bytes() for n in names]
    assert {image.format for image in images} == {image_format}


@pytest.mark.parametrize("suffix", [".bmp", ".tiff"])
def test_other_images_become_png_without_loss(tmp_path, pictures, track, read_by_rosbags, suffix):
    write_images(tmp_path / "images", pictures, [f"{NOON_NS + i * IMAGE_NS}{suffix}" for i in range(COUNT)])
    convert_image_folder(tmp_path / "images", track, tmp_path / "out.mcap", camera=PHONE)
    image = read_by_rosbags(tmp_path / "out.mcap")["/camera/image/compressed"][6]
    assert image.format == "png"
    original = cv2.imread(str(tmp_path / "images" / f"{NOON_NS + 6 * IMAGE_NS}{suffix}"))
    assert np.array_equal(cv2.imdecode(image.data, cv2.IMREAD_UNCHANGED), original)


class TestImageTimes:
    expected = tuple(NOON_NS + index * IMAGE_NS for index in range(COUNT))

    def iso(self, index: int) -> str:
        whole = datetime.fromtimestamp(NOON_NS // 10**9, UTC)
        return f"{whole:%Y-%m-%dT%H:%M:%S}.{index}Z"

    def test_from_a_table_of_their_own(self, counted, track, tmp_path):
        rows = [f"{self.iso(index)};frame_{index + 1}.jpg" for index in reversed(range(COUNT))]
        table = write_csv(tmp_path / "times.csv", "time;name", rows)
        convert_image_folder(counted, track, tmp_path / "out.mcap", camera=PHONE, clock=ImageClock(table=table))
        assert tuple(stamps_of(tmp_path / "out.mcap")) == self.expected

    def test_at_a_constant_rate_in_the_order_of_numbers(self, counted, track, tmp_path, read_by_rosbags):
        clock = ImageClock(rate_hz=10.0, start_ns=NOON_NS)
        convert_image_folder(counted, track, tmp_path / "out.mcap", camera=PHONE, clock=clock)
        images = read_by_rosbags(tmp_path / "out.mcap")["/camera/image/compressed"]
        assert tuple(stamps_of(tmp_path / "out.mcap")) == self.expected
        assert [image.data.tobytes() for image in images] == [
            (counted / f"frame_{index}.jpg").read_bytes() for index in range(1, COUNT + 1)
        ]

    def test_from_a_table_that_also_holds_the_positions(self, counted, tmp_path):
        """The last image had no reception."""
        rows = []
        for index in range(COUNT):
            lat, lon, height = position(index)
            place = f"{lat},{lon},{height}" if index < COUNT - 1 else ",,"
            rows.append(f"photos/frame_{index + 1}.jpg,{self.iso(index)},{place}")
        table = write_csv(tmp_path / "all.csv", "filename,utc,Latitude,Longitude,Elevation (m)", rows)
        done = convert_image_folder(counted, table, tmp_path / "out.mcap", camera=PHONE)
        assert tuple(stamps_of(tmp_path / "out.mcap")) == self.expected
        assert done.fix_count == COUNT - 1
        assert [f.stamp_ns for f in open_drive(tmp_path / "out.mcap").gnss_fixes()] == list(self.expected[:-1])

    @pytest.mark.parametrize("pattern", ["IMG_20240501_120000_{:03d}.jpg", "PXL_20240501_120000{:03d}.jpg"])
    def test_from_the_names_that_phones_give(self, tmp_path, pictures, track, pattern):
        write_images(tmp_path / "dcim", pictures, [pattern.format(100 * index) for index in range(COUNT)])
        convert_image_folder(tmp_path / "dcim", track, tmp_path / "out.mcap", camera=PHONE)
        assert tuple(stamps_of(tmp_path / "out.mcap")) == self.expected

    def test_from_exif(self, counted, track, tmp_path):
        for index in range(COUNT):
            path = counted / f"frame_{index + 1}.jpg"
            jpeg = path.read_bytes()
            path.write_bytes(jpeg[:2] + exif_segment("2024:05:01 12:00:00", str(index)) + jpeg[2:])
        convert_image_folder(counted, track, tmp_path / "out.mcap", camera=PHONE)
        assert tuple(stamps_of(tmp_path / "out.mcap")) == self.expected

    def test_a_cameras_clock_can_be_shifted(self, tmp_path, pictures, track):
        """A dash cam on summer time, two hours ahead and 0.3 s late."""
        names = [f"20240501_140000_{100 * index:03d}.jpg" for index in range(COUNT)]
        write_images(tmp_path / "dashcam", pictures, names)
        clock = ImageClock(offset_s=-7200.3)
        convert_image_folder(tmp_path / "dashcam", track, tmp_path / "out.mcap", camera=PHONE, clock=clock)
        assert stamps_of(tmp_path / "out.mcap") == [stamp_ns - 300_000_000 for stamp_ns in self.expected]

    def test_clocks_that_do_not_overlap_are_refused_with_both_times(self, tmp_path, pictures, track):
        write_images(tmp_path / "dashcam", pictures, [f"20240501_140000_{100 * i:03d}.jpg" for i in range(COUNT)])
        with pytest.raises(
            DriveError, match=r"from 2024-05-01T14:00:00\.000Z .* from 2024-05-01T12:00:00\.000Z .* --image-clock"
        ):
            convert_image_folder(tmp_path / "dashcam", track, tmp_path / "out.mcap", camera=PHONE)

    def test_without_any_time_every_way_out_is_named(self, counted, track, tmp_path):
        with pytest.raises(DriveError, match=r"frame_1\.jpg has no time.* --image-times CSV, or --rate-hz"):
            convert_image_folder(counted, track, tmp_path / "out.mcap", camera=PHONE)

    def test_one_image_without_time_is_named(self, photos, track, tmp_path):
        (photos / "holiday.jpg").write_bytes((photos / f"{NOON_NS // 10**6}.jpg").read_bytes())
        with pytest.raises(DriveError, match=r"holiday\.jpg has no time, although 10 other images have"):
            convert_image_folder(photos, track, tmp_path / "out.mcap", camera=PHONE)

    def test_two_images_of_one_time_are_named(self, photos, track, tmp_path):
        (photos / f"again_{NOON_NS // 10**6}.jpg").write_bytes((photos / f"{NOON_NS // 10**6}.jpg").read_bytes())
        with pytest.raises(DriveError, match=r"4800000\.jpg and .*4800000\.jpg have the same time, .*--rate-hz"):
            convert_image_folder(photos, track, tmp_path / "out.mcap", camera=PHONE)
        assert not (tmp_path / "out.mcap").exists()

    @pytest.mark.parametrize(
        ("rows", "message"),
        [
            (
                [f"frame_{i}.jpg,{i}" for i in range(1, COUNT)],
                r"frame_10\.jpg has no time: .*times\.csv has no row",
            ),
            ([f"frame_{i}.jpg,{i}" for i in range(1, COUNT + 2)], r"times\.csv line 12 names frame_11\.jpg"),
            (["frame_1.jpg,1", "frame_1.jpg,2"], r"times\.csv line 3: frame_1\.jpg has a row already, line 2"),
            (["frame_1.jpg,noon"], r"times\.csv line 2: 'noon' is no time"),
            (["frame_1.jpg"], r"times\.csv line 2: '' is no time"),
        ],
    )
    def test_a_table_that_does_not_fit_the_folder(self, counted, track, tmp_path, rows, message):
        clock = ImageClock(table=write_csv(tmp_path / "times.csv", "image,time", rows))
        with pytest.raises(DriveError, match=message):
            convert_image_folder(counted, track, tmp_path / "out.mcap", camera=PHONE, clock=clock)

    @pytest.mark.parametrize(
        ("clock", "message"),
        [
            (ImageClock(rate_hz=0.0, start_ns=NOON_NS), "rate of 0.0"),
            (ImageClock(rate_hz=float("nan"), start_ns=NOON_NS), "rate of nan"),
            (ImageClock(rate_hz=10.0), "--start"),
            (ImageClock(offset_s=float("inf")), "offset of inf"),
        ],
    )
    def test_settings_that_make_no_sense(self, counted, track, tmp_path, clock, message):
        with pytest.raises(InputError, match=message):
            convert_image_folder(counted, track, tmp_path / "out.mcap", camera=PHONE, clock=clock)


class TestPositions:
    def convert(self, photos: Path, table: Path, **options) -> list:
        recording = table.with_name("out.mcap")
        self.done = convert_image_folder(photos, table, recording, camera=PHONE, force=True, **options)
        return open_drive(recording).gnss_fixes()

    def test_easting_and_northing_of_a_zone(self, photos, tmp_path):
        grid = UtmGrid(32632)
        rows = []
        for index in range(FIXES):
            lat, lon, height = position(index)
            easting, northing, _ = grid.from_geodetic(np.array(lat), np.array(lon), np.array(height))
            rows.append(f"{NOON_NS + index * FIX_NS}\t{easting:.4f}\t{northing:.4f}\t{height}")
        table = write_csv(tmp_path / "utm.csv", "time_ns\tEasting [m]\tNorthing [m]\tHeight [m]", rows)
        fixes = self.convert(photos, table, defaults=PositionDefaults(epsg=32632))
        assert [(f.lat_deg, f.lon_deg, f.height_m) for f in fixes] == [
            pytest.approx(position(index), abs=2e-9) for index in range(FIXES)
        ]
        with pytest.raises(DriveError, match="--epsg"):
            self.convert(photos, table)

    def test_date_and_time_in_columns_of_their_own(self, photos, tmp_path):
        rows = ["2024-05-01,12:00:00.00,48,11,520", "2024-05-01,12:00:00.25,48,11,520"]
        fixes = self.convert(photos, write_csv(tmp_path / "t.csv", "date,time,lat,lng,alt", rows))
        assert [fix.stamp_ns for fix in fixes] == [NOON_NS, NOON_NS + FIX_NS]

    def test_times_relative_to_the_start_of_both(self, counted, tmp_path):
        table = write_csv(tmp_path / "t.csv", "t_s,lat,lon,height_m", ["0.0,48,11,520", "0.5,48,11,520"])
        fixes = self.convert(counted, table, clock=ImageClock(rate_hz=10.0, start_ns=START_NS))
        assert [fix.stamp_ns for fix in fixes] == [START_NS, START_NS + 500_000_000]

    @pytest.mark.parametrize(("height_m", "written_m"), [(None, 0.0), (512.5, 512.5)])
    def test_without_heights_the_chosen_one_is_written_as_uncertain_and_said(
        self, photos, tmp_path, height_m, written_m
    ):
        table = write_csv(tmp_path / "flat.csv", "time,lat,lon", ["1714564800,48,11", "1714564801,48,11"])
        fixes = self.convert(photos, table, defaults=PositionDefaults(height_m=height_m, accuracy_m=3.0))
        assert [fix.height_m for fix in fixes] == [written_m, written_m]
        variances = np.diag([9.0, 9.0, UNKNOWN_HEIGHT_SIGMA_M**2])
        assert fixes[0].covariance_enu_m2 == pytest.approx(variances)
        assert any("no heights" in remark and f"{written_m:g} m" in remark for remark in self.done.remarks)

    def test_rows_without_reception_are_counted(self, photos, tmp_path):
        rows = ["1714564800,,,", "1714564800.2,48,11,520", "", "1714564800.4,,,", "1714564800.6,48,11,520"]
        fixes = self.convert(photos, write_csv(tmp_path / "t.csv", "time,lat,lon,alt", rows))
        assert len(fixes) == 2
        assert any("2 rows" in remark for remark in self.done.remarks)

    def test_an_accuracy_that_is_not_known_is_the_default(self, photos, tmp_path):
        rows = ["1714564800,48,11,520,-1", "1714564801,48,11,520,", "1714564802,48,11,520,4"]
        fixes = self.convert(photos, write_csv(tmp_path / "t.csv", "time,lat,lon,alt,hAcc", rows))
        assert [float(fix.covariance_enu_m2[0, 0]) for fix in fixes] == [2.25, 2.25, 16.0]

    def test_an_antenna_elsewhere_is_a_static_transform(self, photos, track, tmp_path):
        self.convert(photos, track, antenna_in_camera_m=(-0.1, -0.5, 1.0))
        antenna = open_drive(tmp_path / "out.mcap").antenna()
        assert antenna.source == "static transform"
        assert antenna.position_in_cam_m == pytest.approx([-0.1, -0.5, 1.0])

    @pytest.mark.parametrize(
        ("header", "rows", "message"),
        [
            ("time,lat,lon,alt", ["1714564800,48,11,520", "garbage"], r"line 3 has 1 fields instead of 4"),
            ("time,lat,lon,alt", ["1714564800,48,north,520"], r"line 2: lon 'north' is no number"),
            ("time,lat,lon,alt", ["1714564800,48,nan,520"], r"line 2: lon 'nan' is no number"),
            ("time,lat,lon,alt", ["1714564800,48,,520"], r"line 2: lon '' is no number"),
            ("time,lat,lon,alt", ["1714564800,148,11,520"], r"line 2: latitude 148\.0.* not on the globe"),
            ("time,lat,lon,alt", ["1714564800,48,11,"], r"line 2 has no height; give --height-m"),
            ("time,lat,lon,alt", ["late,48,11,520"], r"line 2: 'late' is no time"),
            ("time,lat,lon,alt", ["1714564801,48,11,5", "1714564800,48,11,5"], r"line 3 is not later"),
            ("time,lat,lon,alt", ["1714564800,48,11,5", "1714564800,48,11,5"], r"line 3 is not later"),
            ("time,lat,alt", ["1714564800,48,520"], r"no column for lon; its first line names time, lat, alt"),
            ("when,lat,lon", ["1714564800,48,520"], r"no column for time"),
            ("1714564800,48,11,520", ["1714564801,48,11,520"], r"no column for time and lat and lon"),
            ("time_ms,lat,lon,alt", ["1714564800123456789,48,11,520"], r"line 2: .* before 2038"),
            ("time,lat,lon,alt", [], "holds no positions"),
            ("", [], "is empty"),
        ],
    )
    def test_a_damaged_table_is_one_line_that_names_the_row(self, photos, tmp_path, header, rows, message):
        table = write_csv(tmp_path / "bad.csv", header, rows)
        with pytest.raises(DriveError, match=message) as refused:
            self.convert(photos, table)
        assert "bad.csv" in str(refused.value)
        assert "\n" not in str(refused.value)
        assert sorted(p.name for p in tmp_path.iterdir()) == ["bad.csv", "photos"]

    @pytest.mark.parametrize(
        "settings", [{"accuracy_m": float("inf")}, {"accuracy_m": 0.0}, {"height_m": float("nan")}]
    )
    def test_defaults_that_make_no_sense(self, settings):
        with pytest.raises(InputError, match="makes no sense"):
            PositionDefaults(**settings)

    def test_bytes_that_are_no_text_are_refused(self, photos, tmp_path):
        (tmp_path / "bad.csv").write_bytes(b"\xff\xfe\x00time")
        with pytest.raises(DriveError, match="not a text file"):
            self.convert(photos, tmp_path / "bad.csv")


def test_images_of_another_size_are_refused_with_the_numbers(photos, track, tmp_path):
    with pytest.raises(CalibrationError, match=r"\.jpg has 64x48 pixels, the calibration is for 48x64"):
        convert_image_folder(photos, track, tmp_path / "out.mcap", camera=Camera(48, 64, 50.0, 50.0, 24.0, 32.0))
    assert not (tmp_path / "out.mcap").exists()


def test_a_damaged_image_is_named(photos, track, tmp_path):
    path = photos / f"{NOON_NS // 10**6 + 400}.jpg"
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(DriveError, match=f"{path.name} cannot be decoded"):
        convert_image_folder(photos, track, tmp_path / "out.mcap", camera=PHONE)
    path.write_bytes(b"")
    with pytest.raises(DriveError, match=f"{path.name} cannot be decoded"):
        convert_image_folder(photos, track, tmp_path / "out.mcap", camera=PHONE)
    assert not (tmp_path / "out.mcap").exists()


@pytest.mark.parametrize("name", ["nowhere", "empty"])
def test_a_folder_without_images_is_refused(track, tmp_path, name):
    (tmp_path / "empty").mkdir()
    (tmp_path / "empty" / "notes.txt").write_text("no image")
    with pytest.raises(DriveError, match=name):
        convert_image_folder(tmp_path / name, track, tmp_path / "out.mcap", camera=PHONE)


def exif_segment(taken: str, fraction: str) -> bytes:
    """An APP1 segment as cameras write it, in the order of Intel's bytes."""
    le = "little"
    text = taken.encode() + b"\0"
    first = (1).to_bytes(2, le) + bytes([0x69, 0x87, 4, 0]) + (1).to_bytes(4, le) + (26).to_bytes(4, le) + bytes(4)
    entries = bytes([0x03, 0x90, 2, 0]) + len(text).to_bytes(4, le) + (56).to_bytes(4, le)
    entries += bytes([0x91, 0x92, 2, 0]) + (2).to_bytes(4, le) + fraction.encode().ljust(4, b"\0")
    directory = (2).to_bytes(2, le) + entries + bytes(4)
    exif = b"Exif\0\0II*\0" + (8).to_bytes(4, le) + first + directory + text
    return b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif
