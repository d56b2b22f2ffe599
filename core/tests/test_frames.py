"""Raw frames of Geiger-mode cameras: counted as they are read, so that they may be large."""

from __future__ import annotations

import io
import itertools
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from core.capture import CaptureError
from core.io.readers import frames, guards, read_capture
from core.io.readers.frame_guess import resembles_frames
from core.tests.captures import real_capture_path
from core.tests.refusing import with_peak
from core.tests.samples import CAMERA_CUBE, CUBE, frames_of, gmapd_bytes, npy_bytes, npz_bytes

pytestmark = pytest.mark.files

Write = Callable[[str, bytes], Path]

FRAMES = frames_of(CUBE, 500, -1).astype(np.int16)


def stored_npz(**arrays: Any) -> bytes:
    file = io.BytesIO()
    np.savez(file, **arrays)
    return file.getvalue()


@pytest.mark.parametrize("axes", list(itertools.permutations(frames.AXES)))
def test_any_order_of_axes_in_any_stretch(
    axes: tuple[str, ...], write: Write, monkeypatch: pytest.MonkeyPatch
) -> None:
    expected = np.zeros_like(CUBE)
    fired = np.argwhere(FRAMES[:30] >= 0)
    np.add.at(expected, (fired[:, 1], fired[:, 2], FRAMES[:30][FRAMES[:30] >= 0]), 1)
    stack = FRAMES[:30].transpose([frames.AXES.index(name) for name in axes])
    for layout in (np.ascontiguousarray, np.asfortranarray):
        path = write("f.npy", npy_bytes(layout(stack)))
        for stretch in (1, 7, 50, 10**6):
            monkeypatch.setattr(frames, "STRETCH", stretch)
            capture = read_capture(path, no_trigger=-1, axes=" ".join(axes), n_bins=100)
            np.testing.assert_array_equal(capture.cube, expected, f"{layout} {stretch}")


@pytest.mark.parametrize(("no_trigger", "dtype"), [(-1, "i2"), (65535, "u2"), (-1, "f4")])
@pytest.mark.parametrize("name", ["f.npy", "f.npz"])
def test_frames_are_no_cube(no_trigger: int, dtype: str, name: str, write: Write) -> None:
    stack = np.where(FRAMES < 0, no_trigger, FRAMES).astype(dtype)[:40]
    content = npy_bytes(stack) if name.endswith("npy") else npz_bytes(data=stack)
    path = write(name, content)
    given = f"no_trigger = None .* give {no_trigger}.* raw frames"
    with pytest.raises(CaptureError, match=given) as refused:
        read_capture(path)
    assert refused.value.choices == {"Raw frames": {"no_trigger": str(no_trigger)}}
    assert f"in which {no_trigger} marks no trigger" in refused.value.question
    assert read_capture(path, no_trigger=no_trigger).acquisition.n_pulses == 40


@pytest.mark.parametrize("name", ["f.npy", "f.npz"])
def test_nan_in_frames_marks_no_trigger(name: str, write: Write) -> None:
    def stored(stack: NDArray[Any]) -> Path:
        return write(name, npy_bytes(stack) if name.endswith("npy") else npz_bytes(data=stack))

    stack = np.where(FRAMES < 0, np.nan, FRAMES)[:40]
    path = stored(stack)
    with pytest.raises(CaptureError, match=r"give -1 if .* in which NaN marks no trigger") as asked:
        read_capture(path)
    assert asked.value.choices == {"Raw frames": {"no_trigger": "-1"}}
    assert "in which NaN marks no trigger" in asked.value.question
    found = read_capture(path, no_trigger=-1)
    whole = read_capture(stored(FRAMES[:40]), no_trigger=-1)
    np.testing.assert_array_equal(found.cube, whole.cube)
    with pytest.raises(CaptureError, match="round times in bins down"):
        read_capture(stored(stack + 0.25), no_trigger=-1)


def camera_frames(share: float, n_pulses: int) -> NDArray[np.uint8]:
    """Frames of 32 x 32 pixels, each with a target of its own, in which 0 marks no trigger."""
    rng = np.random.default_rng(0)
    shape = (n_pulses, 32, 32)
    fired = rng.random(shape) < share * rng.uniform(0.3, 1.0, shape[1:])
    echo = np.broadcast_to(rng.integers(20, 150, shape[1:]), shape)
    bins = np.where(rng.random(shape) < 0.5, echo, rng.integers(1, 154, shape))
    return np.asarray(fired * bins, np.uint8)


