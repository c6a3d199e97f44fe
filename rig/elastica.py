"""The whisker's shaft as an exact elastica: boundary-value solutions by shooting.

An inextensible Euler-Bernoulli cantilever whose diameter falls linearly from base to tip, without
friction and weight. A point force F at arc length l from the base bends it; beyond, it is straight.
From that point the curve is integrated to the base: with sigma the arc length from the force, x
along the tangent there (towards the base), y across, theta the angle turned,

    theta' = F (x cos tilt + y sin tilt) / v^4,  x' = cos theta,  y' = sin theta,
    v = 1 - k (l - sigma)

`tilt` turns the force from the shaft's normal towards its free end; v is the diameter over that of
the base. Forces are in E I0 / unit^2 and moments in E I0 / unit, where the unit of length is the
distance d of a peg, or the whisker's length. Two numbers are then found by Newton's method such
that the base is where it should be:

- a peg against the shaft (`peg_contact`): the force is normal to the shaft. In units of d a shaft
  is known by q, its diameter at d over that of the base, so one family fits every taper.
- the tip on a plane (`tip_contact`): the force is normal to the plane. Where the bent tip comes to
  lie along the plane, the contact moves up the shaft, which touches tangentially.
"""

from __future__ import annotations

import math

from vibrissa.compilation import stay_apart
from vibrissa.numerics import atan2, compiled, cos, sin

STEPS = 400  # Runge-Kutta steps from contact to base; the error is below 1e-9
TOLERANCE = 1e-12  # of the residuals, lengths in units and angles in rad
LEAST_DIAMETER = 0.02  # of the base's, where the force acts

PEG, TIP, LYING = range(3)


@compiled
def shoot(
    taper: float, arc: float, force: float, tilt: float, steps: int
) -> tuple[float, float, float]:
    """Where the base is, seen from the point of contact: (x, y, theta).

    taper: k, loss of diameter per unit of length over the base's; arc: l. Runge-Kutta of order 4 in
    the square root of the arc length from the contact, where a thin end bends most.
    """
    c, s = cos(tilt), sin(tilt)
    h = 1.0 / steps
    end = 1.0 - taper * arc
    x, y, theta = 0.0, 0.0, 0.0
    for n in range(steps):
        near = n * h
        middle, far = near + 0.5 * h, near + h
        v = end + taper * arc * near * near
        w1, f1 = 2.0 * arc * near, v * v * v * v
        v = end + taper * arc * middle * middle
        w2, f2 = 2.0 * arc * middle, v * v * v * v
        v = end + taper * arc * far * far
        w4, f4 = 2.0 * arc * far, v * v * v * v
        x1, y1 = w1 * cos(theta), w1 * sin(theta)
        t1 = w1 * force * (x * c + y * s) / f1
        a, b, t = x + 0.5 * h * x1, y + 0.5 * h * y1, theta + 0.5 * h * t1
        x2, y2 = w2 * cos(t), w2 * sin(t)
        t2 = w2 * force * (a * c + b * s) / f2
        a, b, t = x + 0.5 * h * x2, y + 0.5 * h * y2, theta + 0.5 * h * t2
        x3, y3 = w2 * cos(t), w2 * sin(t)
        t3 = w2 * force * (a * c + b * s) / f2
        a, b, t = x + h * x3, y + h * y3, theta + h * t3
        x4, y4 = w4 * cos(t), w4 * sin(t)
        t4 = w4 * force * (a * c + b * s) / f4
        x += h / 6.0 * (x1 + 2.0 * (x2 + x3) + x4)
        y += h / 6.0 * (y1 + 2.0 * (y2 + y3) + y4)
        theta += h / 6.0 * (t1 + 2.0 * (t2 + t3) + t4)
    return x, y, theta


@compiled
def _residual(
    kind: int, taper: float, p: float, r: float, target: float, turn: float, steps: int
) -> tuple[float, float]:
    """How far base and target are apart, for unknowns (force p, arc or tilt r)."""
    arc, tilt = (1.0, r) if kind == TIP else (r, 0.0)
    x, y, theta = shoot(taper, arc, p, tilt, steps)
    if kind == PEG:
        return math.sqrt(x * x + y * y) - target, theta - atan2(y, x) - turn
    return y * cos(tilt) - x * sin(tilt) - target, theta - tilt - 0.5 * math.pi + turn


