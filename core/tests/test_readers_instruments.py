"""Files of instruments: what they specify, what is guessed, and what must be refused."""

from __future__ import annotations

import gzip
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from core.acquisition import Pulse
from core.capture import CaptureError
from core.estimators import estimate
from core.io.readers import read_capture
from core.tests.captures import real_capture_path
from core.tests.instruments import (
    COMPRESSED,
    FCS,
    IMAGE,
    UINT32,
    ptu_bytes,
    ptu_with,
    sdt_bytes,
    split,
    tmf8820_bytes,
    tmf8820_records,
    tmf8829_bytes,
    tmf8829_log,
    zipped,
)
from core.tests.refusing import assert_refused
from core.tests.samples import CUBE

pytestmark = pytest.mark.files

Write = Callable[[str, bytes], Path]
PTU = ptu_bytes(CUBE)


# -- PicoQuant ----------------------------------------------------------------------------------


def test_ptu_has_a_bin_width_and_all_photons(write: Write) -> None:
    capture = read_capture(write("a.ptu", ptu_bytes(CUBE, 12.5e-9, 16e-12)), n_pulses=10**6)
    assert capture.acquisition.bin_width_s == 16e-12
    assert capture.acquisition.gate_delay_s == 0
    assert capture.acquisition.n_bins == 782  # 781.25 to a period: the last one begins within
    np.testing.assert_array_equal(capture.cube[:, :, :100], CUBE)
    assert capture.detection == "all"
    assert capture.source == (
        "a.ptu; guessed: gate 0-12.512 ns, pulse Gaussian of 16 ps (one bin: width not determined)"
    )


def test_ptu_sums_frames_and_channels_or_takes_one(write: Write) -> None:
    parts = split(CUBE)
    path = write("a.ptu", ptu_bytes(parts))
    assert read_capture(path).source.startswith("a.ptu, 2 frames and 2 channels summed; ")
    for channel in (0, 1):
        capture = read_capture(path, variable=f"channel {channel}")
        np.testing.assert_array_equal(capture.cube, parts.sum(axis=0)[:, :, channel])
        assert capture.source.startswith(f"a.ptu, channel {channel}, 2 frames summed; ")
    with pytest.raises(CaptureError, match=r"variable = 'channel 2' .*channel 0, channel 1"):
        read_capture(path, variable="channel 2")


def test_ptu_frames_are_records(write: Write) -> None:
    shares = np.random.default_rng(7).multinomial(CUBE, np.full(5, 0.2))
    path = write("a.ptu", ptu_bytes(np.moveaxis(shares, -1, 0)[:, :, :, np.newaxis]))
    for span, expected, text in (
        (3, shares[..., 3], "frame 3 of 5"),
        ((1, 3), shares[..., 1:4].sum(axis=-1), "frames 1 to 3 of 5 added"),
        ((0, 4), CUBE, "all 5 frames added"),
    ):
        capture = read_capture(path, records=span)
        np.testing.assert_array_equal(capture.cube, expected)
        assert capture.source.startswith(f"a.ptu, {text}; ")
        assert capture.n_records == 5


def test_ptu_keeps_to_one_period(write: Write) -> None:
    """Photons that a file holds later than that belong to no bin."""
    capture = read_capture(write("a.ptu", ptu_bytes(CUBE, period_s=40e-9)))
    np.testing.assert_array_equal(capture.cube, CUBE[:, :, :40])


# -- Becker & Hickl -----------------------------------------------------------------------------


@pytest.mark.parametrize("kind", [IMAGE, IMAGE | UINT32, IMAGE | COMPRESSED])
def test_sdt_has_a_bin_width_and_all_photons(kind: int, write: Write) -> None:
    path = write("a.sdt", sdt_bytes(CUBE, kind=kind, range_s=12.5e-9))
    capture = read_capture(path, n_pulses=10**6)
    assert capture.acquisition.bin_width_s == 125e-12  # the file holds numbers of 4 bytes
    assert capture.detection == "all"
    assert capture.source == (
        "a.sdt, block 0; guessed: gate 0-12.5 ns, "
        "pulse Gaussian of 125 ps (one bin: width not determined)"
    )


