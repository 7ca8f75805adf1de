"""Image encodings: lossless ones to the bit, JPEG as in the tracker, and images of other programs."""

from __future__ import annotations

import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from stereo_sfm.drivers import open_source
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.log import images
from stereo_sfm.log.image_log import ImageLog
from stereo_sfm.log.writer import LogWriter
from stereo_sfm.types import StereoImage
from tests.log.recordings import assert_same_image, fisheye_rig, stereo_images


@pytest.mark.parametrize("image_format", ["raw", "png"])
@pytest.mark.parametrize("shape", [(1, 1), (3, 7), (80, 96)])
def test_lossless_formats_give_back_every_pixel(image_format: str, shape: tuple[int, int]) -> None:
    pixels = np.random.default_rng(0).integers(0, 256, shape, np.uint8)
    data = images.encode_pixels(pixels, image_format)
    if image_format == "raw":
        back = images.decode_raw(data, shape[1], shape[0], shape[1], "mono8")
    else:
        back = images.decode_file(data)
    np.testing.assert_array_equal(back, pixels)


def test_the_png_options_are_smaller_than_the_default() -> None:
    rng = np.random.default_rng(1)
    smooth = cv2.GaussianBlur(rng.normal(128, 900, (400, 424)), (0, 0), 9) + rng.normal(0, 2, (400, 424))
    pixels = np.clip(smooth, 0, 255).astype(np.uint8)
    default = cv2.imencode(".png", pixels)[1]
    assert len(images.encode_pixels(pixels, "png")) < 0.95 * len(default)


def test_what_a_jpeg_log_gives_back_is_what_the_tracker_was_given(tmp_path: Path) -> None:
    pairs = stereo_images(4, np.random.default_rng(2))
    seen: list[StereoImage] = []
    with LogWriter(tmp_path / "a.mcap") as writer:
        log = ImageLog(writer, fisheye_rig(), image_format="jpeg")
        for pair in pairs:
            logged = images.encode_pair(pair, "jpeg")
            log.image(logged)
            seen.append(logged.image)
    with open_source(tmp_path / "a.mcap") as source:
        for one, other in zip(seen, source, strict=True):
            assert_same_image(one, other)
    assert (seen[0].left != pairs[0].left).any()
    assert np.abs(seen[0].left.astype(float) - pairs[0].left).mean() < 4


def test_a_jpeg_log_rejects_pixels_that_are_not_encoded(tmp_path: Path) -> None:
    with LogWriter(tmp_path / "a.mcap") as writer, pytest.raises(ValueError, match="lossy"):
        ImageLog(writer, fisheye_rig(), image_format="jpeg").image(stereo_images(1, np.random.default_rng(3))[0])


def test_an_unknown_format_is_one_line() -> None:
    with pytest.raises(StereoSfmError, match="unknown image format 'gif'"):
        images.encode_pixels(np.zeros((2, 2), np.uint8), "gif")


def _padded(rows: np.ndarray, step: int) -> bytes:
    out = np.zeros((rows.shape[0], step), np.uint8)
    flat = rows.reshape(rows.shape[0], -1)
    out[:, : flat.shape[1]] = flat
    return out.tobytes()


def test_encodings_of_other_programs() -> None:
    rng = np.random.default_rng(4)
    bgr = rng.integers(0, 256, (6, 8, 3), np.uint8)
    gray = cv2.cvtColor(bgr, cv2.COLOR_BGR2GRAY)
    for encoding, rows in {
        "bgr8": bgr,
        "rgb8": bgr[..., ::-1],
        "bgra8": cv2.cvtColor(bgr, cv2.COLOR_BGR2BGRA),
        "rgba8": cv2.cvtColor(bgr, cv2.COLOR_BGR2RGBA),
        "8UC3": bgr,
        "mono8": gray,
        "8UC1": gray,
    }.items():
        for step in (0, 48):
            data = np.ascontiguousarray(rows).tobytes() if step == 0 else _padded(np.ascontiguousarray(rows), step)
            np.testing.assert_array_equal(images.decode_raw(data, 8, 6, step, encoding), gray, err_msg=encoding)
    deep = rng.integers(0, 2**16, (6, 8), np.uint16)
    little, big = deep.astype("<u2").tobytes(), deep.astype(">u2").tobytes()
    np.testing.assert_array_equal(images.decode_raw(little, 8, 6, 16, "mono16"), deep)
    np.testing.assert_array_equal(images.decode_raw(big, 8, 6, 16, "16UC1", big_endian=True), deep)
    yuv = np.stack([gray, np.full_like(gray, 128)], -1)
    np.testing.assert_array_equal(images.decode_raw(yuv.tobytes(), 8, 6, 16, "yuyv"), gray)
    np.testing.assert_array_equal(images.decode_raw(yuv[..., ::-1].tobytes(), 8, 6, 16, "uyvy"), gray)