@pytest.mark.parametrize(("share", "n_pulses"), [(0.05, 200), (0.5, 60)])
@pytest.mark.parametrize("name", ["f.npy", "f.npz"])
def test_frames_in_which_0_is_no_trigger_are_no_cube(
    share: float, n_pulses: int, name: str, write: Write
) -> None:
    stack = camera_frames(share, n_pulses)
    path = write(name, npy_bytes(stack) if name.endswith("npy") else npz_bytes(data=stack))
    given = r"no_trigger = None .* give 0 if .* raw frames .* axes"
    with pytest.raises(CaptureError, match=given) as refused:
        read_capture(path)
    assert list(refused.value.choices) == ["Raw frames", "Counts"]
    assert refused.value.choices["Counts"] == {"axes": "bin row col"}  # images are square
    capture = read_capture(path, no_trigger=0)
    assert capture.guesses["axes"] == "pulse row col"
    assert capture.acquisition.n_pulses == n_pulses
    assert capture.counts.sum() == np.count_nonzero(stack)
    np.testing.assert_array_equal(read_capture(path, axes="row col bin").cube, stack)


@pytest.mark.parametrize("no_trigger", [-1, 100, 255, 1023, 65535])
@pytest.mark.parametrize("shape", [(1000, 16, 16), (200, 12, 16)])
def test_frames_with_any_mark_name_it(
    no_trigger: int, shape: tuple[int, int, int], write: Write
) -> None:
    """A quarter of the pulses do not fire; the others do in one of 100 bins."""
    first = np.random.default_rng(4).exponential(70, shape).astype(int)
    stack = np.where(first < 100, first, no_trigger).astype(np.int32)
    path = write("f.npy", npy_bytes(stack))
    with pytest.raises(CaptureError, match=f"give {no_trigger} if .* raw frames .*% of"):
        read_capture(path)
    assert read_capture(path, no_trigger=no_trigger).acquisition.n_bins == 100


def test_saturated_or_equal_counts_have_no_mark(write: Write) -> None:
    rng = np.random.default_rng(5)
    background = rng.poisson(3.0, (64, 48, 100))
    echo = background + 100 * (np.arange(100) == 30)
    for counts in (
        np.minimum(rng.poisson(40 * np.exp(-np.arange(100) / 20), background.shape), 30),
        np.minimum(echo, 90),
        np.where(np.arange(100) == 30, 50, background),
    ):
        path = write("c.npy", npy_bytes(counts.astype(np.uint16)))
        np.testing.assert_array_equal(read_capture(path).cube, counts)


@pytest.mark.parametrize("share", [0.7, 0.9, 0.97])
def test_frames_in_which_most_pixels_fire_are_no_cube(share: float) -> None:
    """Half of the light is background over 100 bins, half from a slope."""
    rng = np.random.default_rng(1)
    shape, half = (200, 24, 24), -np.log1p(-share) / 2
    echo = np.where(rng.random(shape) < -np.expm1(-half), 20 + 2 * np.arange(24), 1000)
    first = np.minimum(1 + (rng.exponential(100 / half, shape)).astype(int), echo)
    stack = np.where(first <= 100, first, 0)
    assert np.count_nonzero(stack) == pytest.approx(share * stack.size, rel=0.01)
    assert resembles_frames(stack)
    assert not resembles_frames(np.where(stack == 0, 1, stack))


@pytest.mark.parametrize("dead", [0.02, 0.6])
def test_counts_with_dead_pixels_are_not_taken_for_frames(dead: float) -> None:
    rng = np.random.default_rng(2)
    counts = rng.poisson(30.0, (64, 48, 100))
    counts[rng.random(counts.shape[:2]) < dead] = 0
    for axes in itertools.permutations(range(3)):
        assert not resembles_frames(counts.transpose(axes))


def surfaces(kind: str) -> NDArray[np.int64]:
    """Bins (row, col) at which echoes of a wall, a slope or random depths begin."""
    row, col = np.indices((64, 48))
    depths = np.random.default_rng(1).integers(0, 100, row.shape)
    return {"wall": 30 + 0 * col, "slope": row, "random": depths}[kind]


@pytest.mark.parametrize("kind", ["wall", "slope", "random"])
@pytest.mark.parametrize("background", [0.0, 0.07, 3.0])
@pytest.mark.parametrize(("echo", "width"), [(5, 1), (100, 8), (100, 50), (1000, 1)])
def test_counts_are_not_taken_for_frames(
    kind: str, background: float, echo: float, width: int
) -> None:
    rng = np.random.default_rng(2)
    later = (np.arange(100) - surfaces(kind)[:, :, np.newaxis]) % 100
    counts = rng.poisson(background + echo * (later < width))
    for empty in (np.zeros(counts.shape[:2], bool), rng.random(counts.shape[:2]) > 0.3):
        counts[empty] = 0
        assert not resembles_frames(counts)
        assert not resembles_frames(counts.transpose(1, 0, 2))