def test_sdt_blocks_are_chosen_by_name(write: Write) -> None:
    path = write("a.sdt", sdt_bytes(CUBE, 2 * CUBE))
    with pytest.raises(CaptureError, match=r"give block 0 or block 1, each.*block 1 \(an image\)"):
        read_capture(path)
    np.testing.assert_array_equal(read_capture(path, variable="block 1").cube, 2 * CUBE)


def test_sdt_of_curves_is_one_row(write: Write) -> None:
    content = sdt_bytes(CUBE, kind=0x01, of_measurement={"scan_x": 0, "scan_y": 0})
    capture = read_capture(write("a.sdt", content))
    np.testing.assert_array_equal(capture.cube, CUBE.reshape(1, 12, 100))


def test_sdt_sums_routing_channels(write: Write) -> None:
    both = np.concatenate([CUBE, 2 * CUBE])
    fields = {"scan_y": 3, "scan_x": 4, "scan_rx": 2}
    capture = read_capture(write("a.sdt", sdt_bytes(both, of_measurement=fields)))
    np.testing.assert_array_equal(capture.cube, 3 * CUBE)


def test_sdt_without_times_needs_a_bin_width(write: Write) -> None:
    path = write("a.sdt", sdt_bytes(CUBE, range_s=0.0))
    with pytest.raises(CaptureError, match=r"bin width of block 0 = 0\.0 .*bin_width_s"):
        read_capture(path)
    assert read_capture(path, bin_width_s=1e-9).acquisition.bin_width_s == 1e-9


# -- TMF8820 ------------------------------------------------------------------------------------


def records_with(**fields: Any) -> bytes:
    records = tmf8820_records(CUBE)
    records[1] |= fields
    return json.dumps(records).encode()


def test_tmf8820_pulse_and_truth(write: Write) -> None:
    records = tmf8820_records(CUBE)
    reference = [0, 3, 0, 10, 1000, 500, 20, 1]
    for k, record in enumerate(records):
        record["reference_hist"] = reference
        record["dist_to_plane"] = [0.1, None, 0.3][k]
    capture = read_capture(write("a.json", json.dumps(records).encode()), n_pulses=10**6)
    assert capture.pulse == Pulse.measured(3 * np.array(reference[3:]), 91e-12)
    # An echo from 0 m has its peak in the second sample, 1.1 ns after the first bin begins.
    assert capture.acquisition.gate_delay_s == pytest.approx(1.5 * 91e-12 - 1.1e-9)
    np.testing.assert_array_equal(
        capture.truth_range_m, np.repeat([[0.1], [np.nan], [0.3]], 4, axis=1)
    )
    assert capture.detection == "all"
    assert capture.source == (
        "a.json, 3 records, one in each row; "
        "guessed: bin width 91 ps, zero range 963.5 ps after the first bin"
    )


def test_tmf8820_record_is_a_square(write: Write) -> None:
    path = write("a.json", tmf8820_bytes(CUBE))
    capture = read_capture(path, variable="record 2")
    np.testing.assert_array_equal(capture.cube, CUBE[2].reshape(2, 2, 100))
    assert capture.source.startswith("a.json, record 2; ")
    row = read_capture(write("b.json", tmf8820_bytes(CUBE[:, :3])), variable="record 0")
    np.testing.assert_array_equal(row.cube, CUBE[:1, :3])
    for name in ("record 3", "record -1", "record", "zone 1", "record 0 1"):
        with pytest.raises(CaptureError, match=r"variable = .*'record 0' to 'record 2'"):
            read_capture(path, variable=name)


