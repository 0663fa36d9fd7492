"""Those of Foxglove's messages that poses are told in, as protobuf classes.

Source: https://docs.foxglove.dev/docs/sdk/schemas, names and field numbers as in foxglove/LocationFix.proto and
foxglove/PoseInFrame.proto. They live in a pool of their own: where Foxglove's package is installed too, two files
of one process would otherwise claim the same names.
"""

from __future__ import annotations

from functools import cache
from typing import Any

from google.protobuf import descriptor_pool, message_factory, timestamp_pb2
from google.protobuf.descriptor_pb2 import DescriptorProto, FieldDescriptorProto, FileDescriptorProto

COVARIANCE_KNOWN = 3

_KINDS = {
    "double": FieldDescriptorProto.TYPE_DOUBLE,
    "string": FieldDescriptorProto.TYPE_STRING,
    "enum": FieldDescriptorProto.TYPE_ENUM,
    "message": FieldDescriptorProto.TYPE_MESSAGE,
}
# message -> its fields: name, number, kind, and the type of enumerations and messages
_MESSAGES: dict[str, tuple[tuple[str, int, str, str], ...]] = {
    "Vector3": (("x", 1, "double", ""), ("y", 2, "double", ""), ("z", 3, "double", "")),
    "Quaternion": (("x", 1, "double", ""), ("y", 2, "double", ""), ("z", 3, "double", ""), ("w", 4, "double", "")),
    "Pose": (
        ("position", 1, "message", ".foxglove.Vector3"),
        ("orientation", 2, "message", ".foxglove.Quaternion"),
    ),
    "PoseInFrame": (
        ("timestamp", 1, "message", ".google.protobuf.Timestamp"),
        ("frame_id", 2, "string", ""),
        ("pose", 3, "message", ".foxglove.Pose"),
    ),
    "LocationFix": (
        ("latitude", 1, "double", ""),
        ("longitude", 2, "double", ""),
        ("altitude", 3, "double", ""),
        ("position_covariance", 4, "double", ""),
        ("position_covariance_type", 5, "enum", ".foxglove.LocationFix.PositionCovarianceType"),
        ("timestamp", 6, "message", ".google.protobuf.Timestamp"),
        ("frame_id", 7, "string", ""),
        ("heading", 10, "double", ""),
    ),
}
_REPEATED = "position_covariance"
_COVARIANCE_TYPES = ("UNKNOWN", "APPROXIMATED", "DIAGONAL_KNOWN", "KNOWN")


def message_class(name: str) -> Any:
    """The class of a message such as ``PoseInFrame``."""
    return message_factory.GetMessageClass(_pool().FindMessageTypeByName(f"foxglove.{name}"))


@cache
def _pool() -> descriptor_pool.DescriptorPool:
    file = FileDescriptorProto(name="foxglove/poses.proto", package="foxglove", syntax="proto3")
    file.dependency.append(timestamp_pb2.DESCRIPTOR.name)
    for name, fields in _MESSAGES.items():
        message = file.message_type.add(name=name)
        for field in fields:
            _add_field(message, *field)
    types = message.enum_type.add(name="PositionCovarianceType")
    for number, value in enumerate(_COVARIANCE_TYPES):
        types.value.add(name=value, number=number)
    pool = descriptor_pool.DescriptorPool()
    pool.AddSerializedFile(timestamp_pb2.DESCRIPTOR.serialized_pb)
    pool.AddSerializedFile(file.SerializeToString())
    return pool


def _add_field(message: DescriptorProto, name: str, number: int, kind: str, type_name: str) -> None:
    label = FieldDescriptorProto.LABEL_REPEATED if name == _REPEATED else FieldDescriptorProto.LABEL_OPTIONAL
    field = message.field.add(name=name, number=number, label=label, type=_KINDS[kind])
    if type_name:
        field.type_name = type_name
