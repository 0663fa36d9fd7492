from __future__ import annotations

from pathlib import Path

import pytest

from fleetmap.camera import Camera
from fleetmap.camera_file import read_camera, write_camera
from fleetmap.errors import CalibrationError, OutputExistsError

CAMERAS = [
    Camera(1392, 512, 984.2439, 980.8141, 690.0, 233.1966, (-0.3728755, 0.2037299, 0.002219, 0.0013837, -0.0723)),
    Camera(
        1280, 720, 640.5, 641.5, 639.5, 359.5, (0.1, -0.2, 1e-05, 0.0, 0.3, 0.2, -0.1, 0.25), "rational_polynomial"
    ),
    Camera(752, 480, 458.654, 457.296, 367.215, 248.375, (0.01, -0.02, 0.003, -1e-06), "equidistant"),
]
TEXT = """
image_width: 640
image_height: 480
camera_name: dash
camera_matrix: {rows: 3, cols: 3, data: [500.0, 0, 319.5, 0, 510, 239.5, 0, 0, 1]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [-0.1, 2e-05, 0, 0, 0]}
"""


@pytest.mark.parametrize("camera", CAMERAS, ids=lambda camera: camera.distortion_model)
def test_what_is_written_is_read_back_to_the_last_digit(tmp_path: Path, camera: Camera) -> None:
    write_camera(tmp_path / "camera.yaml", camera)
    assert read_camera(tmp_path / "camera.yaml") == camera


def test_an_existing_file_is_not_replaced_unasked(tmp_path: Path) -> None:
    write_camera(tmp_path / "camera.yaml", CAMERAS[0])
    with pytest.raises(OutputExistsError):
        write_camera(tmp_path / "camera.yaml", CAMERAS[1])
    write_camera(tmp_path / "camera.yaml", CAMERAS[1], force=True)
    assert read_camera(tmp_path / "camera.yaml") == CAMERAS[1]


def test_numbers_that_yaml_takes_for_text_are_numbers(tmp_path: Path) -> None:
    (tmp_path / "camera.yaml").write_text(TEXT)
    assert read_camera(tmp_path / "camera.yaml") == Camera(
        640, 480, 500.0, 510.0, 319.5, 239.5, (-0.1, 2e-05, 0, 0, 0)
    )


def test_opencv_calls_eight_coefficients_plumb_bob_and_fisheye_what_ros_calls_otherwise(tmp_path: Path) -> None:
    eight = TEXT.replace("[-0.1, 2e-05, 0, 0, 0]", "[0.1, 0, 0, 0, 0, 0.2, 0, 0]")
    (tmp_path / "camera.yaml").write_text(eight)
    assert read_camera(tmp_path / "camera.yaml").distortion_model == "rational_polynomial"
    four = TEXT.replace("[-0.1, 2e-05, 0, 0, 0]", "[0.1, 0, 0, 0]").replace("plumb_bob", "fisheye")
    (tmp_path / "camera.yaml").write_text(four)
    assert read_camera(tmp_path / "camera.yaml").distortion_model == "equidistant"


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "is no calibration; it needs image_width"),
        ("- 1\n- 2\n", "is no calibration"),
        ("a: [1, 2", "is not YAML"),
        ("\x00\x01", "is not YAML"),
        (TEXT.replace("width: 640", "width: wide"), "image_width is missing or no whole number: 'wide'"),
        (TEXT.replace("image_width: 640\n", ""), "image_width is missing"),
        (TEXT.replace("image_width: 640", "image_width: -640"), "size -640x480 is not usable"),
        (TEXT.replace(", 0, 0, 1]}", "]}"), "camera_matrix.data has 6 numbers, it needs 9"),
        (TEXT.replace("500.0", "much"), "camera_matrix.data is no list of numbers"),
        (TEXT.replace("500.0", "-500.0"), "not usable: fx=-500.0"),
        (TEXT.replace("500.0", ".nan"), "not usable: fx=nan"),
        (TEXT.replace("500.0", "0.0"), "its K is zero"),
        (TEXT.replace("plumb_bob", "omni"), "'omni' is not one of plumb_bob, rational_polynomial, equidistant"),
        (TEXT.replace("distortion_coefficients", "coefficients"), "distortion_coefficients.data"),
        (
            TEXT.replace("[-0.1, 2e-05, 0, 0, 0]", "[0, 0, 0, 0, 0, 0, 0, 1, 1, 0, 0, 0]"),
            "rational_polynomial with 12 coefficients (thin prism or tilt) is not supported",
        ),
    ],
)  # fmt: skip
def test_a_file_that_is_no_calibration_is_refused_with_its_name_and_the_reason(
    tmp_path: Path, text: str, reason: str
) -> None:
    (tmp_path / "camera.yaml").write_text(text)
    with pytest.raises(CalibrationError) as caught:
        read_camera(tmp_path / "camera.yaml")
    assert "camera.yaml" in str(caught.value)
    assert reason in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_file_that_is_not_there_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match=r"cannot read camera file .*nowhere\.yaml: No such file"):
        read_camera(tmp_path / "nowhere.yaml")


def test_a_few_bytes_that_stand_for_gigabytes_are_refused_at_once(tmp_path):
    lines = [f"a{i}: &a{i} {{<<: [{', '.join([f'*a{i - 1}'] * 9)}]}}" for i in range(1, 12)]
    (tmp_path / "camera.yaml").write_text("\n".join(["a0: &a0 {x: 1}", *lines]))
    with pytest.raises(CalibrationError, match="aliases such as"):
        read_camera(tmp_path / "camera.yaml")
