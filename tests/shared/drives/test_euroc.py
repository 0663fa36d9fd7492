"""Folders in the ASL layout, built small and true to the published one, and the real IMU of a EuRoC sequence."""

from __future__ import annotations

import gzip
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fleetmap.camera import Camera
from fleetmap.drives import open_drive
from fleetmap.drives.conversion import SimulatedGnss
from fleetmap.drives.euroc import convert_euroc
from fleetmap.drives.local_poses import Site
from fleetmap.errors import CalibrationError, DriveError
from fleetmap.geodesy import UtmGrid
from fleetmap.geometry import Pose, so3_exp
from fleetmap.trajectory import read_trajectory

T0_NS = 1_403_715_273_262_142_976
IMAGE_NS, IMU_NS = 50_000_000, 5_000_000
SITE = Site(47.3769, 8.5417, 450.0)
BODY_FROM_CAM = Pose(so3_exp(np.array([0.3, -0.2, 1.5])), np.array([0.02, -0.06, 0.01]))
BODY_FROM_TRUTH = Pose(so3_exp(np.array([0.0, 0.1, 0.0])), np.array([0.1, 0.0, 0.05]))
COUNT = 12

SENSOR_YAML = """%YAML:1.0
# General sensor definitions.
sensor_type: {kind}
comment: made for a test
T_BS:
  cols: 4
  rows: 4
  data: [{matrix}]
rate_hz: 20
{more}"""
CAMERA_YAML = """resolution: [64, 48]
camera_model: pinhole
intrinsics: [50.0, 51.0, 31.5, 23.5] #fu, fv, cu, cv
distortion_model: {model}
distortion_coefficients: [{coefficients}]
"""


def sensor_yaml(kind: str, body_from_sensor: Pose, more: str = "") -> str:
    matrix = np.vstack(
        [np.column_stack([body_from_sensor.rotation, body_from_sensor.translation_m]), [0, 0, 0, 1]]
    )
    return SENSOR_YAML.format(kind=kind, matrix=", ".join(f"{v:.12f}" for v in matrix.ravel()), more=more)


def room_from_body(stamp_ns: int) -> Pose:
    t = (stamp_ns - T0_NS) * 1e-9
    return Pose(so3_exp(np.array([0.1 * t, 0.2 * t, 0.5 * t])), np.array([1.0 + 2.0 * t, -0.5 * t, 1.2]))


def origin_m() -> np.ndarray:
    return UtmGrid(32632).from_geodetic(np.array(SITE.lat_deg), np.array(SITE.lon_deg), np.array(SITE.height_m))


def imu_values(index: int) -> np.ndarray:
    return np.array([0.01, -0.02, 0.03, 9.1, 0.13, -3.7]) * (1.0 + index / 100.0)


def write_table(sensor: Path, header: str, rows: list[str]) -> None:
    sensor.mkdir(parents=True, exist_ok=True)
    (sensor / "data.csv").write_text("\r\n".join([f"#{header}", *rows]) + "\r\n")  # as published, with CRLF


def write_truth(folder: Path, name: str = "state_groundtruth_estimate0") -> None:
    rows = []
    for stamp_ns in range(T0_NS - IMU_NS, T0_NS + COUNT * IMAGE_NS, IMU_NS):
        pose = room_from_body(stamp_ns) @ BODY_FROM_TRUTH
        x, y, z, w = Rotation.from_matrix(pose.rotation).as_quat()
        numbers = [*pose.translation_m, w, x, y, z, *(0.0,) * 9]
        rows.append(f"{stamp_ns}," + ",".join(f"{value:.9f}" for value in numbers))
    write_table(folder / "mav0" / name, "timestamp, p_RS_R_x [m], ...", rows)
    (folder / "mav0" / name / "sensor.yaml").write_text(sensor_yaml("visual-inertial", BODY_FROM_TRUTH))


@pytest.fixture
def asl(tmp_path, pictures) -> Path:
    folder = tmp_path / "V9_01_easy"
    cam, imu = folder / "mav0" / "cam0", folder / "mav0" / "imu0"
    (cam / "data").mkdir(parents=True)
    stamps_ns = [T0_NS + index * IMAGE_NS for index in range(COUNT)]
    for index, stamp_ns in enumerate(stamps_ns):
        cv2.imwrite(str(cam / "data" / f"{stamp_ns}.png"), pictures[index % len(pictures)])
    write_table(cam, "timestamp [ns],filename", [f"{stamp_ns},{stamp_ns}.png" for stamp_ns in stamps_ns])
    lens = CAMERA_YAML.format(model="radial-tangential", coefficients="-0.28, 0.07, 0.0002, 1.76e-05")
    (cam / "sensor.yaml").write_text(sensor_yaml("camera", BODY_FROM_CAM, lens))
    rows = [
        f"{T0_NS + index * IMU_NS}," + ",".join(repr(float(value)) for value in imu_values(index))
        for index in range(120)
    ]
    write_table(imu, "timestamp [ns],w_RS_S_x [rad s^-1],...", rows)
    (imu / "sensor.yaml").write_text(sensor_yaml("imu", Pose.identity()))
    return folder


