"""Recordings as other tools write them, built without the project's own writer."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Self

import cv2
import numpy as np
import pytest
from mcap.writer import CompressionType, IndexType, Writer
from mcap_protobuf.schema import build_file_descriptor_set
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import Writer as Rosbag2Writer
from rosbags.rosbag2.enums import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.typesys import Stores, get_typestore

from fleetmap.camera import Camera

TYPES = get_typestore(Stores.ROS2_JAZZY)
T0_NS = 1_650_000_000_123_456_789
FRAME_NS = 100_000_000


class ForeignRecorder:
    """Writes ROS 2 messages as other tools do; log times are the stamps unless given."""

    def __init__(
        self,
        path: Path,
        *,
        rosbag2: bool = False,
        schema_text: bool = True,
        idl: dict[str, str] | None = None,
        compression_mode: CompressionMode = CompressionMode.NONE,
        **options: Any,
    ) -> None:
        self.path, self._rosbag2, self._schema_text, self._options = path, rosbag2, schema_text, options
        self._idl, self._compression_mode = idl or {}, compression_mode
        self._channels: dict[str, Any] = {}
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        if self._rosbag2:
            bag = Rosbag2Writer(self.path, version=9, storage_plugin=StoragePlugin.MCAP)
            if self._compression_mode != CompressionMode.NONE:
                bag.set_compression(self._compression_mode, CompressionFormat.ZSTD)
            self._bag = self._stack.enter_context(bag)
        else:
            file = self._stack.enter_context(self.path.open("wb"))
            self._mcap = Writer(file, **{"chunk_size": 20_000, **self._options})
            self._mcap.start(profile="ros2", library="some other tool")
        return self

    def __exit__(self, *error: object) -> None:
        if not self._rosbag2:
            self._mcap.finish()
        self._stack.close()

    def write(self, topic: str, message: Any, stamp_ns: int, *, encoding: str = "cdr", data: bytes = b"") -> None:
        data = data or bytes(TYPES.serialize_cdr(message, message.__msgtype__))
        if self._rosbag2:
            if topic not in self._channels:
                self._channels[topic] = self._bag.add_connection(topic, message.__msgtype__, typestore=TYPES)
            self._bag.write(self._channels[topic], stamp_ns, data)
            return
        if topic not in self._channels:
            text = TYPES.generate_msgdef(message.__msgtype__, ros_version=2)[0] if self._schema_text else ""
            kind = "ros2msg"
            if message.__msgtype__ in self._idl:
                kind, text = "ros2idl", self._idl[message.__msgtype__]
            schema_id = self._mcap.register_schema(message.__msgtype__, kind, text.encode())
            self._channels[topic] = self._mcap.register_channel(topic, encoding, schema_id)
        self._mcap.add_message(self._channels[topic], stamp_ns, data, stamp_ns)

    def protobuf(self, topic: str, message: Any, stamp_ns: int, *, data: bytes | None = None) -> None:
        """A protobuf message beside the others, as Foxglove's tools write it."""
        if topic not in self._channels:
            descriptors = build_file_descriptor_set(type(message)).SerializeToString()
            schema_id = self._mcap.register_schema(message.DESCRIPTOR.full_name, "protobuf", descriptors)
            self._channels[topic] = self._mcap.register_channel(topic, "protobuf", schema_id)
        data = message.SerializeToString() if data is None else data
        self._mcap.add_message(self._channels[topic], stamp_ns, data, stamp_ns)

    def other(self, topic: str, type_name: str, encoding: str, schema: tuple[str, bytes], data: bytes) -> None:
        """A message in any encoding at all."""
        if topic not in self._channels:
            schema_id = self._mcap.register_schema(type_name, *schema) if type_name else 0
            self._channels[topic] = self._mcap.register_channel(topic, encoding, schema_id)
        self._mcap.add_message(self._channels[topic], T0_NS, data, T0_NS)

    def imu(
        self, topic: str, stamp_ns: int, angular: tuple[float, ...], linear: tuple[float, ...], **options: Any
    ) -> None:
        vector = TYPES.types["geometry_msgs/msg/Vector3"]
        unknown = np.zeros(9)
        message = TYPES.types["sensor_msgs/msg/Imu"](
            header(stamp_ns, "imu"),
            TYPES.types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0),
            unknown,
            vector(*angular),
            options.get("angular_covariance", unknown),
            vector(*linear),
            unknown,
        )
        self.write(topic, message, options.get("log_ns", stamp_ns))

    def twist(self, topic: str, stamp_ns: int, forward_mps: float, frame_id: str = "base_link") -> None:
        message = TYPES.types["geometry_msgs/msg/TwistStamped"](header(stamp_ns, frame_id), _twist(forward_mps))
        self.write(topic, message, stamp_ns)

    def odometry(self, topic: str, stamp_ns: int, forward_mps: float) -> None:
        geometry = "geometry_msgs/msg/"
        pose = TYPES.types[geometry + "Pose"](
            TYPES.types[geometry + "Point"](7.0, 8.0, 9.0),
            TYPES.types[geometry + "Quaternion"](0.0, 0.0, 0.0, 1.0),
        )
        message = TYPES.types["nav_msgs/msg/Odometry"](
            header(stamp_ns, "odom"),
            "base_link",
            TYPES.types[geometry + "PoseWithCovariance"](pose, np.zeros(36)),
            TYPES.types[geometry + "TwistWithCovariance"](_twist(forward_mps), np.zeros(36)),
        )
        self.write(topic, message, stamp_ns)

    def jpeg(self, topic: str, stamp_ns: int, image: np.ndarray, frame_id: str, **write: Any) -> None:
        self.compressed(topic, stamp_ns, cv2.imencode(".jpg", image)[1].tobytes(), "jpeg", frame_id, **write)

    def compressed(
        self, topic: str, stamp_ns: int, data: bytes, image_format: str, frame_id: str, log_ns: int | None = None
    ) -> None:
        message = TYPES.types["sensor_msgs/msg/CompressedImage"](
            header(stamp_ns, frame_id), image_format, np.frombuffer(data, np.uint8)
        )
        self.write(topic, message, stamp_ns if log_ns is None else log_ns)

    def raw_image(
        self, topic: str, stamp_ns: int, data: np.ndarray, encoding: str, frame_id: str, width: int, step: int
    ) -> None:
        message = TYPES.types["sensor_msgs/msg/Image"](
            header(stamp_ns, frame_id), data.size // step, width, encoding, 0, step, data.reshape(-1)
        )
        self.write(topic, message, stamp_ns)

    def camera_info(
        self,
        topic: str,
        stamp_ns: int,
        camera: Camera,
        frame_id: str,
        *,
        model: str = "plumb_bob",
        d: tuple[float, ...] | None = None,
        k: np.ndarray | None = None,
        p: np.ndarray | None = None,
        binning: tuple[int, int] = (0, 0),
        region: tuple[int, int, int, int] = (0, 0, 0, 0),
    ) -> None:
        """``region``: x, y, height, width."""
        roi = TYPES.types["sensor_msgs/msg/RegionOfInterest"](*region, False)
        k = camera.matrix if k is None else k
        message = TYPES.types["sensor_msgs/msg/CameraInfo"](
            header(stamp_ns, frame_id),
            camera.height_px,
            camera.width_px,
            model,
            np.array(camera.distortion if d is None else d, dtype=np.float64),
            k.reshape(9),
            np.eye(3).reshape(9),
            (np.hstack([k, np.zeros((3, 1))]) if p is None else p).reshape(12),
            *binning,
            roi,
        )
        self.write(topic, message, stamp_ns)

    def fix(
        self,
        topic: str,
        stamp_ns: int,
        position: tuple[float, float, float],
        frame_id: str,
        *,
        status: int = 0,
        covariance: np.ndarray | None = None,
        covariance_type: int = 3,
    ) -> None:
        covariance = np.eye(3) * 0.04 if covariance is None else covariance
        message = TYPES.types["sensor_msgs/msg/NavSatFix"](
            header(stamp_ns, frame_id),
            TYPES.types["sensor_msgs/msg/NavSatStatus"](status, 1),
            *position,
            covariance.astype(np.float64).reshape(9),
            covariance_type,
        )
        self.write(topic, message, stamp_ns)

    def transforms(
        self,
        stamp_ns: int,
        *links: tuple[str, str, tuple[float, float, float], tuple[float, float, float, float]],
        topic: str = "/tf_static",
    ) -> None:
        geometry = "geometry_msgs/msg/"
        stamped = [
            TYPES.types[geometry + "TransformStamped"](
                header(stamp_ns, parent),
                child,
                TYPES.types[geometry + "Transform"](
                    TYPES.types[geometry + "Vector3"](*translation),
                    TYPES.types[geometry + "Quaternion"](*quat_xyzw),
                ),
            )
            for parent, child, translation, quat_xyzw in links
        ]
        self.write(topic, TYPES.types["tf2_msgs/msg/TFMessage"](stamped), stamp_ns)