@compiled
def solve(
    kind: int, taper: float, p: float, r: float, target: float, turn: float, steps: int
) -> tuple[float, float, bool]:
    """Newton's method from the guess (force p, arc or tilt r); third: whether it converged.

    kind PEG: target the base's distance from the peg, turn the angle gamma; TIP and LYING: target
    its distance from the plane, turn the angle from the plane's normal to the straight shaft.
    """
    stay_apart()
    limit = (1.0 - LEAST_DIAMETER) / taper if taper > 0.0 else 1e3
    limit = min(limit, 4.0)
    u, v = _residual(kind, taper, p, r, target, turn, steps)
    for _ in range(40):
        error = abs(u) + abs(v)
        if error < TOLERANCE:
            return p, r, True
        dp, dr = 1e-7 * max(p, 1e-3), 1e-7
        up, vp = _residual(kind, taper, p + dp, r, target, turn, steps)
        ur, vr = _residual(kind, taper, p, r + dr, target, turn, steps)
        a, b, c, d = (up - u) / dp, (ur - u) / dr, (vp - v) / dp, (vr - v) / dr
        det = a * d - b * c
        if not abs(det) > 1e-300:
            return p, r, False
        step_p, step_r = (b * v - d * u) / det, (c * u - a * v) / det
        share = 1.0
        while True:
            new_p, new_r = p + share * step_p, r + share * step_r
            if new_p > -1e-9 and (kind == TIP or 0.0 < new_r < limit) and abs(new_r) < 4.0:
                new_u, new_v = _residual(kind, taper, new_p, new_r, target, turn, steps)
                if abs(new_u) + abs(new_v) < error * (1.0 - 0.1 * share):
                    break
            share *= 0.5
            if share < 1e-4:
                return p, r, error < 1e-10
        p, r, u, v = new_p, new_r, new_u, new_v
    return p, r, False


@compiled
def peg_past(q: float, excess: float, force: float, steps: int) -> tuple[float, float]:
    """(force, gamma) for which the contact lies 1 + excess^2 along the shaft, a peg at distance 1.

    q: diameter at the distance of the peg over that of the base; excess > 0; force: a guess.
    """
    arc = 1.0 + excess * excess
    for _ in range(60):
        x, y, _theta = shoot(1.0 - q, arc, force, 0.0, steps)
        distance = math.sqrt(x * x + y * y)
        nudge = 1e-7 * force
        x, y, _theta = shoot(1.0 - q, arc, force + nudge, 0.0, steps)
        slope = (math.sqrt(x * x + y * y) - distance) / nudge
        step = min(max((1.0 - distance) / slope, -0.3 * force), 0.3 * force)
        force += step
        if abs(step) < 1e-13 * force:
            break
    x, y, theta = shoot(1.0 - q, arc, force, 0.0, steps)
    return force, theta - atan2(y, x)


@compiled
def last_peg(q: float, steps: int) -> tuple[float, float, float]:
    """(excess, force, gamma) of the largest gamma at which a shaft rests against a peg.

    Beyond, it slides past the peg, whatever the force. By golden section over the excess.
    """
    stay_apart()
    step = 0.01 + 0.03 * q
    excess, gamma = step, 0.0
    force, gamma = peg_past(q, excess, 3.0 * q * excess * math.sqrt(10.0 * q), steps)
    before, before_force = excess, force
    while True:
        next_force, next_gamma = peg_past(q, excess + step, force, steps)
        if next_gamma < gamma:
            break
        before, before_force = excess, force
        excess, force, gamma = excess + step, next_force, next_gamma
    low, high = before, excess + step
    ratio = 0.5 * (math.sqrt(5.0) - 1.0)
    a, b = high - ratio * (high - low), low + ratio * (high - low)
    force_a, gamma_a = peg_past(q, a, before_force, steps)
    force_b, gamma_b = peg_past(q, b, force_a, steps)
    for _ in range(32):
        if gamma_a > gamma_b:
            high, b, force_b, gamma_b = b, a, force_a, gamma_a
            a = high - ratio * (high - low)
            force_a, gamma_a = peg_past(q, a, force_b, steps)
        else:
            low, a, force_a, gamma_a = a, b, force_b, gamma_b
            b = low + ratio * (high - low)
            force_b, gamma_b = peg_past(q, b, force_a, steps)
    return b, force_b, gamma_b


