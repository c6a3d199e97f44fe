"""Elementary functions whose bits depend on neither the machine nor its libraries.

The C library picks its code by CPU type, and the results differ in the last place. These use only
operations that IEEE 754 rounds exactly (+ - * / sqrt), integer arithmetic on the bits, and no fused
multiply-add, so they give the same bits on every x86-64 machine, one at a time or in a vectorised
loop. Results are at most 1 ulp off. Where no result exists it is the same NaN for every argument.

Coefficients and the splittings of pi and ln 2: docs/derivations/elementary_functions.py.
"TwoSum" and "Fast2Sum" (exact error of a sum) and Dekker's exact product are in Muller et al.,
Handbook of Floating-Point Arithmetic, chapter 4.
"""

from __future__ import annotations

import math

import numpy as np

from vibrissa.compilation import inlined

# Adding this to |v| < 2^51 rounds v to an integer and leaves that in the lowest bits of the sum.
_ROUND = 6755399441055744.0  # 1.5 * 2^52
_ROUND_BITS = 0x4338000000000000
_BIAS = 1023
_SPLIT = 134217729.0  # 2^27 + 1, cuts a double into halves whose products are exact

MAX_ANGLE = 2.0**27  # of sin and cos, rad

_2_PI = 0.6366197723675814
_TURN = 6.283185307179586
_PI_2 = (1.5707963109016418, 1.5893254712295857e-08, 6.123233932053594e-17, 6.36831716351095e-25)
_PI_4 = (0.7853981633974483, 3.061616997868383e-17)
_PI3_4 = (2.356194490192345, 9.184850993605148e-17)
_TAN_PI_8 = 0.41421356237309503

_SIN = (
    -0.1666666666666663,
    0.00833333333332184,
    -0.00019841269829358352,
    2.755731353840044e-06,
    -2.505073436508143e-08,
    1.5895431608359292e-10,
)
_COS = (
    0.041666666666666595,
    -0.0013888888888873342,
    2.480158728900239e-05,
    -2.75573142171478e-07,
    2.0875705412101474e-09,
    -1.1358750099944116e-11,
)

_1_LN2 = 1.4426950408889634
_LN2 = (0.6931471805598903, 5.497923018708371e-14)
_SQRT_HALF_BITS = 0x3FE6A09E667F3BCD

_EXP = (
    0.5,
    0.16666666666666688,
    0.041666666666666845,
    0.008333333333312983,
    0.0013888888888757163,
    0.00019841269906191604,
    2.4801587629895937e-05,
    2.755722530585846e-06,
    2.7556978729471293e-07,
    2.5115280058100756e-08,
    2.1014336272794105e-09,
)
_LOG = (
    0.6666666666666734,
    0.39999999999417063,
    0.285714287418868,
    0.22222198622258485,
    0.18183561874470772,
    0.15314111110042938,
    0.14795362840411302,
)
_ATAN = (
    -0.333333333333332,
    0.1999999999995368,
    -0.14285714280200798,
    0.1111111078357903,
    -0.09090897760528906,
    0.0769206027109241,
    -0.06663104853344459,
    0.05847896659074779,
    -0.050393451943846784,
    0.038065782225052976,
    -0.017908758996378258,
)


@inlined
def _bits(x: float) -> np.int64:
    return np.float64(x).view(np.int64)


@inlined
def _from_bits(b: int | np.int64) -> float:
    return np.int64(b).view(np.float64)


@inlined
def _horner6(c: tuple[float, ...], z: float) -> float:
    return ((((c[5] * z + c[4]) * z + c[3]) * z + c[2]) * z + c[1]) * z + c[0]


@inlined
def _product(a: float, b: float) -> tuple[float, float]:
    """a b and its rounding error (Dekker)."""
    h = _SPLIT * a
    a_high = h - (h - a)
    a_rest = a - a_high
    h = _SPLIT * b
    b_high = h - (h - b)
    b_rest = b - b_high
    p = a * b
    return p, (((a_high * b_high - p) + a_high * b_rest) + a_rest * b_high) + a_rest * b_rest


@inlined
def _root(a: float, a_low: float) -> tuple[float, float]:
    """sqrt(a + a_low) with its rounding error."""
    root = math.sqrt(a)
    square, square_low = _product(root, root)
    left = ((a - square) - square_low) + a_low
    return root, left / (2.0 * root) if root > 0.0 else 0.0