def _twist(forward_mps: float) -> Any:
    vector = TYPES.types["geometry_msgs/msg/Vector3"]
    return TYPES.types["geometry_msgs/msg/Twist"](vector(forward_mps, 55.0, 66.0), vector(0.1, 0.2, 0.3))


def header(stamp_ns: int, frame_id: str) -> Any:
    time = TYPES.types["builtin_interfaces/msg/Time"](*divmod(stamp_ns, 1_000_000_000))
    return TYPES.types["std_msgs/msg/Header"](time, frame_id)


@pytest.fixture
def record(tmp_path: Path) -> Callable[..., ForeignRecorder]:
    """``with record("name.mcap", compression=...) as recorder: recorder.jpeg(...)``."""

    def build(name: str = "foreign.mcap", **options: Any) -> ForeignRecorder:
        return ForeignRecorder(tmp_path / name, **options)

    return build


@pytest.fixture(scope="session")
def small_camera() -> Camera:
    return Camera(64, 48, 50.0, 51.0, 31.5, 23.5, (-0.3, 0.1, 0.001, -0.002, 0.01))


@pytest.fixture(scope="session")
def pictures() -> list[np.ndarray]:
    """Ten smooth, different grey images of 64x48 that survive JPEG."""
    x, y = np.meshgrid(np.arange(64), np.arange(48))
    return [(127 + 100 * np.sin(x / 9.0 + k) * np.cos(y / 7.0)).astype(np.uint8) for k in range(10)]