def test_tmf8820_records_are_added(write: Write) -> None:
    records = tmf8820_records(CUBE)
    for record, distance_m in zip(records, (0.1, 0.2, 0.2), strict=True):
        record["dist_to_plane"] = distance_m
        record["distances"] = [{"depths_1": [8, 9, 100, 0], "confs_1": [255, 255, 7, 0]}]
    records[2]["distances"][0]["depths_1"] = [10, 9, 101, 5]
    path = write("a.json", json.dumps(records).encode())
    capture = read_capture(path, records=(1, 2))
    np.testing.assert_array_equal(capture.cube, (CUBE[1] + CUBE[2]).reshape(2, 2, 100))
    assert capture.source.startswith("a.json, records 1 to 2 of 3 added; ")
    assert capture.n_records == read_capture(path).n_records == 3
    np.testing.assert_array_equal(capture.truth_range_m, np.full((2, 2), 0.2))
    np.testing.assert_allclose(capture.reported_range_m, [[0.009, 0.009], [0.1005, np.nan]])
    assert read_capture(path, records=(0, 1)).truth_range_m is None  # the plane moved
    one, same = read_capture(path, records=2), read_capture(path, variable="record 2")
    np.testing.assert_array_equal(one.cube, same.cube)
    assert one.source.startswith("a.json, record 2 of 3; ")
    with pytest.raises(CaptureError, match=r"records = 1 is not accepted: .*variable names"):
        read_capture(path, records=1, variable="record 1")
    rows = read_capture(path)
    assert rows.reported_range_m is not None and rows.shape == (3, 4)
    np.testing.assert_allclose(rows.reported_range_m[:2], [[0.008, 0.009, 0.1, np.nan]] * 2)


@pytest.mark.parametrize("pulse", [Pulse(1e-10), Pulse.gaussian(1e-10)])
def test_tmf8820_zero_range_follows_a_given_pulse(pulse: Pulse, write: Write) -> None:
    capture = read_capture(write("a.json", tmf8820_bytes(CUBE)), pulse=pulse)
    peak_s = pulse.tau_s if pulse.shape == "gamma" else 0.0
    assert capture.acquisition.gate_delay_s == pytest.approx(peak_s - 1.1e-9)


def test_tmf8820_ranges_of_a_real_sensor() -> None:
    """A plane at 5 to 400 mm: the middle zone within a bin, 13.6 mm, from where crosstalk ends."""
    capture = read_capture(real_capture_path("tmf8820_distance_data.json"))
    assert capture.cube.shape == (159, 9, 128) and capture.cube.dtype == np.uint32
    assert capture.truth_range_m is not None
    seen = capture.truth_range_m[:, 4] > 0.04
    for method in ("peak", "matched_filter", "likelihood"):
        error_m = (estimate(capture, method).range_m - capture.truth_range_m)[seen, 4]
        assert 0.004 < np.median(error_m) < 0.008
        assert np.all(np.abs(error_m) < 0.0182)
        assert error_m.std() < 0.0048


# -- TMF8829 ------------------------------------------------------------------------------------

PEAKS = (
    [{"distance": 4000, "snr": 9}, {"distance": 1500, "snr": 40}],
    [{"distance": 0, "snr": 0}],
    [],
    [{"snr": 5, "x": 1.0}],
)
RESULTS = [[{"noise": 1, "peaks": peaks} for peaks in PEAKS]] * 3


def log_with(configuration: Any = None, **of_records: Any) -> bytes:
    """A log of one record with the sample counts."""
    log = tmf8829_log(CUBE[np.newaxis], **of_records) | {"configuration": configuration}
    return json.dumps(log).encode()


def test_tmf8829_records_add_up_to_all(write: Write) -> None:
    path = write("a.json", tmf8829_bytes(CUBE, n_records=4))
    whole = read_capture(path)
    np.testing.assert_array_equal(whole.cube, CUBE)
    assert whole.source.startswith("a.json, variable mp_histo, all 4 records added; ")
    each = [read_capture(path, records=k) for k in range(4)]
    np.testing.assert_array_equal(sum(one.cube for one in each), CUBE)
    span = read_capture(path, records=(1, 3))
    np.testing.assert_array_equal(span.cube, CUBE - each[0].cube)
    assert span.source.startswith("a.json, variable mp_histo, records 1 to 3 of 4 added; ")
    assert {one.n_records for one in (whole, span, *each)} == {4}
    with pytest.raises(CaptureError, match=r"records = 4 is not accepted: give one of 0 to 3, "):
        read_capture(path, records=4)


