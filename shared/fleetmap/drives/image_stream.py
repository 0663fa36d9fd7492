"""The images of one topic, decoded one at a time: pictures each by itself, video in the order of its stream."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

from fleetmap.drives.image_codec import Image, decode_compressed
from fleetmap.drives.messages import CompressedPicture, ImageMessage, RawPicture, VideoPicture
from fleetmap.drives.raw_images import decode_raw
from fleetmap.drives.video import VideoDecoder
from fleetmap.errors import DriveError

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class DecodedImage:
    """One image and the message that it came with."""

    number: int  # of the message on its topic, from 0
    stamp_ns: int
    image: Image


def decoded_images(
    messages: Iterable[ImageMessage], source: str, wanted: Callable[[int], bool] = lambda stamp_ns: True
) -> Iterator[DecodedImage]:
    """Decode the images with wanted stamps as they are asked for; ``source`` is what to call the topic in errors.

    Pictures that are not wanted cost nothing; those of a video are decoded all the same.

    Raises:
        DriveError: an image that cannot be decoded.
    """
    video: _VideoStream | None = None
    for number, message in enumerate(messages):
        try:
            match message.picture:
                case CompressedPicture() | RawPicture() if not wanted(message.stamp_ns):
                    continue
                case CompressedPicture(data, recorded_format):
                    yield DecodedImage(number, message.stamp_ns, decode_compressed(data, recorded_format))
                case RawPicture() as picture:
                    yield DecodedImage(number, message.stamp_ns, decode_raw(picture))
                case VideoPicture(data, recorded_format):
                    video = video or _VideoStream(recorded_format, source)
                    for decoded in video.decode(number, message.stamp_ns, data):
                        if wanted(decoded.stamp_ns):
                            yield decoded
        except ValueError as error:
            name = image_name(number, source, message.stamp_ns)
            raise DriveError(f"{name} cannot be decoded: {error}") from error
    if video is not None:
        yield from (decoded for decoded in video.finish() if wanted(decoded.stamp_ns))


def image_name(number: int, source: str, stamp_ns: int) -> str:
    """What to call an image in errors."""
    return f"image {number} of {source} (stamp {stamp_ns} ns)"


class _VideoStream:
    """A decoder that remembers whose picture is still to come, and counts those that never come."""

    def __init__(self, video_format: str, source: str) -> None:
        self._decoder = VideoDecoder(video_format)
        self._source = source
        self._stamps_ns: dict[int, int] = {}  # of the messages without a picture yet
        self._has_begun = False

    def decode(self, number: int, stamp_ns: int, data: bytes) -> Iterator[DecodedImage]:
        self._stamps_ns[number] = stamp_ns
        for picture in self._decoder.decode(number, data):
            yield self._stamped(*picture)

    def finish(self) -> Iterator[DecodedImage]:
        for picture in self._decoder.finish():
            yield self._stamped(*picture)
        if not self._has_begun:
            raise DriveError(f"the video on {self._source} has no keyframe; not one picture can be decoded")
        if self._stamps_ns:
            _log.warning(
                "%s: %d video messages gave no picture, because others before them are missing",
                self._source, len(self._stamps_ns),
            )  # fmt: skip

    def _stamped(self, number: int, image: Image) -> DecodedImage:
        if not self._has_begun:
            self._begin(number)
        return DecodedImage(number, self._stamps_ns.pop(number), image)

    def _begin(self, number: int) -> None:
        self._has_begun = True
        early = [waiting for waiting in self._stamps_ns if waiting < number]
        for waiting in early:
            del self._stamps_ns[waiting]
        if early:
            _log.warning(
                "%s: the video begins before its first keyframe; the first %d messages are skipped",
                self._source, len(early),
            )  # fmt: skip
