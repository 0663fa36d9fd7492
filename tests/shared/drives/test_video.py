"""Video that was recorded a message a picture: each picture keeps the stamp of its own message."""

from __future__ import annotations

import builtins
import logging
from fractions import Fraction

import av
import numpy as np
import pytest
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedVideo_pb2 import CompressedVideo
from google.protobuf.timestamp_pb2 import Timestamp

from fleetmap.drives import open_drive
from fleetmap.drives.h264_gaps import LostPictures
from fleetmap.errors import DriveError

T0_NS = 1_650_000_000_123_456_789
FRAME_NS = 100_000_000
WIDTH, HEIGHT, COUNT, KEYFRAME_EVERY = 320, 160, 20, 10
ENCODERS = {
    "h264": ("libx264", {"preset": "ultrafast", "tune": "zerolatency"}),
    "h265": (
        "libx265",
        {"preset": "ultrafast", "tune": "zerolatency", "x265-params": "log-level=none:open-gop=0"},
    ),
    "vp9": ("libvpx-vp9", {"deadline": "realtime", "cpu-used": "8", "lag-in-frames": "0"}),
    "av1": ("libsvtav1", {"preset": "11", "svtav1-params": "pred-struct=1"}),
}


def pictures_of(count=COUNT):
    """Pictures that can be told apart: a bright bar that moves, on a ground that grows lighter."""
    pictures = []
    for index in range(count):
        picture = np.full((HEIGHT, WIDTH), 30 + 5 * index, np.uint8)
        picture[:, 8 * index : 8 * index + 16] = 240
        pictures.append(picture)
    return pictures


def packets_of(video_format, pictures, *, b_frames=0, pixel_format="yuv420p", **options):
    """(number of the picture, data) in the order of the stream."""
    name, usual = ENCODERS[video_format]
    encoder = av.CodecContext.create(name, "w")
    encoder.width, encoder.height, encoder.pix_fmt = WIDTH, HEIGHT, pixel_format
    encoder.time_base, encoder.framerate = Fraction(1, 10), Fraction(10)
    encoder.gop_size, encoder.max_b_frames, encoder.options = KEYFRAME_EVERY, b_frames, {**usual, **options}
    packets = []
    for index, picture in enumerate(pictures):
        frame = av.VideoFrame.from_ndarray(picture, format="gray").reformat(format=pixel_format)
        frame.pts = index
        packets += encoder.encode(frame)
    packets += encoder.encode(None)
    return [(packet.pts, bytes(packet)) for packet in packets]


