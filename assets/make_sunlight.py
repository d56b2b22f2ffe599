"""Write ``sunlight.npz``: the spectrum of the sun at the ground.

``python assets/make_sunlight.py ASTMG173.csv`` writes it beside this file. The CSV file has the
columns wavelength (nm), extraterrestrial, global and direct irradiance (W/m²/nm) of ASTM G173-03,
as pvlib distributes it (``pvlib/data/ASTMG173.csv``). Of the global one, on a surface tilted by 37°
under an air mass of 1.5, 400 to 1700 nm are kept.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np


def main(path: str) -> None:
    """Write the file from the CSV file at a path."""
    table = np.genfromtxt(path, delimiter=",", skip_header=2)
    wavelength_nm, irradiance = table[:, 0], table[:, 2]
    kept = (wavelength_nm >= 400) & (wavelength_nm <= 1700)
    np.savez_compressed(
        Path(__file__).with_name("sunlight.npz"),
        wavelength_nm=wavelength_nm[kept].astype(np.float32),
        irradiance_w_m2_nm=irradiance[kept].astype(np.float32),
    )


if __name__ == "__main__":
    main(sys.argv[1])
