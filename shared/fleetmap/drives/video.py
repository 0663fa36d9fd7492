"""The door for PyAV: the pictures of a video that was recorded message by message.

Source: https://docs.foxglove.dev/docs/sdk/schemas/compressed-video. A message holds what makes one picture out of
those before it, so decoding starts at a keyframe. B-frames are not allowed in such recordings; where some are
there, pictures come out late and in the order of display, and still with their own number.

Where messages were lost, decoding starts again at the next keyframe. The decoder of H.264 has to be told of that,
the one of H.265 notices by itself; in VP9 and AV1 nothing tells.
"""

from __future__ import annotations

from types import ModuleType
from typing import TYPE_CHECKING

import numpy as np

from fleetmap.drives.h264_gaps import LostPictures
from fleetmap.drives.image_codec import Image
from fleetmap.errors import DriveError

if TYPE_CHECKING:
    import av

_DECODERS = {"h264": "h264", "h265": "hevc", "hevc": "hevc", "vp9": "vp9", "av1": "libdav1d"}


class VideoDecoder:
    """Decodes one stream. Pictures are known by the number of their message."""

    def __init__(self, video_format: str) -> None:
        """Start before the first message.

        Raises:
            ValueError: a format that is not read.
            DriveError: PyAV is not installed.
        """
        name = _DECODERS.get(video_format.strip().lower())
        if name is None:
            raise ValueError(f"video format '{video_format}' is not one of {', '.join(_DECODERS)}")
        self._av, self._name = _pyav(), name
        self._lost = LostPictures() if name == "h264" else None
        self._decoder = self._new_decoder()
        self._has_begun = False

    def decode(self, number: int, data: bytes) -> list[tuple[int, Image]]:
        """The pictures, grey (height, width), that a message completes; none before the first keyframe.

        Raises:
            ValueError: damaged data.
        """
        held_back: list[tuple[int, Image]] = []
        if self._lost is not None and self._lost.are_before(data):
            held_back = self.finish()
            self._decoder = self._new_decoder()
            self._has_begun = False
        if not data:
            raise ValueError("it is empty")
        packet = self._av.Packet(data)
        packet.pts = number
        try:
            frames = self._decoder.decode(packet)
        except self._av.FFmpegError as error:
            if self._has_begun:
                raise ValueError(f"the decoder refuses its {len(data)} bytes ({error.strerror})") from error
            return held_back
        self._has_begun = self._has_begun or bool(frames)
        return held_back + [_picture(frame) for frame in frames]

    def finish(self) -> list[tuple[int, Image]]:
        """The pictures that the decoder held back."""
        return [_picture(frame) for frame in self._decoder.decode(None)] if self._has_begun else []

    def _new_decoder(self) -> av.VideoCodecContext:
        decoder: av.VideoCodecContext = self._av.CodecContext.create(self._name, "r")
        decoder.thread_count = 1  # more threads hold pictures back
        return decoder


def _picture(frame: av.VideoFrame) -> tuple[int, Image]:
    if frame.is_corrupt:
        raise ValueError("it is damaged; the decoder made part of the picture up")
    # To full range: cameras record luma as 16..235.
    return int(frame.pts or 0), np.asarray(frame.to_ndarray(format="gray"), dtype=np.uint8)


def _pyav() -> ModuleType:
    try:
        import av
    except ImportError as error:
        raise DriveError(
            "the recording holds video; install fleetmap with its extra: pip install 'fleetmap[video]'"
        ) from error
    return av