@pytest.fixture
def record_video(record):
    def write(packets, video_format):
        K = (300.0, 0.0, 159.5, 0.0, 300.0, 79.5, 0.0, 0.0, 1.0)
        with record() as recorder:
            calibration = CameraCalibration(frame_id="cam", width=WIDTH, height=HEIGHT, K=K)
            recorder.protobuf("/calibration", calibration, T0_NS)
            for order, (number, data) in enumerate(packets):
                stamp_ns = T0_NS + number * FRAME_NS
                time = Timestamp(seconds=stamp_ns // 10**9, nanos=stamp_ns % 10**9)
                message = CompressedVideo(timestamp=time, frame_id="cam", data=data, format=video_format)
                recorder.protobuf("/video", message, T0_NS + order)
        return recorder.path

    return write


def assert_are(frames, pictures, numbers):
    """The frames are just these pictures, each with its own stamp."""
    assert [frame.stamp_ns for frame in frames] == [T0_NS + number * FRAME_NS for number in numbers]
    for frame, number in zip(frames, numbers, strict=True):
        assert frame.image.shape == (HEIGHT, WIDTH)
        differences = [np.abs(frame.image.astype(float) - picture).mean() for picture in pictures]
        assert int(np.argmin(differences)) == number
        assert differences[number] < 4.0


@pytest.mark.parametrize("video_format", ENCODERS)
def test_each_picture_has_the_stamp_of_its_message(record_video, video_format):
    pictures = pictures_of()
    drive = open_drive(record_video(packets_of(video_format, pictures), video_format))
    assert drive.frame_count == COUNT
    assert drive.frame_stamps_ns() == [T0_NS + number * FRAME_NS for number in range(COUNT)]
    assert_are(list(drive.frames()), pictures, range(COUNT))
    assert np.array_equal(drive.decode_first_image(), next(drive.frames()).image)


@pytest.mark.parametrize("video_format", ENCODERS)
def test_what_comes_before_the_first_keyframe_is_skipped_and_counted(record_video, video_format, caplog):
    pictures = pictures_of()
    drive = open_drive(record_video(packets_of(video_format, pictures)[3:], video_format))
    with caplog.at_level(logging.WARNING):
        assert_are(list(drive.frames()), pictures, range(10, COUNT))
    (warning,) = caplog.records
    assert "before its first keyframe; the first 7 messages are skipped" in warning.getMessage()


@pytest.mark.parametrize("video_format", ["h264", "h265"])
@pytest.mark.parametrize("lost", [(4,), (3, 4, 5), (10,), (9, 10, 11)])
def test_after_lost_messages_nothing_is_made_up(record_video, video_format, lost, caplog):
    pictures = pictures_of(40)
    packets = packets_of(video_format, pictures)
    path = record_video([packet for packet in packets if packet[0] not in lost], video_format)
    with caplog.at_level(logging.WARNING):
        frames = list(open_drive(path).frames())
    following_keyframe = 10 * (lost[-1] // 10 + 1)
    expected = [*range(lost[0]), *range(following_keyframe, 40)]
    assert_are(frames, pictures, expected)
    (warning,) = caplog.records
    assert f"{40 - len(lost) - len(expected)} video messages gave no picture" in warning.getMessage()


@pytest.mark.parametrize("profile", ["baseline", "main", "high", "high10", "high422", "high444"])
def test_a_whole_h264_stream_of_any_profile_has_no_gaps(profile):
    pixel_format = {"high10": "yuv420p10le", "high422": "yuv422p", "high444": "yuv444p"}.get(profile, "yuv420p")
    options = {"preset": "medium", "profile": profile, "x264-params": "cqm=jvt:bframes=0:keyint=30"}
    if profile in ("baseline", "main"):
        options["x264-params"] = "bframes=0:keyint=30"
    packets = [data for _, data in packets_of("h264", pictures_of(45), pixel_format=pixel_format, **options)]
    assert len(packets) == 45
    whole = LostPictures()
    assert [whole.are_before(data) for data in packets] == [False] * 45
    torn = LostPictures()
    assert [number for number, data in enumerate(packets) if number != 7 and torn.are_before(data)] == [8]


def test_b_frames_are_no_gaps():
    packets = packets_of("h264", pictures_of(40), b_frames=3, preset="medium", tune="psnr")
    whole = LostPictures()
    assert [whole.are_before(data) for _, data in packets] == [False] * 40


def test_what_is_no_h264_has_no_gaps():
    rng = np.random.default_rng(5)
    stream = LostPictures()
    for data in (b"", b"\0\0\1", b"\0\0\1\x67", b"\0\0\1\x67\x64", *(rng.bytes(300) for _ in range(50))):
        assert not stream.are_before(data)


def test_pictures_that_the_decoder_holds_back_come_at_the_end(record_video):
    pictures = pictures_of()
    packets = packets_of("h264", pictures, b_frames=2, preset="fast", tune="psnr")
    assert [number for number, _ in packets] != list(range(COUNT))  # there are B-frames
    assert_are(list(open_drive(record_video(packets, "h264")).frames()), pictures, range(COUNT))


def test_colour_becomes_grey_of_full_range(record_video):
    pictures = [np.full((HEIGHT, WIDTH), value, np.uint8) for value in (0, 128, 255)]
    for pixel_format in ("yuv420p", "yuvj420p"):
        frames = list(
            open_drive(record_video(packets_of("h264", pictures, pixel_format=pixel_format), "h264")).frames()
        )
        for frame, picture in zip(frames, pictures, strict=True):
            assert np.abs(frame.image.astype(int) - picture).max() <= 3


class TestBadVideo:
    def refusal_of(self, path):
        with pytest.raises(DriveError) as caught:
            list(open_drive(path).frames())
        assert "\n" not in str(caught.value)
        return str(caught.value)

    def test_a_stream_without_a_keyframe_is_refused(self, record_video):
        path = record_video(packets_of("h264", pictures_of(10))[1:], "h264")
        assert f"the video on /video in {path} has no keyframe" in self.refusal_of(path)

    @pytest.mark.parametrize(
        ("data", "reason"), [(b"no packet at all", "the decoder refuses"), (b"", "it is empty")]
    )
    def test_a_packet_that_is_none_is_refused_and_named(self, record_video, data, reason):
        packets = packets_of("h264", pictures_of(10))
        packets[4] = (4, data)
        message = self.refusal_of(record_video(packets, "h264"))
        assert "image 4 of /video" in message
        assert reason in message

    def test_a_cut_packet_is_refused_and_named(self, record_video):
        packets = packets_of("h264", pictures_of(10))
        packets[4] = (4, packets[4][1][: len(packets[4][1]) // 2])
        message = self.refusal_of(record_video(packets, "h264"))
        assert "image 4 of /video" in message
        assert "is damaged" in message

    def test_an_unknown_format_is_refused_by_name(self, record_video):
        path = record_video(packets_of("h264", pictures_of(2)), "mjpeg2000")
        assert "video format 'mjpeg2000' is not one of h264, h265" in self.refusal_of(path)

    def test_without_pyav_the_extra_is_named(self, record_video, monkeypatch):
        path = record_video(packets_of("h264", pictures_of(2)), "h264")
        real_import = builtins.__import__

        def without_av(name, *arguments, **options):
            if name == "av":
                raise ModuleNotFoundError("No module named 'av'")
            return real_import(name, *arguments, **options)

        monkeypatch.setattr(builtins, "__import__", without_av)
        assert "fleetmap[video]" in self.refusal_of(path)
