"""Fields that both layouts of this project share, `core.io.readers.npz` and `labelled`.

They are the arrays of an archive, or the attributes of an array of counts. Files of other layouts
may state fluxes of their pixels under the names of `STATED`, the number of pulses under those of
`PULSES`, and bin width and gate delay with a unit in the name, such as ``bin_width_ps``. A number
named like a bin width without a unit is taken as seconds if that is plausible, as a guess.
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

_TIMES = {
    "bin_width_s": ("binwidth", "binsize", "binresolution", "timeresolution", "resolution"),
    "gate_delay_s": ("gatedelay", "gatestart", "gateopening"),
}
"""Names of times, likewise, to which a file may add the unit."""

_WITH_UNIT = {
    f"{name}{unit}": (field, unit)
    for field, names in _TIMES.items()
    for name in names
    for unit in UNITS_S
}
_WITHOUT_UNIT = {name: field for field, names in _TIMES.items() for name in names}
_PLAUSIBLE_WIDTHS_S = 1e-13, 1e-6
_SAME = 1e-6  # relative difference of two statements, such as one in single precision

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
    if request.detection is None and "detection" in known:
        values["detection"] = known["detection"]
    left = [name for name in TIMING if getattr(request, name) is None]
    for name, stated in _stated(known, left).items():
        values[name] = _agreed(name, stated)
    if (n_pulses := values.get("n_pulses")) is not None:
        whole = n_pulses.is_integer() and n_pulses >= 0
        require("n_pulses", n_pulses, whole, "a whole number, 0 if not known")
        values["n_pulses"] = int(n_pulses) or None
    if request.pulse is None and any(name in known for name in PULSE):
        values["pulse"] = _pulse(known)
    return replace(request, **values)


def timing(names: Iterable[str]) -> list[str]:
    """Return the names of `TIMING` among those of a file, and other names of the same numbers."""
    others = {*PULSES, *_WITH_UNIT, *_WITHOUT_UNIT}
    return [name for name in names if name in TIMING or _plain(name) in others]


def without_unit(request: ReadOptions, known: Mapping[str, Any]) -> tuple[float | None, list[str]]:
    """Return the bin width that numbers without a unit give, and what is left out of these.

    Parameters
    ----------
    request : ReadOptions
        As `completed` returns it.
    known : mapping
        Numbers of the file.

    Returns
    -------
    bin_width_s : float or None
        The only number that is plausible in seconds; None if it is known already, or there is none.
    left_out : list of str
        Numbers whose unit would be needed.
    """
    stated: dict[str, dict[str, float]] = {}
    for name in known:
        field, value = _WITHOUT_UNIT.get(_plain(name), ""), _real(known[name])
        if field and value is not None and getattr(request, field) is None:
            stated.setdefault(field, {})[name] = value
    low_s, high_s = _PLAUSIBLE_WIDTHS_S
    widths_s = {each for each in stated.get("bin_width_s", {}).values() if low_s <= each <= high_s}
    if len(widths_s) == 1:
        del stated["bin_width_s"]
    left_out = [
        f"{name} = {value:g}, without a unit, left out"
        for values in stated.values()
        for name, value in values.items()
    ]
    return widths_s.pop() if len(widths_s) == 1 else None, left_out


def _stated(known: Mapping[str, Any], timing: Iterable[str]) -> dict[str, dict[str, float]]:
    """Return what a file states for some fields of `TIMING`, by the file's own names."""
    found: dict[str, dict[str, float]] = {}
    for name in timing:
        if (value := number(known, name)) is not None and (name, value) != ("n_pulses", 0):
            found[name] = {name: value}
    for name in known:
        value, plain = _real(known[name]), _plain(name)
        if name in TIMING or value is None:
            continue
        if plain in PULSES and value.is_integer() and 1 <= value <= MOST_PULSES:
            found.setdefault("n_pulses", {})[name] = value
        elif plain in _WITH_UNIT and (value or plain.startswith("gate")):
            field, unit = _WITH_UNIT[plain]
            found.setdefault(field, {})[name] = parsed_time(f"{value!r} {unit}")
    return {name: found[name] for name in timing if name in found}


def _agreed(field: str, stated: Mapping[str, float]) -> float:
    """Return the value of which all statements are; raise ``ValueError`` if they contradict."""
    values = list(stated.values())
    agree = len(values) == 1 or max(values) - min(values) <= _SAME * max(map(abs, values))
    shown = ", ".join(f"{value:.6g} by {name}" for name, value in stated.items())
    require(field, shown, agree, f"{field}, of which the file states several")
    return values[0]


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
