"""Raw frames of Geiger-mode cameras: counted as they are read, whatever their size."""

from __future__ import annotations

import io
import itertools
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from core.capture import CaptureError
from core.io.readers import frames, guards, read_capture
from core.tests.samples import CAMERA_CUBE, CUBE, frames_of, gmapd_bytes, npy_bytes, npz_bytes

pytestmark = pytest.mark.files

FRAMES = frames_of(CUBE, 500, -1).astype(np.int16)


def stored_npz(**arrays: Any) -> bytes:
    file = io.BytesIO()
    np.savez(file, **arrays)
    return file.getvalue()


@pytest.mark.parametrize("axes", list(itertools.permutations(frames.AXES)))
@pytest.mark.parametrize("stretch", [1, 7, 50, 10**6])
@pytest.mark.parametrize("layout", [np.ascontiguousarray, np.asfortranarray])
def test_any_order_of_axes_in_any_stretch(
    axes: tuple[str, ...],
    stretch: int,
    layout: Callable[[Any], Any],
    write: Callable[[str, bytes], Path],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(frames, "STRETCH", stretch)
    order = [frames.AXES.index(name) for name in axes]
    stack = layout(FRAMES[:30].transpose(order))
    told = {"no_trigger": -1, "axes": " ".join(axes), "n_bins": 100}
    capture = read_capture(write("f.npy", npy_bytes(stack)), **told)
    expected = np.zeros_like(CUBE)
    fired = np.argwhere(FRAMES[:30] >= 0)
    np.add.at(expected, (fired[:, 1], fired[:, 2], FRAMES[:30][FRAMES[:30] >= 0]), 1)
    np.testing.assert_array_equal(capture.cube, expected)


def test_boxes_are_the_array_in_its_order() -> None:
    values = np.arange(4 * 5 * 6).reshape(4, 5, 6)
    for most in (1, 5, 6, 13, 30, 1000):
        parts = [values[box].ravel() for box in frames.boxes(values.shape, most)]
        np.testing.assert_array_equal(np.concatenate(parts), values.ravel())
        assert max(part.size for part in parts) <= most


def test_frames_are_first_photons(write: Callable[[str, bytes], Path]) -> None:
    capture = read_capture(write("f.npy", npy_bytes(FRAMES)), no_trigger=-1)
    assert capture.detection == "first"
    assert capture.acquisition.n_pulses == 500
    assert capture.source.startswith("f.npy; guessed: axes (pulse, row, col), bin width 1 ns")
    assert "photons" not in capture.source
    told = {"bin_width_s": 2e-9, "gate_delay_s": 1e-7, "pixel_angle_rad": 1e-3, "n_pulses": 500}
    truth = np.full((3, 4), 150.0)
    content = npz_bytes(frames=FRAMES, no_trigger=-1, truth_range_m=truth, **told)
    capture = read_capture(write("f.npz", content))
    acquisition = capture.acquisition
    assert {name: getattr(acquisition, name) for name in told} == told
    assert capture.truth_range_m is not None
    content = npz_bytes(shots=FRAMES, other=np.ones(3))
    np.testing.assert_array_equal(
        read_capture(write("o.npz", content), no_trigger=-1).cube, capture.cube
    )


def test_bins_count_backwards_from_a_common_stop(write: Callable[[str, bytes], Path]) -> None:
    backwards = np.where(FRAMES >= 0, 99 - FRAMES, -1)
    capture = read_capture(
        write("b.npy", npy_bytes(backwards)), no_trigger=-1, stop_s=1.1e-6, n_bins=100
    )
    np.testing.assert_array_equal(capture.cube, CUBE)
    assert capture.acquisition.gate_delay_s == pytest.approx(1e-6, rel=1e-12)


def test_many_pulses_widen_the_cube(write: Callable[[str, bytes], Path]) -> None:
    stack = np.zeros((70_000, 1, 1), np.uint8)
    capture = read_capture(write("m.npy", npy_bytes(stack)), no_trigger=255)
    assert capture.cube.dtype == np.uint32 and capture.cube[0, 0, 0] == 70_000


def test_only_the_cube_must_fit(
    write: Callable[[str, bytes], Path], monkeypatch: pytest.MonkeyPatch
) -> None:
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
        told = {"no_trigger": -1} if name == "s.npy" else {}
        tracemalloc.start()
        try:
            capture = read_capture(path, **told)
            peak = tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()
        assert capture.counts.sum() > 0
        assert peak < 8 * capture.cube.nbytes + 100 * 2**13
    with pytest.raises(CaptureError, match=r"bytes of frames = .* at most 524,288"):
        read_capture(write("c.npz", npz_bytes(frames=stack, no_trigger=-1)))
    monkeypatch.setattr(guards, "MAX_CUBE_BYTES", 2000)
    with pytest.raises(CaptureError, match=r"the cube of the array, 100 bins = 2400 "):
        read_capture(write("s.npy", npy_bytes(FRAMES)), no_trigger=-1)


def changed(value: float, dtype: Any = np.float64) -> np.ndarray:
    stack = FRAMES.astype(dtype)
    stack[7, 2, 1] = value
    return stack


def camera(value: int) -> bytes:
    numbers = np.frombuffer(gmapd_bytes(CAMERA_CUBE, 50), "<u2").copy().reshape(50, 33, 32)
    numbers[9, 1 + 4, 5] = value
    return numbers.tobytes()


REFUSED: dict[str, tuple[str, Any, dict[str, Any], str]] = {
    "a bin beyond the gate": (
        "f.npy",
        lambda: npy_bytes(changed(100, np.int32)),
        {"no_trigger": -1, "n_bins": 100},
        r"in pulse 7, pixel \(2, 1\) = 100 .*0 to 99 for n_bins = 100, or -1 where nothing",
    ),
    "a negative bin": (
        "f.npy",
        lambda: npy_bytes(changed(-2, np.int32)),
        {"no_trigger": -1},
        r"in pulse 7, pixel \(2, 1\) = -2 .*0 to 65535",
    ),
    "half a bin": (
        "f.npy",
        lambda: npy_bytes(changed(1.5)),
        {"no_trigger": -1},
        r"pixel \(2, 1\) = 1.5",
    ),
    "no number": (
        "f.npy",
        lambda: npy_bytes(changed(np.nan)),
        {"no_trigger": -1},
        r"pixel \(2, 1\) = nan",
    ),
    "infinite": (
        "f.npy",
        lambda: npy_bytes(changed(np.inf)),
        {"no_trigger": -1},
        r"pixel \(2, 1\) = inf",
    ),
    "a gate without end": (
        "f.npy",
        lambda: npy_bytes(changed(1e300)),
        {"no_trigger": -1},
        r"= 1e\+300 .*0 to 65535 \(more with n_bins\), or -1 where nothing fired",
    ),
    "a number beyond the gates that are guessed": (
        "f.npy",
        lambda: npy_bytes(changed(2**16, np.int32)),
        {"no_trigger": -1},
        r"in pulse 7, pixel \(2, 1\) = 65536 .*0 to 65535",
    ),
    "another no_trigger": ("f.npy", lambda: npy_bytes(FRAMES), {"no_trigger": 255}, "= -1 .*255"),
    "nothing fired": (
        "f.npy",
        lambda: npy_bytes(np.full((5, 2, 2), -1)),
        {"no_trigger": -1},
        "triggers of the array = 0 .*n_bins",
    ),
    "other pulses": (
        "f.npy",
        lambda: npy_bytes(FRAMES),
        {"no_trigger": -1, "n_pulses": 499},
        "n_pulses = 499 .*500",
    ),
    "flat": (
        "f.npy",
        lambda: npy_bytes(FRAMES[0]),
        {"no_trigger": -1},
        r"shape \(3, 4\).*\(pulse, row, col\)",
    ),
    "no frames": ("f.npy", lambda: npy_bytes(FRAMES[:0]), {"no_trigger": -1}, r"\(0, 3, 4\)"),
    "complex": ("f.npy", lambda: npy_bytes(FRAMES * 1j), {"no_trigger": -1}, "complex128"),
    "truncated": ("f.npy", lambda: npy_bytes(FRAMES)[:-2], {"no_trigger": -1}, "bytes of the arr"),
    "no no_trigger": ("f.npz", lambda: npz_bytes(frames=FRAMES), {}, "no_trigger = None"),
    "half a no_trigger": (
        "f.npz",
        lambda: npz_bytes(frames=FRAMES, no_trigger=0.5),
        {},
        "no_trigger = 0.5 .*whole",
    ),
    "other pulses in the file": (
        "f.npz",
        lambda: npz_bytes(frames=FRAMES, no_trigger=-1, n_pulses=7),
        {},
        "n_pulses = 7 .*500",
    ),
    "a cube is no frames": ("f.npz", lambda: npz_bytes(cube=CUBE), {"no_trigger": 0}, "no_trigger"),
    "truncated npz": (
        "f.npz",
        lambda: stored_npz(frames=FRAMES, no_trigger=-1)[:9000],
        {},
        "damaged",
    ),
    "no frame of a camera": ("f.bin", lambda: b"", {}, "bytes of the file = 0 .*2112"),
    "half a frame of a camera": ("f.bin", lambda: bytes(3000), {}, "= 3000 .*multiple of 2112"),
    "below a camera's first bin": (
        "f.bin",
        lambda: camera(3),
        {},
        r"in pulse 9, pixel \(4, 5\) = 3 .*4 to 156 for n_bins = 153, or 0",
    ),
    "beyond a camera's last bin": ("f.bin", lambda: camera(157), {}, r"pixel \(4, 5\) = 157"),
    "pixels before pulses": (
        "f.bin",
        lambda: camera(0),
        {"axes": "row col pulse"},
        "axes = 'row col pulse' .*pulse first",
    ),
}


@pytest.mark.parametrize("what", REFUSED)
def test_refused(what: str, write: Callable[[str, bytes], Path]) -> None:
    name, build, told, message = REFUSED[what]
    with pytest.raises(CaptureError, match=message) as caught:
        read_capture(write(name, build()), **told)
    assert str(caught.value).startswith(f"{name}: ")


def test_a_camera_may_be_told_of_more_bins(write: Callable[[str, bytes], Path]) -> None:
    capture = read_capture(write("f.bin", camera(157)), n_bins=200)
    assert capture.cube.shape == (32, 32, 200) and capture.cube[4, 5, 153] == 1
    turned = read_capture(write("f.bin", camera(4)), axes="pulse col row")
    assert turned.cube[5, 4, 0] >= 1
