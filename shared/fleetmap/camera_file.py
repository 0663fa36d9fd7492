"""A camera in a file of its own: YAML as ROS' camera_calibration writes it.

Keys: ``image_width``, ``image_height``, ``camera_matrix.data`` (9 numbers, row by row), ``distortion_model`` and
``distortion_coefficients.data``. What else the file holds (name, rectification and projection) is not needed here.
Source: http://wiki.ros.org/camera_calibration_parsers
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import yaml

from fleetmap.camera import Camera
from fleetmap.distortion import COEFFICIENT_COUNTS, DistortionModel
from fleetmap.errors import CalibrationError
from fleetmap.files import atomic_path, refuse_existing

_SIZE_LIMIT_BYTES = 1_000_000
_OTHER_NAMES: dict[str, DistortionModel] = {
    "": "plumb_bob",
    "fisheye": "equidistant",
    "kannala_brandt": "equidistant",
}


class _PlainLoader(yaml.SafeLoader):
    """Takes no aliases: a few hundred bytes of them can stand for gigabytes, and no calibration needs any."""

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        if self.check_event(yaml.AliasEvent):
            raise yaml.YAMLError("aliases such as *this are not taken")
        return super().compose_node(parent, index)


def read_camera(path: Path) -> Camera:
    """The camera of a calibration file.

    Raises:
        CalibrationError: not there, not YAML in that layout, or numbers that make no camera.
    """
    try:
        with path.open("rb") as file:
            text = file.read(_SIZE_LIMIT_BYTES + 1)
    except OSError as error:
        raise CalibrationError(f"cannot read camera file {path}: {error.strerror or error}") from error
    return parse_camera(text, f"camera file {path}")


def parse_camera(text: bytes | str, source: str) -> Camera:
    """The camera of a calibration file's content; ``source`` names it in errors. Raises as ``read_camera``."""
    content = _parsed(text, source)
    try:
        K = np.array(_numbers(content, "camera_matrix", 9)).reshape(3, 3)
        coefficients = tuple(_numbers(content, "distortion_coefficients", None))
        return camera_of_model(
            _size(content, "image_width"),
            _size(content, "image_height"),
            K,
            str(content.get("distortion_model") or ""),
            coefficients,
        )
    except CalibrationError as error:
        raise CalibrationError(f"{source}: {error}") from error


def write_camera(path: Path, camera: Camera, *, name: str = "camera", force: bool = False) -> None:
    """Write a camera as :func:`read_camera` and ROS' own tools read it.

    Raises:
        OutputExistsError: the file is there already and ``force`` is not given.
    """
    refuse_existing(path, force)
    K = camera.matrix
    P = np.hstack([K, np.zeros((3, 1))])
    content = {
        "image_width": camera.width_px,
        "image_height": camera.height_px,
        "camera_name": name,
        "camera_matrix": _matrix(K),
        "distortion_model": camera.distortion_model,
        "distortion_coefficients": _matrix(np.array([camera.distortion])),
        "rectification_matrix": _matrix(np.eye(3)),
        "projection_matrix": _matrix(P),
    }
    with atomic_path(path) as draft:
        draft.write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")


def camera_of_model(
    width_px: int, height_px: int, K: np.ndarray, model: str, coefficients: tuple[float, ...]
) -> Camera:
    """A camera from what calibrations hold: K (3, 3), a model's name, and as many coefficients as they gave.

    Fewer coefficients than the model has are taken as zero from there on, more have to be zero; a ``plumb_bob``
    or unnamed model with more than five is OpenCV's rational one.

    Raises:
        CalibrationError: an unknown model, too many coefficients, or numbers that make no camera.
    """
    known = _OTHER_NAMES.get(model.strip().lower(), model.strip().lower())
    if known == "plumb_bob" and any(coefficients[5:]):
        known = "rational_polynomial"
    if known not in COEFFICIENT_COUNTS:
        raise CalibrationError(
            f"distortion model '{model}' is not one of {', '.join(COEFFICIENT_COUNTS)};"
            " calibrate with one of them, or record rectified images"
        )
    count = COEFFICIENT_COUNTS[known]
    if any(coefficients[count:]):
        raise CalibrationError(
            f"{known} with {len(coefficients)} coefficients (thin prism or tilt) is not supported;"
            f" calibrate with {count}, or record rectified images"
        )
    if K[0, 0] == 0.0:
        raise CalibrationError("the camera is not calibrated (its K is zero); calibrate it")
    padded = (*coefficients, *(0.0,) * count)[:count]
    return Camera(
        width_px, height_px, float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]), padded, known
    )


def _parsed(text: bytes | str, source: str) -> dict[str, Any]:
    try:
        content = yaml.load(text, _PlainLoader) if len(text) <= _SIZE_LIMIT_BYTES else None
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        reason = " ".join(str(error).split())
        raise CalibrationError(f"{source} is not YAML: {reason}") from error
    if not isinstance(content, dict):
        raise CalibrationError(
            f"{source} is no calibration; it needs image_width, image_height, camera_matrix,"
            " distortion_model and distortion_coefficients, as ROS' camera_calibration writes them"
        )
    return content


def _size(content: dict[str, Any], key: str) -> int:
    value = content.get(key)
    if not isinstance(value, int) or isinstance(value, bool):
        raise CalibrationError(f"{key} is missing or no whole number: {value!r}")
    return value


def _numbers(content: dict[str, Any], key: str, count: int | None) -> list[float]:
    entry = content.get(key)
    data = entry.get("data") if isinstance(entry, dict) else None
    try:
        numbers = [float(value) for value in data or ()]  # YAML 1.1 takes 1e-05 for text
    except (TypeError, ValueError) as error:
        raise CalibrationError(f"{key}.data is no list of numbers") from error
    if data is None or (count is not None and len(numbers) != count):
        raise CalibrationError(f"{key}.data has {len(numbers)} numbers, it needs {count or 'those of the model'}")
    return numbers


def _matrix(matrix: np.ndarray) -> dict[str, Any]:
    rows, cols = matrix.shape
    return {"rows": rows, "cols": cols, "data": [float(value) for value in matrix.ravel()]}
