"""Counter-based randomness: every draw is a pure function of (seed, stream, counter).

Philox4x32-10 of Salmon et al., "Parallel random numbers: as easy as 1, 2, 3", SC 2011. The seed is
the key, (counter, stream) the 128-bit counter; all are 64-bit integers, negative ones wrap. Two
draws with equal arguments share one block of random bits, whatever their distribution, so each
purpose needs a stream of its own.
"""

from __future__ import annotations

import math

import numpy as np

from vibrissa.compilation import inlined
from vibrissa.elementary import log

# Numerator and denominator of the normal quantile in its centre, flank and far tail: algorithm
# AS 241 (PPND16) of M. J. Wichura, Applied Statistics 37 (1988) 477-484.
_CENTRE = (
    (
        3.3871328727963666080,
        133.14166789178437745,
        1971.5909503065514427,
        13731.693765509461125,
        45921.953931549871457,
        67265.770927008700853,
        33430.575583588128105,
        2509.0809287301226727,
    ),
    (
        1.0,
        42.313330701600911252,
        687.18700749205790830,
        5394.1960214247511077,
        21213.794301586595867,
        39307.895800092710610,
        28729.085735721942674,
        5226.4952788528545610,
    ),
)
_FLANK = (
    (
        1.42343711074968357734,
        4.63033784615654529590,
        5.76949722146069140550,
        3.64784832476320460504,
        1.27045825245236838258,
        0.241780725177450611770,
        0.0227238449892691845833,
        7.74545014278341407640e-4,
    ),
    (
        1.0,
        2.05319162663775882187,
        1.67638483018380384940,
        0.689767334985100004550,
        0.148103976427480074590,
        0.0151986665636164571966,
        5.47593808499534494600e-4,
        1.05075007164441684324e-9,
    ),
)
_TAIL = (
    (
        6.65790464350110377720,
        5.46378491116411436990,
        1.78482653991729133580,
        0.296560571828504891230,
        0.0265321895265761230930,
        0.00124266094738807843860,
        2.71155556874348757815e-5,
        2.01033439929228813265e-7,
    ),
    (
        1.0,
        0.599832206555887937690,
        0.136929880922735805310,
        0.0148753612908506148525,
        7.86869131145613259100e-4,
        1.84631831751005468180e-5,
        1.42151175831644588870e-7,
        2.04426310338993978564e-15,
    ),
)


@inlined
def philox4x32(
    c0: int, c1: int, c2: int, c3: int, k0: int, k1: int
) -> tuple[np.int64, np.int64, np.int64, np.int64]:
    """Four random 32-bit words for a counter of four such words and a key of two."""
    mask = np.uint64(0xFFFFFFFF)
    half = np.uint64(32)
    x0, x1 = np.uint64(c0) & mask, np.uint64(c1) & mask
    x2, x3 = np.uint64(c2) & mask, np.uint64(c3) & mask
    key0, key1 = np.uint64(k0) & mask, np.uint64(k1) & mask
    for _ in range(10):
        p0 = np.uint64(0xD2511F53) * x0
        p1 = np.uint64(0xCD9E8D57) * x2
        x0, x1 = (p1 >> half) ^ x1 ^ key0, p1 & mask
        x2, x3 = (p0 >> half) ^ x3 ^ key1, p0 & mask
        key0 = (key0 + np.uint64(0x9E3779B9)) & mask
        key1 = (key1 + np.uint64(0xBB67AE85)) & mask
    return np.int64(x0), np.int64(x1), np.int64(x2), np.int64(x3)


@inlined
def _block(seed: int, stream: int, counter: int) -> tuple[np.int64, np.int64, np.int64, np.int64]:
    return philox4x32(counter, counter >> 32, stream, stream >> 32, seed, seed >> 32)


@inlined
def philox_uniform(seed: int, stream: int, counter: int) -> float:
    """Uniform in the open interval (0, 1), in steps of 2^-52."""
    w0, w1, _, _ = _block(seed, stream, counter)
    return (float((w0 << 20) | (w1 >> 12)) + 0.5) * 2.0**-52


@inlined
def _horner8(c: tuple[float, ...], r: float) -> float:
    high = ((c[7] * r + c[6]) * r + c[5]) * r + c[4]
    return (((high * r + c[3]) * r + c[2]) * r + c[1]) * r + c[0]


@inlined
def normal_quantile(p: float) -> float:
    """The z that a standard normal variable stays below with probability p, 0 < p < 1."""
    q = p - 0.5
    if abs(q) <= 0.425:
        r = 0.180625 - q * q
        return q * (_horner8(_CENTRE[0], r) / _horner8(_CENTRE[1], r))
    r = math.sqrt(-log(min(p, 1.0 - p)))
    if r <= 5.0:
        z = _horner8(_FLANK[0], r - 1.6) / _horner8(_FLANK[1], r - 1.6)
    else:
        z = _horner8(_TAIL[0], r - 5.0) / _horner8(_TAIL[1], r - 5.0)
    return -z if q < 0.0 else z


@inlined
def philox_normal(seed: int, stream: int, counter: int) -> float:
    """Standard normal, |z| < 8.3."""
    return normal_quantile(philox_uniform(seed, stream, counter))


@inlined
def philox_normals4(seed: int, stream: int, counter: int) -> tuple[float, float, float, float]:
    """Four independent standard normals from one block, of 2^32 values each, |z| < 6.4."""
    w0, w1, w2, w3 = _block(seed, stream, counter)
    return (
        normal_quantile((float(w0) + 0.5) * 2.0**-32),
        normal_quantile((float(w1) + 0.5) * 2.0**-32),
        normal_quantile((float(w2) + 0.5) * 2.0**-32),
        normal_quantile((float(w3) + 0.5) * 2.0**-32),
    )
