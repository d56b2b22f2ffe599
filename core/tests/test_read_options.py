"""Options for reading a file: all interfaces follow from the fields of `core.io.ReadOptions`."""

from __future__ import annotations

import argparse
import inspect
from dataclasses import fields

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import core
from core.io import (
    ReadOptions,
    add_read_options,
    read_options_from,
    reading_options,
    with_flags,
)
from core.io.readers.quantities import angle_as_typed, parsed_angle, parsed_time, time_as_typed
from core.tests.read_options import EXAMPLES

NAMES = [each.name for each in fields(ReadOptions)]


def test_each_field_has_an_example_a_flag_a_label_and_a_sentence_of_help() -> None:
    assert list(EXAMPLES) == NAMES == list(reading_options())
    options = reading_options().values()
    assert len({option.flag for option in options}) == len({option.label for option in options})
    for option in options:
        assert option.label
        assert option.help.endswith(".")


@pytest.mark.parametrize("name", NAMES)
def test_a_value_is_parsed_from_the_text_it_is_written_as(name: str) -> None:
    given = ReadOptions(**{name: EXAMPLES[name]})
    assert given.as_text(name)
    assert ReadOptions.from_text({name: f" {given.as_text(name)} "}) == given
    assert ReadOptions.from_text({name: " "}) == ReadOptions()


@pytest.mark.parametrize("function", [core.read_capture, core.open_capture])
def test_functions_document_each_field(function: object) -> None:
    assert list(inspect.signature(function).parameters) == ["path", *NAMES]  # type: ignore[arg-type]
    text = inspect.getdoc(function) or ""
    assert [name for name in NAMES if f"\n{name} : " not in text] == []


def test_the_command_line_has_an_option_for_each_field() -> None:
    parser, all_of_them = argparse.ArgumentParser(), ReadOptions(**EXAMPLES)
    add_read_options(parser)
    arguments = []
    for name, option in reading_options().items():
        text = all_of_them.as_text(name)
        parts = [text] if not option.kind.metavars else text.split(" x ")
        arguments += (
            [f"--{option.flag}={text}"] if len(parts) == 1 else [f"--{option.flag}", *parts]
        )
    assert read_options_from(parser.parse_args(arguments)) == all_of_them
    assert read_options_from(parser.parse_args([])) == ReadOptions()


@pytest.mark.parametrize("name", [name for name in NAMES if name not in ("variable", "axes")])
def test_text_that_is_no_value_is_refused(name: str) -> None:
    with pytest.raises(ValueError, match=f"^{name} = 'x, y' is not accepted"):
        ReadOptions.from_text({name: "x, y"})


def test_unknown_options_are_refused() -> None:
    with pytest.raises(TypeError, match="bin_width"):
        core.read_capture("x.npz", bin_width=1e-9)


@pytest.mark.parametrize(
    ("text", "expected_s"),
    [("64ps", 64e-12), ("4.43 us", 4.43e-6), ("1e-9", 1e-9), ("0.5ns", 5e-10), ("2µs", 2e-6)],
)
def test_times_carry_units(text: str, expected_s: float) -> None:
    assert parsed_time(text) == pytest.approx(expected_s, rel=1e-12)


@pytest.mark.parametrize(
    ("text", "expected_rad"),
    [
        ("20urad", 2e-5),
        ("20 µrad", 2e-5),
        ("20 μrad", 2e-5),  # the Greek letter, as keyboards have it
        ("1.5 mrad", 1.5e-3),
        ("2e-5", 2e-5),
        ("0.01 deg", np.radians(0.01)),
        ("0.01°", np.radians(0.01)),
        ("0.5rad", 0.5),
    ],
)
def test_angles_carry_units(text: str, expected_rad: float) -> None:
    assert parsed_angle(text) == pytest.approx(expected_rad, rel=1e-12)


@pytest.mark.parametrize("text", ["", "urad", "20 ps", "20 Urad", "1 rad rad", "one rad"])
def test_text_that_is_no_angle_is_refused(text: str) -> None:
    with pytest.raises(ValueError):
        parsed_angle(text)


@given(st.floats(1e-13, 0.5))
def test_quantities_are_written_as_text_that_means_the_same(value: float) -> None:
    assert parsed_time(time_as_typed(value)) == value
    assert parsed_time(time_as_typed(-value)) == -value
    assert parsed_angle(angle_as_typed(value)) == value


def test_quantities_are_written_with_a_suitable_unit() -> None:
    assert [time_as_typed(t) for t in (64e-12, 1e-9, 2.8e-7, -1e-9)] == [
        "64 ps",
        "1 ns",
        "280 ns",
        "-1 ns",
    ]
    assert [angle_as_typed(a) for a in (2e-5, 1.5e-3)] == ["20 µrad", "1.5 mrad"]


@pytest.mark.parametrize("text", ["", "ps", "64 pc", "1e-9 s s", "one ns", "64Ps", "64", "1\n2"])
def test_text_that_is_no_time_is_refused(text: str) -> None:
    with pytest.raises(ValueError):
        parsed_time(text)


def test_options_are_named_as_on_the_command_line_and_arrays_as_in_the_file() -> None:
    message = "variable = None is not accepted: give bin_width_s; the file has bin_width_s, counts."
    expected = "--variable is missing: give --bin-width; the file has bin_width_s, counts."
    assert with_flags(message) == expected