def test_tmf8829_states_bins_pulse_and_ranges(write: Write) -> None:
    settings = {"bin_shift": 1, "ref_bin_shift": 2, "histogram_bins": 121, "select": 1}
    reference = [{"bin": [0, 3, 0, 10, 1000, 500, 20, 1]}] * 2
    content = log_with(settings, ref_histo=reference, results=RESULTS)
    capture = read_capture(write("a.json", content))
    np.testing.assert_array_equal(capture.cube, CUBE[:, :, :60])  # half of bin 60 is filled
    assert capture.acquisition.bin_width_s == pytest.approx(410e-12)
    assert capture.pulse == Pulse.measured([20, 2000, 1000, 40, 2], 820e-12)
    assert capture.acquisition.gate_delay_s == pytest.approx(-3 * 820e-12)  # as the pulse rises
    assert capture.detection == "all" and capture.acquisition.n_pulses is None
    np.testing.assert_array_equal(capture.reported_range_m, [[1.5, np.nan, np.nan, np.nan]] * 3)
    assert capture.truth_range_m is None
    in_bins = read_capture(write("b.json", log_with({"select": 0}, results=RESULTS)))
    others = read_capture(write("c.json", log_with(results=RESULTS[:2])))
    assert in_bins.reported_range_m is None and others.reported_range_m is None


def test_tmf8829_of_repeated_columns_is_one_row_of_zones(write: Write) -> None:
    cube = np.repeat(CUBE[:, :1], 3, axis=1)
    log = tmf8829_log(cube[np.newaxis], results=[row[:3] for row in RESULTS])
    capture = read_capture(write("a.json", json.dumps(log).encode()))
    np.testing.assert_array_equal(capture.cube, CUBE[np.newaxis, :, 0])
    np.testing.assert_array_equal(capture.reported_range_m, [[1.5, np.nan, np.nan]])
    assert "the first row of zones, which the log repeats in each column" in capture.source


def test_tmf8829_in_dual_mode_asks_for_the_histograms(write: Write) -> None:
    accurate = tmf8829_log(2 * CUBE[np.newaxis])["Result_Set"][0]["mp_histo"]
    path = write("a.json", log_with(mp_histo_HA=accurate))
    with pytest.raises(CaptureError, match="give mp_histo or mp_histo_HA") as caught:
        read_capture(path)
    assert list(caught.value.choices) == ["mp_histo", "mp_histo_HA"]
    np.testing.assert_array_equal(read_capture(path, variable="mp_histo_HA").cube, 2 * CUBE)


def test_tmf8829_log_of_a_real_sensor(tmp_path: Path) -> None:
    """Ranges of 26 records, added or one by one, within a bin (123 mm) of the sensor's own."""
    packed = real_capture_path("tmf8829_log.json.gz")
    plain = tmp_path / "tmf8829_log.json"
    plain.write_bytes(gzip.decompress(packed.read_bytes()))
    whole, first = read_capture(packed), read_capture(plain, records=(0, 12))
    assert whole.cube.shape == (1, 16, 54)  # 218 bins of the sensor, four in each
    assert whole.n_records == first.n_records == 26
    last, one = read_capture(packed, records=(13, 25)), read_capture(packed, records=7)
    np.testing.assert_array_equal(whole.cube, first.cube + last.cube)
    assert whole.acquisition == one.acquisition
    assert one.reported_range_m is not None
    error_m = (estimate(one, "likelihood").range_m - one.reported_range_m)[0]
    assert 0.01 < np.median(error_m) < 0.025
    assert np.all(np.abs(error_m) < 0.123)


# -- what must be refused -----------------------------------------------------------------------


def bomb_sdt(n_bytes: int, claimed: int) -> bytes:
    """A block that unpacks to more zeros than it claims."""
    packed = zipped(bytes(n_bytes), claims=claimed)
    content = sdt_bytes(CUBE, kind=IMAGE | COMPRESSED)
    begin = content.index(b"PK\x03\x04")
    plain = bytearray(content[:begin] + packed)
    plain[begin - 4 : begin] = claimed.to_bytes(4, "little")
    plain[begin - 16 : begin - 12] = (begin + len(packed)).to_bytes(4, "little")
    return bytes(plain)