@pytest.mark.parametrize("flux", [0.5, 3.0, 8.0, 20.0, 160.0])
@pytest.mark.parametrize("n_pulses", [300, 10**5])
def test_pile_up_is_not_taken_for_frames(flux: float, n_pulses: int) -> None:
    triggers = -np.diff(np.exp(-flux * np.linspace(0, 1, 101)))
    counts = np.random.default_rng(3).poisson(n_pulses * triggers, (64, 48, 100))
    assert not resembles_frames(counts)


def test_real_counts_are_not_taken_for_frames() -> None:
    for name in ("21km_K11_night.mat", "tmf8820_distance_data.json"):
        cube = read_capture(real_capture_path(name)).cube
        for axes in itertools.permutations(range(3)):
            assert not resembles_frames(cube.transpose(axes))


def test_a_cube_may_hold_any_counts(write: Write) -> None:
    for cube in (np.full((2, 3, 9), 255), np.tile([0, 0, 0, 60000], (2, 3, 5)), CUBE):
        found = read_capture(write("c.npy", npy_bytes(cube.astype(np.uint16))))
        np.testing.assert_array_equal(found.cube, cube)


def test_frames_are_first_photons(write: Write) -> None:
    capture = read_capture(write("f.npy", npy_bytes(FRAMES)), no_trigger=-1)
    assert capture.detection == "first"
    assert capture.acquisition.n_pulses == 500
    assert capture.source.startswith("f.npy; guessed: axes (pulse, row, col), bin width 1 ns")
    assert "photons" not in capture.source
    options = {"bin_width_s": 2e-9, "gate_delay_s": 1e-7, "pixel_angle_rad": 1e-3, "n_pulses": 500}
    truth = np.full((3, 4), 150.0)
    content = npz_bytes(frames=FRAMES, no_trigger=-1, truth_range_m=truth, **options)
    capture = read_capture(write("f.npz", content))
    acquisition = capture.acquisition
    assert {name: getattr(acquisition, name) for name in options} == options
    assert capture.truth_range_m is not None
    content = npz_bytes(shots=FRAMES, other=np.ones(3))
    np.testing.assert_array_equal(
        read_capture(write("o.npz", content), no_trigger=-1).cube, capture.cube
    )


