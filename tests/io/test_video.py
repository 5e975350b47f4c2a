"""Movies are decoded at the depth that they were stored with, by the exact matrix."""

from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from shadowtool.errors import DamagedFileError, InputError
from shadowtool.io.video import Movie

WIDTH, HEIGHT = 48, 32
# Red's and blue's share of luma.
WEIGHTS = {"709": (0.2126, 0.0722), "601": (0.299, 0.114), "2020": (0.2627, 0.0593)}
CODES = {"709": 1, "601": 6, "2020": 9}
LIMITED, FULL = 1, 2


def planes_of(frame: av.VideoFrame) -> list[np.ndarray]:
    """The frame's planes as writable arrays of code values."""
    wide = frame.format.components[0].bits > 8
    arrays = []
    for plane in frame.planes:
        rows = np.frombuffer(plane, np.uint16 if wide else np.uint8).reshape(plane.height, -1)
        arrays.append(rows[:, : plane.width * (1 if frame.format.is_planar else 4)])
    return arrays


def write_movie(
    path: Path, pix_fmt: str, frames: list[list[np.ndarray]], rate: object = 25, **tags: int
) -> Path:
    """Write planes of code values without loss."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("ffv1", rate=rate)
        height, width = frames[0][0].shape[:2]
        stream.width, stream.height, stream.pix_fmt = width, height, pix_fmt
        for tag, value in tags.items():
            setattr(stream.codec_context, tag, value)
        for planes in frames:
            frame = av.VideoFrame(width, height, pix_fmt)
            for array, values in zip(planes_of(frame), planes, strict=True):
                array[...] = values
            if "color_range" in tags:
                frame.color_range = tags["color_range"]
            if "colorspace" in tags:
                frame.colorspace = tags["colorspace"]
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


def decoded(path: Path) -> np.ndarray:
    return next(Movie(path).frames()).coded


def flat(value: int, height: int, width: int, bits: int) -> np.ndarray:
    return np.full((height, width), value, np.uint16 if bits > 8 else np.uint8)


def exact_rgb(y: float, u: float, v: float, bits: int, matrix: str, full: bool) -> np.ndarray:
    """RGB of a code triple, by ITU-R BT.709 and H.273."""
    kr, kb = WEIGHTS[matrix]
    scale = 2 ** (bits - 8)
    if full:
        top = 2**bits - 1
        luma, cb, cr = y / top, (u - 128 * scale) / top, (v - 128 * scale) / top
    else:
        luma = (y - 16 * scale) / (219 * scale)
        cb, cr = ((c - 128 * scale) / (224 * scale) for c in (u, v))
    red, blue = luma + 2 * (1 - kr) * cr, luma + 2 * (1 - kb) * cb
    green = (luma - kr * red - kb * blue) / (1 - kr - kb)
    return np.array([red, green, blue])


@pytest.mark.parametrize("full", [False, True], ids=["limited", "full"])
@pytest.mark.parametrize("matrix", ["709", "601", "2020"])
@pytest.mark.parametrize(
    ("pix_fmt", "bits", "chroma"),
    [
        ("yuv420p", 8, (2, 2)),
        ("yuv444p", 8, (1, 1)),
        ("yuv422p10le", 10, (1, 2)),
        ("yuv444p10le", 10, (1, 1)),
        ("yuv420p12le", 12, (2, 2)),
        ("yuv444p16le", 16, (1, 1)),
    ],
)
def test_flat_colours_are_decoded_by_the_tagged_matrix_and_range(
    pix_fmt, bits, chroma, matrix, full, tmp_path
):
    scale = 2 ** (bits - 8)
    triple = [101 * scale + scale // 3, 90 * scale, 161 * scale + scale // 2]
    small = HEIGHT // chroma[0], WIDTH // chroma[1]
    planes = [
        flat(triple[0], HEIGHT, WIDTH, bits),
        flat(triple[1], *small, bits),
        flat(triple[2], *small, bits),
    ]
    tags = {"colorspace": CODES[matrix], "color_range": FULL if full else LIMITED}
    path = write_movie(tmp_path / "a.mkv", pix_fmt, [planes], **tags)
    rgb = decoded(path)
    assert rgb.shape == (HEIGHT, WIDTH, 3)
    assert rgb.dtype == np.float32
    exact = exact_rgb(*triple, bits, matrix, full)
    np.testing.assert_allclose(rgb - exact, 0, atol=0.5 / (2**bits - 1))


@pytest.mark.parametrize("full", [False, True], ids=["limited", "full"])
@pytest.mark.parametrize(
    ("pix_fmt", "bits"), [("yuv422p10le", 10), ("yuv420p10le", 10), ("yuv444p12le", 12)]
)
def test_every_code_of_a_deep_ramp_stays_apart(pix_fmt, bits, full, tmp_path):
    top = 2**bits
    codes = np.arange(top, dtype=np.uint16).reshape(-1, 64)
    height, width = codes.shape
    small = {
        "yuv422p10le": (height, width // 2),
        "yuv420p10le": (height // 2, width // 2),
        "yuv444p12le": (height, width),
    }[pix_fmt]
    middle = flat(128 * 2 ** (bits - 8), *small, bits)
    tags = {"colorspace": 1, "color_range": FULL if full else LIMITED}
    path = write_movie(tmp_path / "a.mkv", pix_fmt, [[codes, middle, middle]], **tags)
    rgb = decoded(path)
    scale = 2 ** (bits - 8)
    exact = codes / (top - 1) if full else (codes - 16.0 * scale) / (219 * scale)
    for channel in range(3):
        values = rgb[..., channel]
        assert len(np.unique(values)) == top
        np.testing.assert_allclose(values, exact, atol=0.25 / (top - 1))


def test_eight_bit_luma_is_exact(tmp_path):
    codes = np.arange(256, dtype=np.uint8).reshape(16, 16)
    middle = np.full((8, 8), 128, np.uint8)
    tags = {"colorspace": 1, "color_range": LIMITED}
    rgb = decoded(write_movie(tmp_path / "a.mkv", "yuv420p", [[codes, middle, middle]], **tags))
    np.testing.assert_allclose(rgb[..., 1], (codes - 16.0) / 219, atol=1e-4)


@pytest.mark.parametrize(
    ("pix_fmt", "bits"), [("gbrp10le", 10), ("gbrp12le", 12), ("gbrp16le", 16)]
)
def test_deep_rgb_is_exact(pix_fmt, bits, tmp_path):
    top = 2**bits
    rng = np.random.default_rng(0)
    green, blue, red = (rng.integers(0, top, (HEIGHT, WIDTH)).astype(np.uint16) for _ in range(3))
    movie = write_movie(tmp_path / "a.mkv", pix_fmt, [[green, blue, red]])
    exact = np.stack([red, green, blue], axis=-1) / (top - 1)
    np.testing.assert_allclose(decoded(movie), exact, atol=0.25 / (top - 1))
    assert Movie(movie).info.bits == bits


def test_eight_bit_rgb_is_exact(tmp_path):
    packed = np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH, 4)).astype(np.uint8)
    path = tmp_path / "a.mkv"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("ffv1", rate=25)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "bgr0"
        frame = av.VideoFrame.from_ndarray(packed[..., :3].copy(), format="rgb24")
        container.mux(stream.encode(frame.reformat(format="bgr0")))
        container.mux(stream.encode())
    np.testing.assert_allclose(decoded(path), packed[..., :3] / 255, atol=1e-4)


@pytest.mark.parametrize(("pix_fmt", "bits"), [("gray", 8), ("gray10le", 10), ("gray16le", 16)])
@pytest.mark.parametrize("full", [False, True], ids=["limited", "full"])
def test_grey_movies_are_grey(pix_fmt, bits, full, tmp_path):
    scale = 2 ** (bits - 8)
    code = 113 * scale + scale // 2
    planes = [flat(code, HEIGHT, WIDTH, bits)]
    tags = {"color_range": FULL if full else LIMITED}
    rgb = decoded(write_movie(tmp_path / "a.mkv", pix_fmt, [planes], **tags))
    exact = code / (2**bits - 1) if full else (code - 16 * scale) / (219 * scale)
    np.testing.assert_allclose(rgb, exact, atol=0.25 / (2**bits - 1))


def test_grey_without_a_range_is_full_range_and_said_so(tmp_path):
    movie = Movie(write_movie(tmp_path / "a.mkv", "gray", [[flat(113, HEIGHT, WIDTH, 8)]]))
    np.testing.assert_allclose(next(movie.frames()).coded, 113 / 255, atol=1e-6)
    assert "full range" in " ".join(movie.info.assumed)


def test_numbered_colours_are_colours(tmp_path):
    path = tmp_path / "a.mov"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("png", rate=25)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "pal8"
        frame = av.VideoFrame(WIDTH, HEIGHT, "pal8")
        colours = np.zeros((256, 4), np.uint8)
        colours[7] = (10, 20, 230, 255)
        frame.planes[0].update(bytes([7]) * frame.planes[0].buffer_size)
        frame.planes[1].update(colours.tobytes())
        container.mux(stream.encode(frame))
        container.mux(stream.encode())
    # A palette's colours are stored as blue, green, red.
    np.testing.assert_allclose(decoded(path)[0, 0], np.array([230, 20, 10]) / 255, atol=1e-6)


def untagged(path: Path, width: int = WIDTH, height: int = HEIGHT) -> Path:
    planes = [flat(v, height // d, width // d, 8) for v, d in ((101, 1), (90, 2), (161, 2))]
    return write_movie(path, "yuv420p", [planes])


@pytest.mark.parametrize(("size", "matrix"), [((720, 576), "601"), ((1280, 720), "709")])
def test_without_tags_matrix_and_range_are_assumed_and_said_so(size, matrix, tmp_path):
    movie = Movie(untagged(tmp_path / "a.mkv", *size))
    rgb = next(movie.frames()).coded
    exact = exact_rgb(101, 90, 161, 8, matrix, full=False)
    np.testing.assert_allclose(rgb - exact, 0, atol=0.5 / 255)
    said = " ".join(movie.info.assumed)
    assert f"Rec.{matrix}" in said
    assert "video range" in said
    assert "Rec.709 is assumed" in movie.info.assumed_transfer


def test_a_matrix_that_is_not_known_is_named(tmp_path):
    planes = [flat(101, HEIGHT, WIDTH, 8)] + [flat(128, HEIGHT // 2, WIDTH // 2, 8)] * 2
    path = write_movie(tmp_path / "a.mkv", "yuv420p", [planes], colorspace=8)
    assert "matrix 8" in " ".join(Movie(path).info.assumed)


def test_a_frame_that_the_decoder_made_up_is_damaged(tmp_path):
    path = tmp_path / "a.mp4"
    rng = np.random.default_rng(0)
    picture = rng.integers(0, 256, (64, 200, 3)).astype(np.uint8)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=25, options={"g": "12"})
        stream.width, stream.height, stream.pix_fmt = 96, 64, "yuv420p"
        for start in range(0, 96, 4):
            part = np.ascontiguousarray(picture[:, start : start + 96])
            container.mux(stream.encode(av.VideoFrame.from_ndarray(part, format="rgb24")))
        container.mux(stream.encode())
    assert not any(frame.damaged for frame in Movie(path).frames())
    data = bytearray(path.read_bytes())
    middle = len(data) // 10
    data[middle : middle + 200] = bytes(rng.integers(0, 256, 200, np.uint8))
    path.write_bytes(data)
    # What is made from a damaged frame is no better, up to the next that stands alone.
    assert [frame.damaged for frame in Movie(path).frames()] == [True] * 12 + [False] * 12


def test_with_all_tags_nothing_is_assumed(tmp_path):
    planes = [flat(v, HEIGHT // d, WIDTH // d, 8) for v, d in ((101, 1), (90, 2), (161, 2))]
    tags = {"colorspace": 1, "color_range": LIMITED, "color_trc": 1, "color_primaries": 1}
    info = Movie(write_movie(tmp_path / "a.mkv", "yuv420p", [planes], **tags)).info
    assert info.assumed == ()
    assert info.transfer == "rec709"


@pytest.mark.parametrize(
    ("code", "name"), [(1, "rec709"), (13, "srgb"), (8, "linear"), (14, "rec709"), (16, None)]
)
def test_the_transfer_function_is_read_from_the_movie(code, name, tmp_path):
    planes = [flat(v, HEIGHT // d, WIDTH // d, 8) for v, d in ((101, 1), (90, 2), (161, 2))]
    path = write_movie(tmp_path / "a.mkv", "yuv420p", [planes], color_trc=code)
    assert Movie(path).info.transfer == name


@pytest.mark.parametrize("rate", [Fraction(24), Fraction(25), Fraction(24000, 1001)])
def test_frames_come_in_order_with_their_times(rate, tmp_path):
    frames = [
        [flat(16 + 20 * i, HEIGHT, WIDTH, 8)] + [flat(128, HEIGHT // 2, WIDTH // 2, 8)] * 2
        for i in range(9)
    ]
    tags = {"colorspace": 1, "color_range": LIMITED}
    movie = Movie(write_movie(tmp_path / "a.mkv", "yuv420p", frames, rate, **tags))
    read = list(movie.frames())
    assert [frame.position for frame in read] == list(range(9))
    np.testing.assert_allclose(
        [f.seconds for f in read], [float(i / rate) for i in range(9)], atol=2e-3
    )
    np.testing.assert_allclose(
        [f.coded[5, 5, 0] for f in read], [20 * i / 219 for i in range(9)], atol=1e-3
    )
    assert float(movie.info.frame_rate) == pytest.approx(float(rate), rel=1e-4)


def test_what_a_movie_says_of_itself(tmp_path):
    info = Movie(untagged(tmp_path / "a.mkv")).info
    assert (info.width, info.height, info.bits) == (WIDTH, HEIGHT, 8)
    assert info.frame_rate == 25


def test_odd_sizes_are_decoded_whole(tmp_path):
    planes = [flat(101, 31, 47, 8), flat(128, 16, 24, 8), flat(128, 16, 24, 8)]
    path = write_movie(tmp_path / "a.mkv", "yuv420p", [planes], color_range=LIMITED, colorspace=1)
    rgb = decoded(path)
    assert rgb.shape == (31, 47, 3)
    np.testing.assert_allclose(rgb, (101 - 16) / 219, atol=1e-3)


@pytest.mark.parametrize("content", [b"", b"this is text, no movie\n" * 40, bytes(4096)])
@pytest.mark.parametrize("suffix", [".mov", ".mp4", ".mkv", ".avi", ".txt"])
def test_what_is_no_movie_is_refused_by_name(content, suffix, tmp_path):
    path = tmp_path / f"take{suffix}"
    path.write_bytes(content)
    with pytest.raises(InputError, match="take"):
        list(Movie(path).frames())


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".tif", ".bmp", ".webp"])
def test_a_still_picture_is_no_movie(suffix, tmp_path):
    path = tmp_path / f"still{suffix}"
    cv2.imwrite(str(path), np.full((HEIGHT, WIDTH, 3), 100, np.uint8))
    with pytest.raises(InputError, match="still"):
        Movie(path)


@pytest.mark.parametrize("name", ["gone.mkv", "."])
def test_what_is_no_file_is_no_movie(name, tmp_path):
    with pytest.raises(InputError, match=r"no file|neither"):
        Movie(tmp_path / name)


def test_a_truncated_movie_gives_no_broken_frame(tmp_path):
    rng = np.random.default_rng(0)
    frames = [
        [rng.integers(16, 235, (HEIGHT, WIDTH)).astype(np.uint8)]
        + [flat(128, HEIGHT // 2, WIDTH // 2, 8)] * 2
        for _ in range(8)
    ]
    path = write_movie(tmp_path / "a.mkv", "yuv420p", frames, color_range=LIMITED, colorspace=1)
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    read = []
    try:
        read.extend(Movie(path).frames())
    except DamagedFileError as error:
        assert "a.mkv" in str(error)
    assert 0 < len(read) < 8
    for frame, planes in zip(read, frames, strict=False):
        np.testing.assert_allclose(frame.coded[..., 1], (planes[0] - 16.0) / 219, atol=1e-3)


def test_sound_without_a_picture_is_refused(tmp_path):
    path = tmp_path / "sound.wav"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("pcm_s16le", rate=48000)
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 480), np.int16), layout="mono")
        frame.sample_rate = 48000
        container.mux(stream.encode(frame))
    with pytest.raises(InputError, match=r"sound\.wav"):
        Movie(path)
