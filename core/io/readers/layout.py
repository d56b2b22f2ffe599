"""Fields that both layouts of this project share, `core.io.readers.npz` and `labelled`.

They are the arrays of an archive, or the attributes of an array of counts. Files of other layouts
may state fluxes of their pixels under the names of `STATED`, the number of pulses under those of
`PULSES`, and a bin width with its unit in the name, such as ``bin_width_ps``.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from core.acquisition import MOST_PULSES, SHORTEST_PULSE_S, Acquisition, Pulse, require_time
from core.capture import StatedFlux
from core.checks import require
from core.io.readers.options import ReadOptions
from core.io.readers.quantities import UNITS_S, parsed_time, time_text

TIMING = ("bin_width_s", "gate_delay_s", "pixel_angle_rad", "n_pulses")
"""Fields that are one number each. Files of other layouts may state them under these names, too."""

PULSES = (
    "npulses",
    "numpulses",
    "numberofpulses",
    "pulses",
    "pulsesperpixel",
    "nshots",
    "numshots",
    "numberofshots",
    "shots",
    "shotsperpixel",
)
"""Other names of ``n_pulses``, as those of `STATED`. Frames, cycles and exposures may each hold any
number of pulses."""

_BIN_WIDTHS = {f"{name}{unit}": unit for name in ("binwidth", "binsize") for unit in UNITS_S}

PULSE = ("pulse_shape", "pulse_tau_s", "pulse_samples")
"""Fields that define a pulse together."""

STATED = {
    "signal": ("meansignalphotons", "meansigdetect", "signalphotons", "signalppp", "sigppp"),
    "background": (
        "meanbackgroundphotons",
        "meannoisephotons",
        "backgroundphotons",
        "backgroundppp",
        "bgppp",
        "noiseppp",
    ),
    "sbr": ("sbr", "meansbr", "signaltobackgroundratio"),
}
"""Names of numbers that state each field of `StatedFlux`, in lower case without underscores; the
project's own layouts prefix the field with ``stated_``."""

_MOST_SAMPLES = 2**20
_MOST_SAMPLES_BEYOND_GATE = 2**16


def completed(request: ReadOptions, known: Mapping[str, Any]) -> ReadOptions:
    """Return a request with the fields of a file where the user specifies nothing.

    Raises
    ------
    ValueError
        If a field is invalid.
    """
    values: dict[str, Any] = {}
    for name in (*TIMING, "detection"):
        if getattr(request, name) is None and name in known:
            values[name] = known[name] if name == "detection" else number(known, name)
    for name, value in _by_other_names(known).items():
        if getattr(request, name) is None:
            values.setdefault(name, value)
    if "n_pulses" in values:
        n_pulses = values["n_pulses"]
        whole = n_pulses.is_integer() and n_pulses >= 0
        require("n_pulses", n_pulses, whole, "a whole number, 0 if not known")
        values["n_pulses"] = int(n_pulses) or None
    if request.pulse is None and any(name in known for name in PULSE):
        values["pulse"] = _pulse(known)
    return replace(request, **values)


def timing(names: Iterable[str]) -> list[str]:
    """Return the names of `TIMING` among those of a file, and other names of the same numbers."""
    return [name for name in names if name in TIMING or _plain(name) in (*PULSES, *_BIN_WIDTHS)]


def _by_other_names(known: Mapping[str, Any]) -> dict[str, float]:
    """Return pulses and bin width by their names in `TIMING`; none that is stated in two ways."""
    found: dict[str, set[float]] = {"n_pulses": set(), "bin_width_s": set()}
    for name in known:
        value, plain = _real(known[name]), _plain(name)
        if plain in PULSES and value and value.is_integer() and 1 <= value <= MOST_PULSES:
            found["n_pulses"].add(value)
        elif plain in _BIN_WIDTHS and value:
            found["bin_width_s"].add(parsed_time(f"{value!r} {_BIN_WIDTHS[plain]}"))
    return {name: values.pop() for name, values in found.items() if len(values) == 1}


def _real(given: Any) -> float | None:
    """Return one finite number of at least 0; None for anything else."""
    value = np.asarray(given)
    fits = value.size == 1 and value.dtype.kind in "iuf" and 0 <= value.item() < np.inf
    return float(value.item()) if fits else None


def _plain(name: str) -> str:
    return name.lower().replace("_", "")


def stating(names: Iterable[str]) -> list[str]:
    """Return the names of `STATED` among those of a file."""
    return [name for name in names if _stated_field(name) is not None]


def stated_flux(known: Mapping[str, Any]) -> StatedFlux | None:
    """Return the fluxes that the numbers of a file state; None if there are none.

    Anything but a single finite number of at least 0 is ignored.
    """
    found: dict[str, float] = {}
    for name in stating(known):
        if (value := _real(known[name])) is not None:
            found.setdefault(str(_stated_field(name)), value)
    return StatedFlux(**found) if found else None


def _stated_field(name: str) -> str | None:
    plain = _plain(name)
    known = (field for field, names in STATED.items() if plain in (*names, f"stated{field}"))
    return next(known, None)


def number(known: Mapping[Any, Any], name: str) -> float | None:
    """Return a field that must be one number; None where it is absent."""
    if name not in known:
        return None
    value = np.asarray(known[name])
    real = value.size == 1 and value.dtype.kind in "iuf"
    require(name, known[name], real, "one number")
    return float(value.item())


def _pulse(known: Mapping[str, Any]) -> Pulse:
    tau_s = number(known, "pulse_tau_s")
    if tau_s is None:
        raise ValueError("pulse_tau_s = None is not accepted: give a time with the shape.")
    require_time("pulse_tau_s", tau_s, SHORTEST_PULSE_S)
    samples = np.asarray(known.get("pulse_samples", ()))
    real = samples.dtype.kind in "biuf"
    require("pulse_samples", known.get("pulse_samples"), real, "real numbers")
    fits = samples.size <= _MOST_SAMPLES
    require("pulse_samples", f"{samples.size:,} of them", fits, f"up to {_MOST_SAMPLES:,}")
    shape: Any = str(known.get("pulse_shape", "gamma"))
    return Pulse(tau_s, shape=shape, samples=tuple(samples.astype(float).ravel().tolist()))


def require_pulse_in_gate(pulse: Pulse, acquisition: Acquisition) -> None:
    """Raise ``ValueError`` if a file's pulse has many samples and lasts longer than the gate."""
    n_samples = len(pulse.samples)
    length_s, gate_s = n_samples * pulse.tau_s, acquisition.n_bins * acquisition.bin_width_s
    require(
        "pulse_samples",
        f"{n_samples:,} of them, {time_text(length_s)}",
        n_samples <= _MOST_SAMPLES_BEYOND_GATE or length_s <= gate_s,
        f"up to {_MOST_SAMPLES_BEYOND_GATE:,}, or no more than last {time_text(gate_s)}, the gate",
    )


def require_image(name: str, found: tuple[int, ...], shape: tuple[int, ...]) -> None:
    """Raise ``ValueError`` unless an image has the cube's rows and columns."""
    require(name, f"shape {found}", found == shape, f"shape {shape}, that of the cube")
