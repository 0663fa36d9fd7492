"""Images that another recording of the same drive holds already, so that only its receiver need differ."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from fleetmap.drives.image_codec import encode_image
from fleetmap.drives.mcap_file import McapFile
from fleetmap.drives.ros2_messages import COMPRESSED_IMAGE, MessageDecoder
from fleetmap.errors import InputError
from fleetmap.simulation.simulated_drive import SimulatedDrive

_EVERY = 20  # of so many images one is rendered again


def rendered_images(path: Path, drive: SimulatedDrive) -> Iterator[bytes]:
    """The JPEG of every image of a drive, in time order, out of a recording of it.

    Raises:
        DriveError: the recording cannot be read.
        InputError: it has not one image at each of the drive's stamps, and no others.
    """
    mcap = McapFile(path)
    topics = [topic for topic in mcap.topics.values() if topic.message_type == COMPRESSED_IMAGE]
    stamps_ns = drive.trajectory.stamps_ns.tolist()
    if [topic.message_count for topic in topics] != [len(stamps_ns)]:
        raise _another_drive(path, f"it has not {len(stamps_ns)} compressed images")
    decoder = MessageDecoder(topics[0])
    for stamp_ns, raw in zip(stamps_ns, mcap.messages(topics[0].name), strict=False):
        if raw.log_time_ns != stamp_ns:
            raise _another_drive(path, "its images have other stamps")
        yield bytes(decoder.decode(raw.data, raw.log_time_ns).data)


def jpeg_of(drive: SimulatedDrive, index: int, rendered: bytes | None, path: Path | None) -> bytes:
    """One image of a drive as JPEG: rendered, or as it was; every 20th and the last are rendered all the same.

    Raises:
        InputError: the image that was rendered before has other bytes.
    """
    if rendered is not None and index % _EVERY and index < drive.frame_count - 1:
        return rendered
    jpeg = encode_image(drive.frame(index).image)
    if path is not None and rendered is not None and jpeg != rendered:
        raise _another_drive(path, f"its image {index} looks different")
    return jpeg


def _another_drive(path: Path, reason: str) -> InputError:
    return InputError(
        f"{path} does not show the drive that these options make: {reason}; only the options of GNSS and of other "
        "sensors than the camera may differ"
    )
