"""H.264, H.265 and AV1 pictures that were never recorded: none is made from them, none refused for others.

Of AV1 that holds where the stream is coded to survive losses; elsewhere dav1d refuses what it can tell.
"""

import tempfile
from functools import cache
from pathlib import Path

import av
import numpy as np
import pytest

from hma_data.episodes.images import Images
from hma_data.errors import EpisodeError
from hma_data.sources.bags.images import VideoDecoder, is_keyframe

GROUP, FRAMES = 9, 27
QUIET = "log-level=none:keyint=9:min-keyint=9:scenecut=0"
AOM = {"usage": "realtime", "cpu-used": "8", "lag-in-frames": "0"}
STREAMS = {
    "x264": ("h264", "libx264", {"bf": "0"}),
    "x264 zero latency, slices": ("h264", "libx264", {"tune": "zerolatency", "slices": "3"}),
    "x264 baseline": ("h264", "libx264", {"profile": "baseline", "refs": "1"}),
    "x264 high 4:4:4": ("h264", "libx264", {"profile": "high444", "bf": "0"}),
    "x265": ("h265", "libx265", {"x265-params": f"{QUIET}:bframes=0"}),
    "x265 one reference": ("h265", "libx265", {"x265-params": f"{QUIET}:bframes=0:ref=1:repeat-headers=1"}),
    "x265 scaling lists": ("h265", "libx265", {"x265-params": f"{QUIET}:bframes=0:scaling-list=default"}),
    "aom resilient": ("av1", "libaom-av1", {**AOM, "error-resilience": "default"}),
}
REORDERED = {
    "x264 with b-frames": ("h264", "libx264", {"bf": "3", "x264-params": "b-pyramid=normal"}),
    "x264 interlaced": ("h264", "libx264", {"bf": "0", "flags": "+ildct+ilme"}),
    "x264 intra refresh": ("h264", "libx264", {"bf": "0", "x264-params": "intra-refresh=1"}),
    "x265 with b-frames": ("h265", "libx265", {"x265-params": f"{QUIET}:bframes=4:b-pyramid=1"}),
    "x265 open groups": ("h265", "libx265", {"x265-params": f"{QUIET}:bframes=3:open-gop=1"}),
    "x265 layers in time": ("h265", "libx265", {"x265-params": f"{QUIET}:bframes=3:temporal-layers=1"}),
    "aom": ("av1", "libaom-av1", AOM),
    "aom with hidden frames": ("av1", "libaom-av1", {"cpu-used": "8"}),
    "aom resilient with hidden frames": (
        "av1",
        "libaom-av1",
        {"cpu-used": "8", "error-resilience": "default"},
    ),
    "svt": ("av1", "libsvtav1", {"preset": "12", "svtav1-params": "pred-struct=1:lookahead=0"}),
    "svt with hidden frames": ("av1", "libsvtav1", {"preset": "12"}),
}


@cache
def messages(name: str) -> list[bytes]:
    """The packets of a moving picture, as a recorder would put them into messages."""
    codec, encoder, options = {**STREAMS, **REORDERED}[name]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / {"h264": "v.h264", "h265": "v.hevc"}.get(codec, "v.mkv")
        film(path, encoder, options)
        with av.open(str(path)) as container:
            return [bytes(packet) for packet in container.demux(video=0) if packet.size]


def film(path: Path, encoder: str, options: dict[str, str]) -> None:
    draw = np.random.default_rng(0)
    ground = draw.integers(0, 255, (12, 16, 3), np.uint8).repeat(8, 0).repeat(8, 1)
    with av.open(str(path), "w") as out:
        stream = out.add_stream(encoder, rate=10, options=options)
        stream.width, stream.height = 128, 96
        stream.pix_fmt = "yuv444p" if options.get("profile") == "high444" else "yuv420p"
        stream.codec_context.gop_size = GROUP
        for i in range(FRAMES):
            picture = np.ascontiguousarray(np.roll(ground, (3 * i, 5 * i), (0, 1)))
            out.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        out.mux(stream.encode(None))


def decoded(packets: list[bytes], codec: str, in_order: bool) -> list[Images | None]:
    """Each picture, or None where it is refused."""
    keyframes = np.array([is_keyframe(packet, codec) for packet in packets])
    decoder, found = None, []
    for i in range(len(packets)):
        if decoder is None or not in_order:
            decoder = VideoDecoder(codec, keyframes, lambda start: iter(packets[start:]), "x")
        try:
            found.append(next(decoder.each([i])))
        except EpisodeError:
            found.append(None)
    return found


@pytest.mark.parametrize("name", STREAMS)
@pytest.mark.parametrize("in_order", [True, False])
def test_no_picture_is_made_from_one_that_is_missing(name: str, in_order: bool) -> None:
    codec, packets = STREAMS[name][0], messages(name)
    whole = decoded(packets, codec, in_order=True)
    assert len(packets) == FRAMES and all(picture is not None for picture in whole)
    for lost in (1, 5, 8, 13):
        found = decoded(packets[:lost] + packets[lost + 1 :], codec, in_order)
        following = -(-(lost + 1) // GROUP) * GROUP
        for i, picture in enumerate(found):
            at = i + (i >= lost)
            assert (picture is None) == (lost < at < following), (lost, at)
            assert picture is None or np.array_equal(picture, whole[at])


@pytest.mark.parametrize("name", [*STREAMS, *REORDERED])
def test_nothing_is_missed_where_nothing_is_missing(name: str) -> None:
    codec, packets = {**STREAMS, **REORDERED}[name][0], messages(name)
    keyframes = np.array([is_keyframe(packet, codec) for packet in packets])
    decoder = VideoDecoder(codec, keyframes, lambda start: iter(packets[start:]), "x")
    shown = 0
    for i in range(len(packets)):
        try:
            shown += len(list(decoder.each([i])))
        except EpisodeError as fault:  # a message of hidden frames alone
            assert "missing" not in str(fault) and name.endswith("hidden frames")
    assert shown > FRAMES / 2