def test_bayer_patterns_start_at_the_right_colour() -> None:
    """A image that is red only: green 0.299 of 200 everywhere when the pattern is understood."""
    for pattern, (row, column) in {"rggb": (0, 0), "bggr": (1, 1), "gbrg": (1, 0), "grbg": (0, 1)}.items():
        mosaic = np.zeros((12, 12), np.uint8)
        mosaic[row::2, column::2] = 200
        gray = images.decode_raw(mosaic.tobytes(), 12, 12, 12, f"bayer_{pattern}8")
        np.testing.assert_allclose(gray[4:-4, 4:-4], 0.299 * 200, atol=1.5)


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_files_that_declare_too_many_pixels_are_never_decoded(suffix: str) -> None:
    """With the changed header a decoder would need gigabytes; the error shows that the header is checked first."""
    small = cv2.imencode(suffix, np.zeros((8, 8), np.uint8))[1].tobytes()
    if suffix == ".png":
        large = small[:16] + (60_000).to_bytes(4) * 2 + small[24:29]
        large += zlib.crc32(large[12:29]).to_bytes(4) + small[33:]
    else:
        at = small.index(b"\xff\xc0")
        large = small[: at + 5] + (60_000).to_bytes(2) * 2 + small[at + 9 :]
    for decode in (images.decode_file, images.decode_depth_file):
        with pytest.raises(ValueError, match="more than 100000000 pixels"):
            decode(large)
    with pytest.raises(ValueError, match="more than 100000000 pixels"):
        images.decode_raw(b"", 60_000, 60_000, 60_000, "mono8")


def test_depth_encodings() -> None:
    millimetres = np.array([[0, 1500], [65535, 1]], np.uint16)
    metres = np.array([[np.nan, 1.5], [65.535, 0.001]], np.float32)
    np.testing.assert_allclose(images.decode_depth(millimetres.tobytes(), 2, 2, 4, "16UC1"), metres)
    np.testing.assert_array_equal(images.decode_depth(metres.tobytes(), 2, 2, 8, "32FC1"), metres)
    np.testing.assert_allclose(images.decode_depth_file(cv2.imencode(".png", millimetres)[1].tobytes()), metres)


@pytest.mark.parametrize(
    ("data", "width", "height", "step", "encoding", "says"),
    [
        (b"\0" * 5, 3, 2, 3, "mono8", "only 5 bytes"),
        (b"\0" * 6, 3, 2, 2, "mono8", "only 6 bytes"),
        (b"", 3, 2, 0, "mono8", "only 0 bytes"),
        (b"\0" * 6, 3, 2, 3, "rgb565", "not supported"),
    ],
)
def test_bad_pixels_are_named(data: bytes, width: int, height: int, step: int, encoding: str, says: str) -> None:
    with pytest.raises(ValueError, match=says):
        images.decode_raw(data, width, height, step, encoding)
    for broken in (b"", b"\xff\xd8\xff not an image"):
        with pytest.raises(ValueError, match="cannot be decoded"):
            images.decode_file(broken)
        with pytest.raises(ValueError, match="not a sixteen-bit PNG"):
            images.decode_depth_file(broken)
    with pytest.raises(ValueError, match="only 1 bytes"):
        images.decode_depth(b"\0", 2, 2, 4, "16UC1")
    with pytest.raises(ValueError, match="not supported"):
        images.decode_depth(b"\0" * 8, 2, 2, 4, "rgb8")