@pytest.mark.parametrize("stretch", [7, 10**6])
@pytest.mark.parametrize("axes", ["pulse row col", "row col pulse"])
def test_frames_are_records(
    axes: str, stretch: int, write: Write, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(frames, "STRETCH", stretch)
    stack = FRAMES[:30].transpose([frames.AXES.index(name) for name in axes.split()])
    content = npz_bytes(frames=stack, no_trigger=-1, n_pulses=30)
    path = write("f.npz", content)
    whole = read_capture(path, axes=axes)
    parts = [read_capture(path, axes=axes, records=span) for span in (0, (1, 28), 29)]
    assert {part.n_records for part in (whole, *parts)} == {30}
    assert [part.acquisition.n_pulses for part in parts] == [1, 28, 1]
    np.testing.assert_array_equal(sum(part.cube for part in parts), whole.cube)  # in one gate
    np.testing.assert_array_equal(parts[2].counts, FRAMES[29] >= 0)
    assert [part.source.split("; ")[0] for part in parts] == [
        "f.npz, variable frames, frame 0 of 30",
        "f.npz, variable frames, frames 1 to 28 of 30 added",
        "f.npz, variable frames, frame 29 of 30",
    ]


def test_frames_of_a_camera_are_records(write: Write) -> None:
    path = write("f.bin", gmapd_bytes(CAMERA_CUBE, 50))
    first, rest = (read_capture(path, records=span) for span in ((0, 9), (10, 49)))
    np.testing.assert_array_equal(first.cube + rest.cube, CAMERA_CUBE)
    assert (first.n_records, first.acquisition.n_pulses) == (50, 10)


def test_many_pulses_widen_the_cube(write: Write) -> None:
    stack = np.zeros((70_000, 1, 1), np.uint8)
    capture = read_capture(write("m.npy", npy_bytes(stack)), no_trigger=255)
    assert capture.cube.dtype == np.uint32 and capture.cube[0, 0, 0] == 70_000


def test_only_the_cube_must_fit(write: Write, monkeypatch: pytest.MonkeyPatch) -> None:
    stack = np.tile(FRAMES, (100, 1, 1))
    files = {
        "s.npy": npy_bytes(stack),
        "s.npz": stored_npz(frames=stack, no_trigger=-1),
        "s.bin": gmapd_bytes(CAMERA_CUBE, 200),
    }
    limit = 2**19
    monkeypatch.setattr(guards, "MAX_CUBE_BYTES", limit)
    monkeypatch.setattr(frames, "STRETCH", 2**13)
    for name, content in files.items():
        path = write(name, content)
        assert path.stat().st_size > 0.8 * limit
        options = {"no_trigger": -1} if name == "s.npy" else {}
        read = partial(read_capture, path, **options)
        read()  # imports what it needs
        capture, peak = with_peak(read)
        assert capture.counts.sum() > 0
        assert peak < 8 * capture.cube.nbytes + 100 * 2**13
    with pytest.raises(CaptureError, match=r"bytes of frames = .* at most 524,288"):
        read_capture(write("c.npz", npz_bytes(frames=stack, no_trigger=-1)))
    monkeypatch.setattr(guards, "MAX_CUBE_BYTES", 2000)
    with pytest.raises(CaptureError, match=r"the cube of the array, 100 bins = 2400 "):
        read_capture(write("s.npy", npy_bytes(FRAMES)), no_trigger=-1)


def changed(value: float, dtype: Any = np.float64) -> bytes:
    stack = FRAMES.astype(dtype)
    stack[7, 2, 1] = value
    return npy_bytes(stack)


def camera(value: int) -> bytes:
    numbers = np.frombuffer(gmapd_bytes(CAMERA_CUBE, 50), "<u2").copy().reshape(50, 33, 32)
    numbers[9, 1 + 4, 5] = value
    return numbers.tobytes()


OTHERS = {"no_trigger": -1}
IN_PULSE_7 = r"in pulse 7, pixel \(2, 1\) = "
TOO_MANY = r"= 1e\+300 .*0 to 65535 \(more with n_bins\), or -1 where nothing fired"

REFUSED: tuple[tuple[str, bytes, dict[str, Any], str], ...] = (
    (
        "f.npy",
        changed(100, np.int32),
        OTHERS | {"n_bins": 100},
        IN_PULSE_7 + "100 .*0 to 99 for n_bins = 100, or -1 where nothing",
    ),
    ("f.npy", changed(-2, np.int32), OTHERS, IN_PULSE_7 + "-2 .*0 to 65535"),
    ("f.npy", changed(1.5), OTHERS, IN_PULSE_7 + "1.5"),
    ("f.npy", changed(1e300), OTHERS, TOO_MANY),
    ("f.npy", changed(2**16, np.int32), OTHERS, IN_PULSE_7 + "65536 .*0 to 65535"),
    ("f.npy", npy_bytes(FRAMES), {"no_trigger": 255}, "= -1 .*255"),
    ("f.npy", npy_bytes(np.full((5, 2, 2), -1)), OTHERS, "triggers of the array = 0 .*n_bins"),
    ("f.npy", npy_bytes(FRAMES), OTHERS | {"n_pulses": 499}, "n_pulses = 499 .*500"),
    ("f.npy", npy_bytes(FRAMES), OTHERS | {"records": 500}, "records = 500 .*one of 0 to 499"),
    ("f.npy", npy_bytes(FRAMES[0]), OTHERS, r"shape \(3, 4\).*\(pulse, row, col\)"),
    ("f.npy", npy_bytes(FRAMES[:0]), OTHERS, r"\(0, 3, 4\)"),
    ("f.npy", npy_bytes(FRAMES * 1j), OTHERS, "complex128"),
    ("f.npy", npy_bytes(FRAMES)[:-2], OTHERS, "bytes of the array"),
    ("f.npz", npz_bytes(frames=FRAMES), {}, "no_trigger = None"),
    ("f.npz", npz_bytes(frames=FRAMES, no_trigger=0.5), {}, "no_trigger = 0.5 .*whole"),
    ("f.npz", npz_bytes(frames=FRAMES, n_pulses=7, **OTHERS), {}, "n_pulses = 7 .*500"),
    ("f.npz", npz_bytes(cube=CUBE), {"no_trigger": 0}, "no_trigger"),
    ("f.bin", b"", {}, "bytes of the file = 0 .*2112"),
    ("f.bin", bytes(3000), {}, "= 3000 .*multiple of 2112"),
    ("f.bin", camera(3), {}, r"in pulse 9, pixel \(4, 5\) = 3 .*4 to 156 for n_bins = 153, or 0"),
    ("f.bin", camera(157), {}, r"pixel \(4, 5\) = 157"),
    ("f.bin", camera(0), {"axes": "row col pulse"}, "axes = 'row col pulse' .*pulse first"),
)


@pytest.mark.parametrize(("name", "content", "options", "message"), REFUSED)
def test_refused(
    name: str, content: bytes, options: dict[str, Any], message: str, write: Write
) -> None:
    with pytest.raises(CaptureError, match=f"^{name}: .*{message}"):
        read_capture(write(name, content), **options)


def test_a_camera_may_have_more_bins(write: Write) -> None:
    capture = read_capture(write("f.bin", camera(157)), n_bins=200)
    assert capture.cube.shape == (32, 32, 200) and capture.cube[4, 5, 153] == 1
    turned = read_capture(write("f.bin", camera(4)), axes="pulse col row")
    assert turned.cube[5, 4, 0] >= 1