@compiled
def peg_between(
    q: float, gamma: float, low: float, force: float, most: tuple[float, float, float], steps: int
) -> tuple[float, float]:
    """(excess, force) for an angle gamma between that of the excess ``low`` and the largest.

    force: a guess at ``low``; most: as from `last_peg`. By the Illinois method over
    sqrt(1 - (gamma / most)^2), which is nearly linear in the excess.
    """
    high, _force, largest = most
    goal = math.sqrt(max(1.0 - (gamma / largest) * (gamma / largest), 0.0))
    force, found = peg_past(q, low, force, steps)
    at_low = math.sqrt(max(1.0 - (found / largest) * (found / largest), 0.0)) - goal
    at_high, side, excess = -goal, 0, low
    for _ in range(60):
        if not (at_low > 0.0 > at_high and high - low > 1e-15):
            break
        excess = (low * at_high - high * at_low) / (at_high - at_low)
        force, found = peg_past(q, excess, force, steps)
        value = math.sqrt(max(1.0 - (found / largest) * (found / largest), 0.0)) - goal
        if abs(value) < 1e-14:
            break
        if value > 0.0:
            low, at_low = excess, value
            at_high *= 0.5 if side > 0 else 1.0
            side = 1
        else:
            high, at_high = excess, value
            at_low *= 0.5 if side < 0 else 1.0
            side = -1
    return excess, force


@compiled
def peg_contact(q: float, gamma: float, steps: int) -> tuple[float, float, float, float, bool]:
    """A frictionless peg at distance 1 against the shaft, the base turned gamma past first touch.

    q: diameter at the distance of the peg over that of the base, in (0, 1]; gamma: rad, >= 0.
    Returns (force, arc length to the contact, base moment, angle of the shaft at the contact from
    the base's direction, rad; whether it exists), force in E I0 / d^2 and moment in E I0 / d.
    """
    stay_apart()
    force, arc, found = 0.0, 1.0, True
    parts = int(gamma / 0.15) + 1
    for n in range(parts):
        to = gamma * (n + 1) / parts
        guess = force * (n + 1) / n if n > 0 else 3.0 * q * to
        p, r, found = solve(PEG, 1.0 - q, guess, arc, 1.0, to, steps)
        if not found:
            break
        force, arc = p, r
    if not found:
        # Near the largest gamma, where force and arc length change without end.
        most = last_peg(q, steps)
        if gamma > most[2]:
            return most[1], 1.0 + most[0] * most[0], 0.0, 0.0, False
        low = math.sqrt(max(arc - 1.0, 1e-6))
        excess, force = peg_between(q, gamma, low, max(force, 0.01 * q), most, steps)
        arc = 1.0 + excess * excess
    x, _, theta = shoot(1.0 - q, arc, force, 0.0, steps)
    return force, arc, force * x, theta, True


@compiled
def follow_tip(
    r: float,
    height: float,
    first: float,
    turned: float,
    to: float,
    kind: int,
    force: float,
    rest: float,
    steps: int,
) -> tuple[int, float, float, bool]:
    """Continue a contact of the tip with a plane from one angle past first touch to a larger one.

    first: angle to the plane's normal at first touch; turned, to: rad past it; kind, force and rest
    (tilt or arc length): the solution at ``turned``. Returns (kind, force, rest, whether there is).
    """
    stay_apart()
    taper = 1.0 - r
    step = to - turned
    while to > turned:
        aim = min(turned + step, to)
        guess, guess_rest = force, rest
        if turned == 0.0:
            guess, guess_rest = 3.0 * r * aim / max(sin(first), 1e-3), rest + 0.5 * aim
        p, q, found = solve(kind, taper, guess, guess_rest, height, first - aim, steps)
        if kind == TIP and (not found or q > 0.0):
            arc = 1.0 if turned > 0.0 else height / max(cos(first - aim), height)
            p, q, found = solve(LYING, taper, guess, arc, height, first - aim, steps)
            found = found and q <= 1.0
            if found:
                kind = LYING
        if found:
            force, rest, turned = p, q, aim
            continue
        step *= 0.5
        if step < 1e-6:
            return kind, force, rest, False
    return kind, force, rest, True


