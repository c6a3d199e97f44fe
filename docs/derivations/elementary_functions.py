"""Where the constants of `vibrissa/elementary.py` come from.

Run ``python docs/derivations/elementary_functions.py`` (needs mpmath, takes half a minute): prints
every polynomial with its coefficients as written in the code and the largest error it leaves,
measured after rounding the coefficients to doubles and relative to the function's value, in units
of 2^-53; and the splittings of pi/2, pi/4, 3 pi/4 and ln 2.

Each polynomial is the minimax one (Remez exchange) of a function that is smooth and even where the
original is odd or even, so that the leading terms stay exact:

    sin r = r + r z S(z),  cos r = 1 - z/2 + z^2 C(z)      z = r^2, |r| <= pi/4
    exp r = 1 + r + r^2 E(r)                               |r| <= ln(2)/2
    log (1+s)/(1-s) = 2 s + s z L(z)                       z = s^2, |s| <= 3 - sqrt(8)
    atan u = u + u z A(z)                                  z = u^2, |u| <= tan(pi/8)
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from mpmath import mp, mpf

Function = Callable[[mpf], mpf]

mp.prec = 240


class Polynomial(NamedTuple):
    """What is approximated on [low, high] by `terms` coefficients.

    `weight` times the error of the polynomial is the relative error of the function built on it.
    """

    name: str
    target: Function
    weight: Function
    low: mpf
    high: mpf
    terms: int


def _series(first: Function, ratio: Callable[[mpf, int], mpf]) -> Function:
    def value(z: mpf) -> mpf:
        total = term = first(z)
        n = 0
        while abs(term) > mpf(2) ** -230:
            n += 1
            term *= ratio(z, n)
            total += term
        return total

    return value


def _odd_powers(scale: mpf, sign: int) -> Function:
    """scale * sum over n >= 1 of (sign z)^(n-1) / (2n+1)."""

    def value(z: mpf) -> mpf:
        total, power, n = mpf(0), mpf(scale), 1
        while abs(power) > mpf(2) ** -230 or n < 2:
            total += power / (2 * n + 1)
            power *= sign * z
            n += 1
        return total

    return value


_sin = _series(lambda z: mpf(-1) / 6, lambda z, n: -z / ((2 * n + 2) * (2 * n + 3)))
_cos = _series(lambda z: mpf(1) / 24, lambda z, n: -z / ((2 * n + 3) * (2 * n + 4)))
_exp = _series(lambda r: mpf(1) / 2, lambda r, n: r / (n + 2))
_log = _odd_powers(mpf(2), 1)
_atan = _odd_powers(mpf(-1), -1)

# A little more than the exact interval: the reduced argument may overshoot it by a rounding error.
WIDER = 1 + mpf(2) ** -20
PI_4 = mp.pi / 4 * WIDER
LN2_2 = mp.log(2) / 2 * WIDER
S_LOG = (3 - mp.sqrt(8)) * WIDER
U_ATAN = (mp.sqrt(2) - 1) * WIDER

POLYNOMIALS = (
    Polynomial("SIN", _sin, lambda z: z / (1 + z * _sin(z)), mpf(0), PI_4**2, 6),
    Polynomial("COS", _cos, lambda z: z * z / mp.cos(mp.sqrt(z)), mpf(0), PI_4**2, 6),
    Polynomial("EXP", _exp, lambda r: r * r / mp.exp(r), -LN2_2, LN2_2, 11),
    Polynomial("LOG", _log, lambda z: z / (2 + z * _log(z)), mpf(0), S_LOG**2, 7),
    Polynomial("ATAN", _atan, lambda z: z / (1 + z * _atan(z)), mpf(0), U_ATAN**2, 11),
)


def evaluate(coefficients: list[mpf], z: mpf) -> mpf:
    total = mpf(0)
    for coefficient in reversed(coefficients):
        total = total * z + coefficient
    return total


def _extremes(error: Function, low: mpf, high: mpf, count: int) -> list[mpf]:
    """`count` points of alternating sign where |error| is locally largest."""
    steps = 40 * count
    middle, half = (low + high) / 2, (high - low) / 2
    grid = [middle - half * mp.cos(mp.pi * i / steps) for i in range(steps + 1)]
    values = [error(z) for z in grid]
    runs: list[int] = []
    for i, value in enumerate(values):
        if runs and mp.sign(values[runs[-1]]) == mp.sign(value):
            if abs(value) > abs(values[runs[-1]]):
                runs[-1] = i
        else:
            runs.append(i)
    while len(runs) > count:
        runs.pop(0 if abs(values[runs[0]]) < abs(values[runs[-1]]) else -1)
    if len(runs) < count:
        raise ArithmeticError(f"{len(runs)} alternations, expected {count}")
    return [grid[i] for i in runs]


def remez(p: Polynomial, target: Function, terms: int) -> list[mpf]:
    """The polynomial with the smallest largest |weight (polynomial - target)| on [low, high]."""
    middle, half = (p.low + p.high) / 2, (p.high - p.low) / 2
    points = [
        middle - half * mp.cos(mp.pi * (2 * i + 1) / (2 * terms + 2)) for i in range(terms + 1)
    ]
    coefficients: list[mpf] = []
    for _ in range(8):
        matrix = mp.matrix(terms + 1, terms + 1)
        right = mp.matrix(terms + 1, 1)
        for i, z in enumerate(points):
            weight = p.weight(z)
            for j in range(terms):
                matrix[i, j] = weight * z**j
            matrix[i, terms] = (-1) ** i
            right[i] = weight * target(z)
        solution = mp.lu_solve(matrix, right)
        coefficients = [solution[j] for j in range(terms)]
        points = _extremes(
            lambda z: p.weight(z) * (evaluate(coefficients, z) - target(z)),  # noqa: B023
            p.low,
            p.high,
            terms + 1,
        )
    return coefficients


def derive(p: Polynomial) -> list[float]:
    """The coefficients as doubles, lowest power first.

    The lowest is rounded first and the others are fitted again to what is left, since its rounding
    error weighs most.
    """
    first = float(remez(p, p.target, p.terms)[0])

    def rest(z: mpf) -> mpf:
        return (p.target(z) - first) / z

    narrowed = p._replace(
        target=rest, weight=lambda z: p.weight(z) * z, low=p.low if p.low < 0 else p.high / 2**20
    )
    return [first, *(float(c) for c in remez(narrowed, rest, p.terms - 1))]


def largest_error(p: Polynomial, coefficients: list[float], steps: int = 2000) -> mpf:
    exact = [mpf(c) for c in coefficients]
    points = [p.low + (p.high - p.low) * i / steps for i in range(steps + 1)]
    return max(abs(p.weight(z) * (evaluate(exact, z) - p.target(z))) for z in points)


def split(value: mpf, bits: tuple[int, ...]) -> list[float]:
    """Parts of `value` of so many bits each, short enough for exact products, and the rest."""
    parts = []
    for width in bits:
        scale = mpf(2) ** (width - int(mp.floor(mp.log(value, 2))) - 1)
        part = mp.floor(value * scale) / scale
        parts.append(float(part))
        value -= part
    return [*parts, float(value)]


SPLITS = {
    "PI_2": (mp.pi / 2, (26, 26, 26)),
    "PI_4": (mp.pi / 4, (53,)),
    "PI3_4": (3 * mp.pi / 4, (53,)),
    "LN2": (mp.log(2), (42,)),
}


def main() -> None:
    for p in POLYNOMIALS:
        coefficients = derive(p)
        error = float(largest_error(p, coefficients) * mpf(2) ** 53)
        print(f"{p.name}, at most {error:.4f} * 2^-53 off:")
        print("\n".join(f"    {c!r}," for c in coefficients))
    for name, (value, bits) in SPLITS.items():
        print(f"{name} = {split(value, bits)}")


if __name__ == "__main__":
    main()