@inlined
def _sin_cos(x: float, quarter: int) -> float:
    """sin(x + quarter * pi/2)."""
    # x = k pi/2 + y + y_low; the parts of pi/2 have 26 bits, so their products with k are exact.
    t = x * _2_PI + _ROUND
    k = t - _ROUND
    n = _bits(t) + quarter
    a = x - k * _PI_2[0]
    w = k * _PI_2[1]
    b = a - w
    v = b - a
    b_low = (a - (b - v)) - (w + v)
    w = k * _PI_2[2]
    c = b - w
    v = c - b
    c_low = (b - (c - v)) - (w + v)
    low = (b_low + c_low) - k * _PI_2[3]
    y = c + low
    y_low = (c - y) + low

    z = y * y
    sine = y + (y_low * (1.0 - 0.5 * z) + y * (z * _horner6(_SIN, z)))
    one = 1.0 - 0.5 * z
    cosine = one + (((1.0 - one) - 0.5 * z) + (z * z * _horner6(_COS, z) - y * y_low))
    value = cosine if n & 1 else sine
    return -value if n & 2 else value


@inlined
def sin(x: float) -> float:
    """Sine of an angle in rad; NaN beyond +-MAX_ANGLE."""
    value = _sin_cos(x, 0)
    value = x if abs(x) < 2.0**-27 else value  # keeps the sign of zero
    return value if abs(x) <= MAX_ANGLE else np.nan


@inlined
def cos(x: float) -> float:
    """Cosine of an angle in rad; NaN beyond +-MAX_ANGLE."""
    value = _sin_cos(x, 1)
    return value if abs(x) <= MAX_ANGLE else np.nan


@inlined
def cos_sin_turn(u: float) -> tuple[float, float]:
    """Cosine and sine of u turns, |u| < 2^40: of 2 pi u, at most 2 ulp off, with less work."""
    t = 4.0 * u + _ROUND
    n = _bits(t)
    y = (u - 0.25 * (t - _ROUND)) * _TURN  # the difference is exact
    z = y * y
    sine = y + y * (z * _horner6(_SIN, z))
    one = 1.0 - 0.5 * z
    cosine = one + (((1.0 - one) - 0.5 * z) + z * z * _horner6(_COS, z))
    odd = n & 1
    a = sine if odd else cosine
    b = cosine if odd else sine
    return (-a if (n + 1) & 2 else a), (-b if n & 2 else b)


@inlined
def exp(x: float) -> float:
    """e to the x; infinite above 709.78, subnormal below -708.4 and zero below -745.13."""
    v = min(max(x, -746.0), 710.0)
    t = v * _1_LN2 + _ROUND
    k = t - _ROUND
    high = v - k * _LN2[0]
    low = k * _LN2[1]
    r = high - low
    r_low = (high - r) - low
    p = _EXP[10]
    p = p * r + _EXP[9]
    p = p * r + _EXP[8]
    p = p * r + _EXP[7]
    p = p * r + _EXP[6]
    p = (((p * r + _EXP[5]) * r + _EXP[4]) * r + _EXP[3]) * r
    p = ((p + _EXP[2]) * r + _EXP[1]) * r + _EXP[0]
    one = 1.0 + r
    value = one + ((r - (one - 1.0)) + (r * r * p + (r_low + r_low * r)))
    # Scaled in two steps: 2^k itself may be beyond the largest double, or below the smallest.
    n = _bits(t) - _ROUND_BITS
    half = n >> 1
    value = value * _from_bits((half + _BIAS) << 52) * _from_bits((n - half + _BIAS) << 52)
    return value if x == x else np.nan  # noqa: PLR0124


@inlined
def log(x: float) -> float:
    """Natural logarithm; -inf at zero, NaN below."""
    small = x < 2.0**-1022
    b = _bits(x * 2.0**54 if small else x)
    n = (b - _SQRT_HALF_BITS) >> 52
    f = _from_bits(b - (n << 52)) - 1.0  # x = 2^n (1 + f), sqrt(1/2) <= 1 + f < sqrt(2)
    k = _from_bits(n + _ROUND_BITS) - _ROUND
    k = k - 54.0 if small else k
    s = f / (2.0 + f)
    z = s * s
    p = (((_LOG[6] * z + _LOG[5]) * z + _LOG[4]) * z + _LOG[3]) * z
    p = ((p + _LOG[2]) * z + _LOG[1]) * z + _LOG[0]
    half_square = 0.5 * f * f
    rest = half_square - (s * (half_square + z * p) + k * _LN2[1])
    value = k * _LN2[0] - (rest - f)
    value = value if x < np.inf else np.inf
    value = -np.inf if x == 0.0 else value
    return value if x >= 0.0 else np.nan