def with_first_count(text: bytes) -> bytes:
    """The records with other text in place of a count."""
    return tmf8820_bytes(CUBE).replace(b"3", text, 1)


def with_references(*reference: Any) -> bytes:
    records = [record | {"reference_hist": reference} for record in tmf8820_records(CUBE)]
    return json.dumps(records).encode()


CIRCLE = sdt_bytes(CUBE, changes={"no_of_data_blocks": 30}, of_blocks={"next_block_offs": 200})
NESTED = b"[" * 20_000 + b"]" * 20_000

REFUSED: tuple[tuple[str, bytes, str], ...] = (
    ("a.ptu", bytes(500), "header cannot be read.*magic"),
    ("a.ptu", PTU[:-40], "TTResult_NumberOfRecords = 115 .*it holds 105"),
    (
        "a.ptu",
        ptu_with(ptu_with(PTU, "ImgHdr_PixX", 2**16), "ImgHdr_PixY", 2**16),
        "bytes of the image = 1717986918400 .*2,147,483,648",
    ),
    ("a.ptu", ptu_with(PTU, "ImgHdr_PixX", 2**62), "ImgHdr_PixX = 4611686018427387904 .*65,536"),
    ("a.ptu", ptu_with(PTU, "ImgHdr_PixY", -3), "PixY = -3"),
    ("a.ptu", ptu_with(PTU, "TTResult_NumberOfRecords", -1), "TTResult_NumberOfRecords = -1"),
    ("a.ptu", ptu_with(PTU, "ImgHdr_LineStop", 2**40), "ImgHdr_LineStop = 1099511627776 .*1 to 8"),
    ("a.ptu", ptu_with(PTU, "MeasDesc_Resolution", np.nan), "MeasDesc_Resolution = nan"),
    ("a.ptu", ptu_with(PTU, "MeasDesc_Resolution", -1e-9), "MeasDesc_Resolution = -1e-09"),
    ("a.ptu", ptu_with(PTU, "MeasDesc_GlobalResolution", 1e300), r"Resolution = 1e\+309|inf"),
    ("a.ptu", ptu_with(PTU, "Measurement_Mode", 2), "Mode = 2 .*T3"),
    ("a.ptu", ptu_with(PTU, "Measurement_SubMode", 1), "SubMode = 1"),
    ("a.ptu", ptu_with(PTU, "ImgHdr_SinCorrection", 80), "ImgHdr_SinCorrection = 80 "),
    ("a.ptu", ptu_with(PTU, "TTResultFormat_TTTRRecType", 7), "records cannot be read"),
    ("a.sdt", sdt_bytes(CUBE)[:-10], "blocks cannot be read"),
    ("a.sdt", CIRCLE, "blocks cannot be read"),
    ("a.sdt", sdt_bytes(CUBE, of_blocks={"block_length": 2**32 - 2}), "cannot be read"),
    ("a.sdt", bomb_sdt(2**24, 2400), "blocks cannot be read"),
    ("a.sdt", sdt_bytes(CUBE, kind=FCS | 0x01), "variable = None .*file has none"),
    ("a.sdt", sdt_bytes(CUBE, of_measurement={"adc_re": 7}), r"shape of block 0 = \(1200,\)"),
    ("a.sdt", sdt_bytes(CUBE, of_blocks={"meas_desc_block_no": 5}), "blocks cannot be read"),
    ("a.json", b"record", "list of records.*damaged"),
    ("a.json", b'{"hists": []}', "Result_Set = 'NoneType'.*a list of records"),
    ("a.json", b'{"Result_Set": []}', "records = 0"),
    ("a.json", b'{"Result_Set": [1]}', "record 0 = 'int'"),
    ("a.json", b'{"Result_Set": [{}]}', "variable = None.*histograms.*none in its first record"),
    ("a.json", b'{"Result_Set": [{"mp_histo": 1}]}', "mp_histo of record 0 = "),
    ("a.json", b'{"Result_Set": [{"mp_histo": [[{"bin": ["1"]}]]}]}', "mp_histo of record 0"),
    ("a.json", b'{"Result_Set": [{"mp_histo": ' + NESTED + b"}]}", "the log.*RecursionError"),
    ("a.json", tmf8829_bytes(CUBE).replace(b"[2, ", b"[-2, ", 1), "mp_histo = -2"),
    ("a.json", log_with({"bin_shift": 9}), "bin_shift = 9 .*0 to 3"),
    ("a.json", log_with({"histogram_bins": 3}), "histogram_bins = 3 .*give 4, one bin"),
    ("a.json", log_with(results=[[{"peaks": [{"distance": -1}]}]]), "distance of a peak = -1"),
    ("a.json", log_with(ref_histo=[{"bin": [0, 0]}]), "ref_histo = 0.0 .*not all 0"),
    ("a.json", b"[]", "records = 0"),
    ("a.json", b'[{"hist": 1}]', "record 0 = 'dict'.*hists"),
    ("a.json", b'[{"hists": ' + NESTED + b"}]", "list of records.*RecursionError"),
    ("a.json", records_with(dist_to_plane=np.nan), "NaN is no number"),
    ("a.json", records_with(dist_to_plane=-0.1), "dist_to_plane of record 1 = -0.1"),
    ("a.json", records_with(dist_to_plane="far"), "dist_to_plane of record 1 = 'far'"),
    ("a.json", with_first_count(b"1e999"), "hists = inf"),
    ("a.json", with_first_count(b"-3"), "hists = -3"),
    ("a.json", with_first_count(b"3.5"), "hists = 3.5"),
    ("a.json", with_first_count(b"3" * 5000), "list of records.*digits"),
    ("a.json", with_first_count(b"3" * 30), "hists of record 0 = 'object array"),
    ("a.json", with_first_count(b'"%s"' % (b"3" * 100_000)), "hists of record 0 = 'object array"),
    ("a.json", records_with(hists=[[1, 2], [1]]), r"hists of record 1 = .*\(2,\)"),
    (
        "a.json",
        records_with(hists=[[0] * 100] * 3),
        r"shape of hists of record 1 = \(3, 100\) .*\(4, 100\)",
    ),
    ("a.json", records_with(reference_hist=[1, 2]), "reference_hist of record 0 = 'object"),
    ("a.json", with_references(0, 0, 0), "reference_hist = 0.0 .*not all 0"),
    ("a.json", with_references(1, -1, 0), "reference_hist = -1 .*0 or more"),
)


