"""One whisker's shaft as a beam, behind one interface with three forms.

linear  small angles: moment 3 E I0 q gamma / d, arc length to the contact d (1 + c(q) gamma^2)
table   the elastica, precomputed and interpolated: the form to use
exact   the elastica, solved at every call: an oracle, thousands of times slower

q is the diameter at the contact's distance d over that of the base, I0 the base's second moment of
area, gamma the angle by which base and contact are turned against each other. ``tables``
float64[1 + n, SIZE, SIZE, 4] holds the peg table and n tip tables (`vibrissa.rig.beam_table`).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from vibrissa.numerics import atan2, compiled, cos, sin
from vibrissa.rig import elastica
from vibrissa.rig.beam_table import (
    LEAST_HEIGHT,
    LEAST_Q,
    MOST_HEIGHT,
    interpolate_peg,
    interpolate_tip,
    most_gamma,
    peg_table,
    tip_table,
)

FORMS = ("linear", "table", "exact")
LINEAR, TABLE, EXACT = range(3)
EXACT_STEPS = elastica.STEPS


def beam_tables(ratios: tuple[float, ...], size: int) -> NDArray[np.float64]:
    """The tables for shafts with these tip over base diameters, float64[1 + n, size, size, 4]."""
    return np.stack([peg_table(size), *(tip_table(r, size) for r in ratios)])


@compiled
def peg(
    form: int, tables: NDArray[np.float64], q: float, gamma: float
) -> tuple[float, float, float, bool]:
    """The shaft against a peg: (moment, arc length, angle at the contact, whether it rests there).

    gamma: rad, >= 0. Moment in E I0 / d, arc length to the contact in d, angle in rad, from the
    base's direction. Where it can't rest, the shaft slides past the peg.
    """
    if form == EXACT:
        _force, arc, moment, angle, rests = elastica.peg_contact(q, gamma, EXACT_STEPS)
        return moment, arc, angle, rests
    row = (q - LEAST_Q) / (1.0 - LEAST_Q)
    if form == LINEAR:
        _one, bow, slope = interpolate_peg(tables[0], row, 0.0)
        return 3.0 * q * gamma, 1.0 + bow * gamma * gamma, slope * gamma, True
    share = gamma / most_gamma(tables[0], row)
    if share > 1.0:
        return 0.0, 1.0, 0.0, False
    part, bow, slope = interpolate_peg(tables[0], row, 1.0 - math.sqrt(1.0 - share * share))
    return 3.0 * q * gamma * part, 1.0 + bow * gamma * gamma, slope * gamma, True


@compiled
def tip(
    form: int, tables: NDArray[np.float64], table: int, r: float, height: float, turn: float
) -> tuple[float, float, float]:
    """The tip on a plane: (moment, offset of the contact along the plane, arc length to it).

    table: which tip table; r: its tip over base diameter; height: of the base above the plane over
    the length L; turn: angle between straight shaft and plane normal, rad, less than at first
    touch. Moment in E I0 / L, lengths in L. Turns below 0 count as 0.
    """
    height = min(max(height, LEAST_HEIGHT), MOST_HEIGHT)
    first = atan2(math.sqrt(1.0 - height * height), height)
    turned = min(max(first - turn, 0.0), first)
    if form == LINEAR:
        # The chord shortens by c gamma^2 and its end stays on the plane.
        _one, c, _slope = interpolate_peg(tables[0], (r - LEAST_Q) / (1.0 - LEAST_Q), 0.0)
        gamma = turned
        for _ in range(4):
            chord = 1.0 - c * gamma * gamma
            a = cos(first - turned + gamma)
            b = sin(first - turned + gamma)
            gamma -= (chord * a - height) / min(-2.0 * c * gamma * a - chord * b, -1e-3)
            gamma = min(max(gamma, 0.0), turned)
        chord = 1.0 - c * gamma * gamma
        return 3.0 * r * gamma, chord * sin(first - turned + gamma), 1.0
    if form == EXACT and turned > 0.0:
        moment, offset, arc, found = elastica.tip_contact(r, height, first - turned, EXACT_STEPS)
        if found:
            return moment, offset, arc
    share, offset, arc = interpolate_tip(tables[table], height, first, turned)
    return 3.0 * r * turned * share / height, offset, arc