@inlined
def _angle(y: float, y_low: float, x: float, x_low: float) -> float:
    """atan2(y + y_low, x + x_low), where the low parts are rounding errors of the others."""
    steep = abs(y) > abs(x)
    left = math.copysign(1.0, x) < 0.0
    y_low = -y_low if y < 0.0 else y_low
    x_low = -x_low if x < 0.0 else x_low
    n, n_low = (abs(x), x_low) if steep else (abs(y), y_low)
    d, d_low = (abs(y), y_low) if steep else (abs(x), x_low)
    if d == np.inf:
        n, d = (1.0, 1.0) if n == np.inf else (0.0, 1.0)
    d = d if d > 0.0 else 1.0
    slope = n / d
    exponent = min(int(_bits(d) >> 52), 2045)
    scale = _from_bits((2 * _BIAS - exponent) << 52)
    n, n_low, d, d_low = n * scale, n_low * scale, d * scale, d_low * scale

    # atan(n/d) = atan(u), or pi/4 + atan(u) with u = (n - d)/(n + d); then |u| <= tan(pi/8).
    far = n > _TAN_PI_8 * d
    over = n - d
    over_low = (n - (over + d)) + (n_low - d_low)
    under = d + n
    under_low = (n - (under - d)) + (d_low + n_low)
    over, over_low = (over, over_low) if far else (n, n_low)
    under, under_low = (under, under_low) if far else (d, d_low)
    u = over / under
    product, product_low = _product(u, under)
    u_low = (((over - product) - product_low) + (over_low - u * under_low)) / under

    z = u * u
    p = (((_ATAN[10] * z + _ATAN[9]) * z + _ATAN[8]) * z + _ATAN[7]) * z
    p = (((p + _ATAN[6]) * z + _ATAN[5]) * z + _ATAN[4]) * z + _ATAN[3]
    p = ((p * z + _ATAN[2]) * z + _ATAN[1]) * z + _ATAN[0]
    low = u * (z * p) + u_low * (1.0 - z)
    sign = -1.0 if steep != left else 1.0
    octants = 2.0 if steep else (4.0 if left else 0.0)
    octants = octants + sign if far else octants
    base = _PI3_4[0] if octants == 3.0 else octants * _PI_4[0]
    base_low = _PI3_4[1] if octants == 3.0 else octants * _PI_4[1]
    u = sign * u
    high = base + u
    value = high + ((u - (high - base)) + (sign * low + base_low))
    value = slope if base == 0.0 and slope < 2.0**-900 else value  # scaling has cut n short
    return math.copysign(value, y)


@inlined
def atan2(y: float, x: float) -> float:
    """Angle of the point (x, y) in rad, -pi to pi; signed zeros and infinities as in C99."""
    value = _angle(y, 0.0, x, 0.0)
    return value if x == x and y == y else np.nan  # noqa: PLR0124


@inlined
def _other_side(x: float) -> tuple[float, float]:
    """sqrt(1 - x^2) with its rounding error, |x| <= 1."""
    square, square_low = _product(x, x)
    left = 1.0 - square
    left_low = ((1.0 - left) - square) - square_low
    whole = left + left_low
    return _root(whole, left_low - (whole - left))


@inlined
def asin(x: float) -> float:
    """Arc sine in rad, -pi/2 to pi/2; NaN for |x| > 1."""
    side, low = _other_side(x)
    value = _angle(x, 0.0, side, low)
    return value if abs(x) <= 1.0 else np.nan


@inlined
def acos(x: float) -> float:
    """Arc cosine in rad, 0 to pi; NaN for |x| > 1."""
    side, low = _other_side(x)
    value = _angle(side, low, x, 0.0)
    return value if abs(x) <= 1.0 else np.nan


@inlined
def hypot(x: float, y: float) -> float:
    """sqrt(x^2 + y^2) without overflow on the way; infinite if either is, even beside a NaN."""
    a = max(abs(x), abs(y))
    b = min(abs(x), abs(y))
    scale = 2.0**600 if a < 2.0**-400 else 1.0
    scale = 2.0**-600 if a > 2.0**400 else scale
    square, square_low = _product(a * scale, a * scale)
    other, other_low = _product(b * scale, b * scale)
    total = square + other
    root, low = _root(total, (other - (total - square)) + (square_low + other_low))
    value = (root + low) * (1.0 / scale)
    value = value if x == x and y == y else np.nan  # noqa: PLR0124
    return np.inf if abs(x) == np.inf or abs(y) == np.inf else value
