"""Elementary functions in float32 that the compiler can vectorise, unlike those of `math`.

Polynomials are those of the Cephes library (Moshier 1989), right to two units in the last place.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from core.kernels.parallel import COMPILED

_ZERO, _HALF, _ONE = np.float32(0.0), np.float32(0.5), np.float32(1.0)
_LEAST = np.float32(-87.0)  # of an exponential that is a normal number
_INTEGER = np.float32(1.5 * 2**23)  # added to a small number, rounds it to an integer
_PER_LN_2 = np.float32(1 / np.log(2))
_LN_2_HIGH, _LN_2_LOW = np.float32(0.693359375), np.float32(-2.12194440e-4)
_BIAS, _EXPONENT = np.int32(127), np.int32(23)  # of a float32
_ROOT_HALF = np.int32(0x3F3504F3)  # its bits
_E0, _E1, _E2, _E3, _E4, _E5 = (
    np.float32(each)
    for each in (1.9875691500e-4, 1.3981999507e-3, 8.3334519073e-3, 4.1665795894e-2,
                 1.6666665459e-1, 5.0000001201e-1)
)  # fmt: skip
_L0, _L1, _L2, _L3, _L4, _L5, _L6, _L7, _L8 = (
    np.float32(each)
    for each in (7.0376836292e-2, -1.1514610310e-1, 1.1676998740e-1, -1.2420140846e-1,
                 1.4249322787e-1, -1.6668057665e-1, 2.0000714765e-1, -2.4999993993e-1,
                 3.3333331174e-1)
)  # fmt: skip


@njit(**COMPILED, inline="always")
def exp32(x):  # type: ignore[no-untyped-def]
    """Exponential of a number that is not positive; 0 below -87."""
    y = x if x > _LEAST else _LEAST
    # The last bits of the sum are the exponent of the power of two.
    shifted = np.float32(y * _PER_LN_2 + _INTEGER)
    n = shifted - _INTEGER
    r = y - n * _LN_2_HIGH - n * _LN_2_LOW
    p = ((((_E0 * r + _E1) * r + _E2) * r + _E3) * r + _E4) * r + _E5
    power = np.int32((shifted.view(np.int32) + _BIAS) << _EXPONENT)
    return (p * r * r + r + _ONE) * power.view(np.float32) if x > _LEAST else _ZERO


@njit(**COMPILED, inline="always")
def log1p32(x):  # type: ignore[no-untyped-def]
    """Logarithm of 1 plus a finite number that is not negative."""
    u = np.float32(_ONE + x)
    bits = np.int32(u.view(np.int32) - _ROOT_HALF)
    exponent = np.int32(bits >> _EXPONENT)
    mantissa = np.int32(u.view(np.int32) - (exponent << _EXPONENT))
    f = mantissa.view(np.float32) - _ONE
    p = (((((((_L0 * f + _L1) * f + _L2) * f + _L3) * f + _L4) * f + _L5) * f + _L6) * f + _L7) * f
    n = np.float32(exponent)
    low = (p + _L8) * f * f * f + n * _LN_2_LOW - _HALF * f * f
    # What rounding 1 + x has lost.
    return low + f + n * _LN_2_HIGH + (x - (u - _ONE)) / u