@pytest.fixture
def asl_with_truth(asl) -> Path:
    write_truth(asl)
    return asl


def test_another_tool_reads_back_what_the_folder_holds(asl, tmp_path, read_by_rosbags):
    done = convert_euroc(asl, tmp_path / "out.mcap")
    messages = read_by_rosbags(tmp_path / "out.mcap")
    assert (done.frame_count, done.imu_count, done.fix_count, done.reference) == (COUNT, 120, 0, None)
    assert sorted(messages) == ["/cam0/camera_info", "/cam0/image/compressed", "/imu0/data", "/tf_static"]
    images = sorted((asl / "mav0" / "cam0" / "data").iterdir())
    recorded = messages["/cam0/image/compressed"]
    assert [m.data.tobytes() for m in recorded] == [path.read_bytes() for path in images]
    assert [f"{m.header.stamp.sec * 10**9 + m.header.stamp.nanosec}.png" for m in recorded] == [
        path.name for path in images
    ]
    for index, imu in enumerate(messages["/imu0/data"]):
        gyro, accelerometer = imu.angular_velocity, imu.linear_acceleration
        read = [gyro.x, gyro.y, gyro.z, accelerometer.x, accelerometer.y, accelerometer.z]
        assert read == imu_values(index).tolist()
        assert imu.header.stamp.sec * 10**9 + imu.header.stamp.nanosec == T0_NS + index * IMU_NS
        assert imu.header.frame_id == "imu0"
    (mounting,) = messages["/tf_static"]
    by_child = {t.child_frame_id: t for t in mounting.transforms}
    assert {t.header.frame_id for t in mounting.transforms} == {"body"}
    translation = by_child["cam0"].transform.translation
    assert [translation.x, translation.y, translation.z] == pytest.approx(BODY_FROM_CAM.translation_m)
    q = by_child["cam0"].transform.rotation
    assert Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix() == pytest.approx(BODY_FROM_CAM.rotation, abs=1e-9)
    assert by_child["imu0"].transform.rotation.w == pytest.approx(1.0)


def test_the_drive_is_the_folder(asl, tmp_path, pictures):
    convert_euroc(asl, tmp_path / "out.mcap")
    drive = open_drive(tmp_path / "out.mcap")
    assert drive.camera == Camera(64, 48, 50.0, 51.0, 31.5, 23.5, (-0.28, 0.07, 0.0002, 1.76e-05, 0.0))
    frames = list(drive.frames())
    assert [frame.stamp_ns for frame in frames] == [T0_NS + index * IMAGE_NS for index in range(COUNT)]
    assert all(np.array_equal(f.image, pictures[i % len(pictures)]) for i, f in enumerate(frames))
    samples = list(drive.imu_samples())
    assert len(samples) == 120
    assert samples[7].linear_acceleration_m_s2 == pytest.approx(imu_values(7)[3:], abs=0.0)


@pytest.mark.parametrize(
    ("written", "model", "coefficients"),
    [
        ("radtan", "plumb_bob", (0.1, 0.2, 0.003, 0.004, 0.0)),
        ("equidistant", "equidistant", (0.1, 0.2, 0.003, 0.004)),
    ],
)
def test_lenses_by_the_names_of_the_layout(asl, tmp_path, written, model, coefficients):
    lens = CAMERA_YAML.format(model=written, coefficients="0.1, 0.2, 0.003, 0.004")
    (asl / "mav0" / "cam0" / "sensor.yaml").write_text(sensor_yaml("camera", BODY_FROM_CAM, lens))
    convert_euroc(asl, tmp_path / "out.mcap")
    assert open_drive(tmp_path / "out.mcap").camera == Camera(64, 48, 50.0, 51.0, 31.5, 23.5, coefficients, model)


def test_a_calibration_takes_the_place_of_the_intrinsics(asl, tmp_path):
    other = Camera(64, 48, 40.0, 41.0, 30.0, 20.0, (0.1, 0.0, 0.0, 0.0), "equidistant")
    (asl / "mav0" / "cam0" / "sensor.yaml").unlink()
    convert_euroc(asl, tmp_path / "out.mcap", calibration=other)
    assert open_drive(tmp_path / "out.mcap").camera == other