@pytest.mark.filterwarnings("ignore:.*encountered in:RuntimeWarning")
@pytest.mark.parametrize(("name", "content", "message"), REFUSED, ids=[each[2] for each in REFUSED])
def test_refused(name: str, content: bytes, message: str, write: Write) -> None:
    path = write(name, content)
    assert_refused(read_capture, path, message, CaptureError, 2**20 + 10 * len(content))


values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=3),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner),
    max_leaves=6,
)
counts = st.lists(st.lists(st.integers(-1, 9) | values, max_size=4), max_size=4)
fields = st.fixed_dictionaries(
    {"hists": counts | values},
    optional={"reference_hist": st.lists(st.integers(0, 9)) | values, "dist_to_plane": values},
)


@settings(max_examples=100)
@given(st.lists(fields | values, max_size=3) | values)
def test_any_json_is_read_or_refused(tmp_path_factory: Any, records: Any) -> None:
    require_read_or_refused(tmp_path_factory, records)


histograms = st.lists(st.lists(st.fixed_dictionaries({"bin": counts | values}) | values))
log_fields = st.fixed_dictionaries(
    {"mp_histo": histograms | values},
    optional={"ref_histo": histograms | values, "results": histograms | values},
)


@given(st.lists(log_fields | values, max_size=3) | values, values)
def test_any_log_is_read_or_refused(tmp_path_factory: Any, records: Any, settings: Any) -> None:
    require_read_or_refused(tmp_path_factory, {"Result_Set": records, "configuration": settings})


def require_read_or_refused(tmp_path_factory: Any, content: Any) -> None:
    path = tmp_path_factory.mktemp("json") / "any.json"
    path.write_text(json.dumps(content))
    try:
        assert read_capture(path).cube.ndim == 3
    except CaptureError as error:
        assert str(error).startswith("any.json: ")