@compiled
def tip_lying(r: float, force: float, steps: int) -> tuple[float, float]:
    """A tip that just comes to lie along its plane: (height, turn) for a force on it.

    r: tip over base diameter. With the force the height grows and the turn falls, down to 0.
    """
    _x, y, theta = shoot(1.0 - r, 1.0, force, 0.0, steps)
    return y, 0.5 * math.pi - theta


@compiled
def straight_push(r: float, steps: int) -> float:
    """The force that lays the tip along a plane as the whisker is pushed straight at it.

    With less, the tip lies down at an angle to the push. By bisection.
    """
    high = 0.01
    while tip_lying(r, high, steps)[1] > 0.0:
        high *= 1.25
    low = 0.8 * high
    while True:
        force = 0.5 * (low + high)
        if force in (low, high):
            return low
        if tip_lying(r, force, steps)[1] > 0.0:
            low = force
        else:
            high = force


@compiled
def lying_force(r: float, height: float, most: float, steps: int) -> float:
    """The force, less than ``most``, that lays the tip along a plane at a height. By bisection."""
    low, high = 0.0, most
    while True:
        force = 0.5 * (low + high)
        if force in (low, high):
            return force
        if tip_lying(r, force, steps)[0] < height:
            low = force
        else:
            high = force


@compiled
def tip_result(
    r: float, kind: int, force: float, rest: float, steps: int
) -> tuple[float, float, float]:
    """(base moment, offset of the contact along the plane, arc length to it) of a solution."""
    if kind == LYING:
        offset, _y, _theta = shoot(1.0 - r, rest, force, 0.0, steps)
        return force * offset, offset, rest
    x, y, _theta = shoot(1.0 - r, 1.0, force, rest, steps)
    offset = x * cos(rest) + y * sin(rest)
    return force * offset, offset, 1.0


@compiled
def tip_contact(
    r: float, height: float, turn: float, steps: int
) -> tuple[float, float, float, bool]:
    """The tip on a frictionless plane, lengths in those of the whisker.

    r: tip over base diameter; height: distance of the base from the plane, in (0, 1); turn: angle
    between the straight shaft and the plane's normal, rad, at most acos(height), where it touches.
    Returns (base moment in E I0 / L, offset of the contact along the plane, arc length to it,
    whether it exists).
    """
    stay_apart()
    first = atan2(math.sqrt(1.0 - height * height), height)
    total = first - turn
    kind, force, rest, found = TIP, 0.0, first - 0.5 * math.pi, True
    parts = int(total / 0.1) + 2
    for n in range(parts):
        kind, force, rest, found = follow_tip(
            r, height, first, total * n / parts, total * (n + 1) / parts, kind, force, rest, steps
        )
        if not found:
            return 0.0, 0.0, 1.0, False
    moment, offset, arc = tip_result(r, kind, force, rest, steps)
    return moment, offset, arc, True


@compiled
def dead_load(r: float, load: float, steps: int) -> tuple[float, float, float]:
    """A force on the tip, across the straight shaft: (deflection, shortening, tip angle).

    r: tip over base diameter; load: P L^2 / (E I0); lengths in those of the whisker, angle in rad.
    The angle is found by bisection.
    """
    low, high = 0.0, 0.5 * math.pi
    while True:
        angle = 0.5 * (low + high)
        x, y, theta = shoot(1.0 - r, 1.0, load, angle, steps)
        if angle in (low, high):
            break
        if theta > angle:
            low = angle
        else:
            high = angle
    c, s = cos(angle), sin(angle)
    return x * s - y * c, 1.0 - x * c - y * s, angle