def test_images_without_a_table_have_their_stamps_in_their_names(asl, tmp_path):
    (asl / "mav0" / "cam0" / "data.csv").unlink()
    convert_euroc(asl / "mav0", tmp_path / "out.mcap")
    stamps_ns = [frame.stamp_ns for frame in open_drive(tmp_path / "out.mcap").frames()]
    assert stamps_ns == [T0_NS + index * IMAGE_NS for index in range(COUNT)]


class TestTruth:
    def test_without_a_site_there_is_no_reference_but_a_line_that_says_why(self, asl_with_truth, tmp_path):
        done = convert_euroc(asl_with_truth, tmp_path / "out.mcap")
        assert done.reference is None
        assert any("--origin" in remark for remark in done.remarks)
        assert not list(tmp_path.glob("*.tum"))

    @pytest.mark.parametrize("name", ["state_groundtruth_estimate0", "mocap0", "vicon0"])
    def test_at_a_site_it_is_the_cameras_pose_in_utm(self, asl, tmp_path, name):
        write_truth(asl, name)
        done = convert_euroc(asl, tmp_path / "out.mcap", site=SITE)
        reference = read_trajectory(done.reference)
        assert (reference.epsg, len(reference)) == (32632, COUNT)
        for index in range(COUNT):
            expected = room_from_body(T0_NS + index * IMAGE_NS) @ BODY_FROM_CAM
            assert reference.positions_m[index] - origin_m() == pytest.approx(expected.translation_m, abs=1e-5)
            assert reference.rotations[index] == pytest.approx(expected.rotation, abs=1e-6)

    def test_between_two_states_the_pose_is_interpolated_and_across_a_gap_there_is_none(self, asl, tmp_path):
        """Image 2 has no state of its own; around images 4 to 6 there are none for 190 ms."""
        write_truth(asl)
        table = asl / "mav0" / "state_groundtruth_estimate0" / "data.csv"
        header, *rows = table.read_text().splitlines()
        since_start_ns = [int(row.split(",")[0]) - T0_NS for row in rows]
        kept = [
            row
            for row, since_ns in zip(rows, since_start_ns, strict=True)
            if since_ns != 2 * IMAGE_NS and not 160_000_000 < since_ns < 340_000_000
        ]
        table.write_text("\n".join([header, *kept]))
        done = convert_euroc(asl, tmp_path / "out.mcap", site=SITE)
        reference = read_trajectory(done.reference)
        indices = np.rint((reference.stamps_ns - T0_NS) / IMAGE_NS).astype(int).tolist()
        assert indices == [0, 1, 2, 3, 7, 8, 9, 10, 11]
        expected = room_from_body(T0_NS + 2 * IMAGE_NS) @ BODY_FROM_CAM
        assert reference.positions_m[2] - origin_m() == pytest.approx(expected.translation_m, abs=1e-4)
        assert reference.rotations[2] == pytest.approx(expected.rotation, abs=1e-4)

    def test_fixes_are_made_from_the_reference(self, asl_with_truth, tmp_path):
        gnss = SimulatedGnss("rtk", interval_s=0.1, seed=4)
        done = convert_euroc(asl_with_truth, tmp_path / "out.mcap", site=SITE, gnss=gnss)
        drive, reference = open_drive(tmp_path / "out.mcap"), read_trajectory(done.reference)
        fixes = drive.gnss_fixes()
        assert done.fix_count == len(fixes) == 7
        assert drive.antenna().source == "same frame"
        measured = UtmGrid(reference.epsg).from_geodetic(
            *(np.array([getattr(fix, name) for fix in fixes]) for name in ("lat_deg", "lon_deg", "height_m"))
        )
        nearest = [int(np.argmin(np.abs(reference.stamps_ns - fix.stamp_ns))) for fix in fixes]
        errors_m = np.linalg.norm(measured - reference.positions_m[nearest], axis=1)
        assert 0.0 < errors_m.mean() < 0.3

    @pytest.mark.parametrize(
        ("options", "message"),
        [({"site": SITE}, "nothing to place"), ({"gnss": SimulatedGnss("rtk")}, "--origin")],
    )
    def test_what_needs_a_truth_says_so(self, asl, tmp_path, options, message):
        with pytest.raises(DriveError, match=message):
            convert_euroc(asl, tmp_path / "out.mcap", **options)
        assert not (tmp_path / "out.mcap").exists()


def damage(path: Path, line: int, text: str) -> None:
    lines = path.read_text().splitlines()
    lines[line - 1] = text
    path.write_text("\n".join(lines))