@pytest.fixture
def street(record: Callable[..., ForeignRecorder], small_camera: Camera, pictures: list[np.ndarray]) -> Any:
    """Write a complete small recording with any options of ForeignRecorder; returns its path."""

    def build(name: str = "foreign.mcap", gnss_frame_id: str = "gnss", **options: Any) -> Path:
        with record(name, **options) as recorder:
            recorder.transforms(T0_NS, ("cam", "gnss", (0.1, -1.5, -0.4), (0.0, 0.0, 0.0, 1.0)))
            for index, picture in enumerate(pictures):
                stamp_ns = T0_NS + index * FRAME_NS
                recorder.camera_info("/front/camera_info", stamp_ns, small_camera, "cam")
                recorder.jpeg("/front/image/compressed", stamp_ns, picture, "cam")
                position = (49.0 + 1e-6 * index, 8.4, 120.0)
                recorder.fix("/gps/fix", stamp_ns + FRAME_NS // 3, position, gnss_frame_id)
        return Path(recorder.path)

    return build


@pytest.fixture(scope="session")
def read_by_rosbags() -> Callable[[Path], dict[str, list[Any]]]:
    """What rosbags' AnyReader reads of a recording, by topic in the order of log times."""

    def read(path: Path) -> dict[str, list[Any]]:
        with AnyReader([path]) as reader:
            messages: dict[str, list[Any]] = {topic: [] for topic in reader.topics}
            for connection, log_time_ns, raw in reader.messages():
                message = reader.deserialize(raw, connection.msgtype)
                messages[connection.topic].append(message)
                assert not hasattr(message, "header") or stamp_of(message) == log_time_ns
        return messages

    return read


def stamp_of(message: Any) -> int:
    return int(message.header.stamp.sec) * 1_000_000_000 + int(message.header.stamp.nanosec)


KINDS_OF_FILE = {
    "no chunks": {"use_chunking": False},
    "no index": {"index_types": IndexType.NONE},
    "no statistics": {"use_statistics": False},
    "no repeated channels": {"repeat_channels": False, "repeat_schemas": False, "use_statistics": False},
    "no repeated schemas": {"repeat_schemas": False},
    "no summary": {
        "index_types": IndexType.NONE,
        "repeat_channels": False,
        "repeat_schemas": False,
        "use_statistics": False,
        "use_summary_offsets": False,
    },
    "lz4": {"compression": CompressionType.LZ4},
    "zstd": {"compression": CompressionType.ZSTD},
    "uncompressed": {"compression": CompressionType.NONE},
    "without message definitions": {"schema_text": False},
}


@pytest.fixture(params=KINDS_OF_FILE.values(), ids=KINDS_OF_FILE.keys())
def kind_of_file(request: pytest.FixtureRequest) -> dict[str, Any]:
    """The kinds of MCAP that the format allows."""
    options: dict[str, Any] = request.param
    return options