@pytest.mark.parametrize(
    ("table", "line", "text", "message"),
    [
        ("cam0", 4, "not a time,1.png", "cam0/data.csv line 4: 'not a time' is no time"),
        ("cam0", 4, f"{T0_NS + 2 * IMAGE_NS}", "cam0/data.csv line 4 is not 'timestamp,filename'"),
        ("cam0", 4, f"{T0_NS + 2 * IMAGE_NS},../../secret.png", "line 4 is not 'timestamp,filename'"),
        ("cam0", 4, f"{T0_NS + 2 * IMAGE_NS},1.png", "cannot read .*cam0/data/1.png"),
        ("cam0", 4, f"{T0_NS},{T0_NS}.png", "is not later than the image before it"),
        ("cam0", 4, f"{10**20},{T0_NS}.png", "cam0/data.csv line 4: .* is no time before 2038"),
        ("imu0", 9, f"{T0_NS},1,2,3,4,5,6", "imu0/data.csv line 9 is not later"),
        ("imu0", 9, f"{T0_NS + 7 * IMU_NS},1,2,3,4,5", "imu0/data.csv line 9 does not have 6 finite numbers"),
        ("imu0", 9, f"{T0_NS + 7 * IMU_NS},1,2,3,4,5,x", "imu0/data.csv line 9: could not convert"),
        ("imu0", 9, f"{T0_NS + 7 * IMU_NS},1,2,3,4,5,nan", "imu0/data.csv line 9 does not have 6 finite"),
    ],
)
def test_a_damaged_row_is_named_and_nothing_is_left(asl, tmp_path, table, line, text, message):
    damage(asl / "mav0" / table / "data.csv", line, text)
    with pytest.raises(DriveError, match=message):
        convert_euroc(asl, tmp_path / "out.mcap")
    assert [p.name for p in tmp_path.iterdir()] == [asl.name]


@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        ("resolution: [64, 48]", "resolution: [32, 24]", "has 64x48 pixels, the calibration is for 32x24"),
        ("camera_model: pinhole", "camera_model: omni", "camera_model is 'omni'"),
        ("radial-tangential", "FOV", "distortion model 'FOV'"),
        ("intrinsics: [50.0, ", "intrinsics: [", "intrinsics has 3 numbers, it needs 4"),
        ("T_BS:", "T_SB:", "data is missing"),
        ("data: [", "data: [9", "T_BS is no rigid transform"),
        ("intrinsics: [", "intrinsics: [[", "is not YAML"),
    ],
)
def test_a_damaged_calibration_is_one_clear_line(asl, tmp_path, before, after, message):
    path = asl / "mav0" / "cam0" / "sensor.yaml"
    path.write_text(path.read_text().replace(before, after))
    with pytest.raises(CalibrationError, match=message):
        convert_euroc(asl, tmp_path / "out.mcap")
    assert not (tmp_path / "out.mcap").exists()


@pytest.mark.parametrize(
    ("camera", "message"), [(1, r"no images of camera 1; it has cam0"), (0, "not in the ASL layout")]
)
def test_another_folder_is_refused(asl, tmp_path, camera, message):
    folder = asl if camera else tmp_path
    with pytest.raises(DriveError, match=message):
        convert_euroc(folder, tmp_path / "out.mcap", camera=camera)


def test_a_truncated_image_is_named(asl, tmp_path):
    path = asl / "mav0" / "cam0" / "data" / f"{T0_NS + 3 * IMAGE_NS}.png"
    path.write_bytes(path.read_bytes()[:-20])
    with pytest.raises(DriveError, match=f"{path.name} cannot be decoded"):
        convert_euroc(asl, tmp_path / "out.mcap")
    assert not (tmp_path / "out.mcap").exists()


def test_the_real_imu_arrives_at_its_full_rate(data_folder, tmp_path):
    folder = data_folder / "inertial" / "euroc_v1_01"
    if not folder.is_dir():
        pytest.skip(f"no EuRoC sequence at {folder}")
    done = convert_euroc(folder, tmp_path / "out.mcap")
    drive = open_drive(tmp_path / "out.mcap")
    with gzip.open(folder / "mav0" / "imu0" / "data.csv.gz", "rt") as file:
        rows = [line.split(",") for line in file if not line.startswith("#")]
    samples = list(drive.imu_samples())
    assert done.imu_count == len(samples) == len(rows) == 29_120
    assert [sample.stamp_ns for sample in samples] == [int(row[0]) for row in rows]
    read = np.array([[*s.angular_velocity_rad_s, *s.linear_acceleration_m_s2] for s in samples])
    assert np.array_equal(read, np.array([[float(value) for value in row[1:]] for row in rows]))
    assert np.median(np.linalg.norm(read[:, 3:], axis=1)) == pytest.approx(9.8, abs=0.2)
    assert (drive.camera.width_px, drive.camera.fx_px) == (752, 458.654)
    assert len(list(drive.frames())) == 6
