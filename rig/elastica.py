"""The whisker's shaft as an exact elastica: boundary-value solutions by shooting.

An inextensible Euler-Bernoulli cantilever whose diameter falls linearly from base to tip, without
friction and weight. A point force F at arc length l from the base bends it; beyond, it is straight.
From that point the curve is integrated to the base: with sigma the arc length from the force, x
along the tangent there (towards the base), y across, theta the angle turned,

    theta' = F (x cos tilt + y sin tilt) / v^4,  x' = cos theta,  y' = sin theta,  v = 1 - k (l - sigma)

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

from vibrissa.numerics import atan2, compiled, cos, sin

STEPS = 256  # Runge-Kutta steps from contact to base; the error is below 1e-10
TOLERANCE = 1e-12  # of the residuals, lengths in units and angles in rad
LEAST_DIAMETER = 0.02  # of the base's, where the force acts

PEG, TIP, LYING, PINNED = range(4)


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
    arc, tilt = (r, 0.0) if kind in (PEG, LYING) else (1.0, r)
    x, y, theta = shoot(taper, arc, p, tilt, steps)
    if kind in (PEG, PINNED):
        return math.sqrt(x * x + y * y) - target, theta - atan2(y, x) - turn
    return y * cos(tilt) - x * sin(tilt) - target, theta - tilt - 0.5 * math.pi + turn


@compiled
def solve(
    kind: int, taper: float, p: float, r: float, target: float, turn: float, steps: int
) -> tuple[float, float, bool]:
    """Newton's method from the guess (force p, arc or tilt r); third: whether it converged.

    kind PEG and PINNED (tip): target the base's distance from the point, turn the angle gamma; TIP
    and LYING: target its distance from the plane, turn the angle from plane normal to straight shaft.
    """
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
            if new_p > -1e-9 and (kind in (TIP, PINNED) or 0.0 < new_r < limit) and abs(new_r) < 4.0:
                new_u, new_v = _residual(kind, taper, new_p, new_r, target, turn, steps)
                if abs(new_u) + abs(new_v) < error * (1.0 - 0.1 * share):
                    break
            share *= 0.5
            if share < 1e-4:
                return p, r, error < 1e-10
        p, r, u, v = new_p, new_r, new_u, new_v
    return p, r, False


@compiled
def peg_under(q: float, force: float, arc: float, steps: int) -> tuple[float, float]:
    """Arc length to a peg at distance 1 that pushes with ``force``, and the angle gamma it causes.

    q: diameter at the distance of the peg over that of the base; arc: a guess.
    """
    for _ in range(60):
        x, y, _theta = shoot(1.0 - q, arc, force, 0.0, steps)
        distance = math.sqrt(x * x + y * y)
        x, y, _theta = shoot(1.0 - q, arc + 1e-7, force, 0.0, steps)
        slope = (math.sqrt(x * x + y * y) - distance) * 1e7
        step = min(max((1.0 - distance) / slope, -0.05), 0.05)
        arc += step
        if abs(step) < 1e-13:
            break
    x, y, theta = shoot(1.0 - q, arc, force, 0.0, steps)
    return arc, theta - atan2(y, x)


@compiled
def last_peg(q: float, steps: int) -> tuple[float, float, float]:
    """(force, arc length, gamma) of the largest gamma at which a shaft rests against a peg.

    Beyond, no force keeps it there: it slides past the peg. By golden section over the force.
    """
    step = 0.15 * q
    before, before_arc, force, arc, gamma = 0.0, 1.0, 0.0, 1.0, 0.0
    while True:
        next_arc, next_gamma = peg_under(q, force + step, arc, steps)
        if next_gamma < gamma:
            break
        before, before_arc = force, arc
        force, arc, gamma = force + step, next_arc, next_gamma
    low, high = before, force + step
    ratio = 0.5 * (math.sqrt(5.0) - 1.0)
    a, b = high - ratio * (high - low), low + ratio * (high - low)
    arc_a, gamma_a = peg_under(q, a, before_arc, steps)
    arc_b, gamma_b = peg_under(q, b, before_arc, steps)
    for _ in range(32):
        if gamma_a > gamma_b:
            high, b, arc_b, gamma_b = b, a, arc_a, gamma_a
            a = high - ratio * (high - low)
            arc_a, gamma_a = peg_under(q, a, before_arc, steps)
        else:
            low, a, arc_a, gamma_a = a, b, arc_b, gamma_b
            b = low + ratio * (high - low)
            arc_b, gamma_b = peg_under(q, b, before_arc, steps)
    return b, arc_b, gamma_b


@compiled
def peg_contact(q: float, gamma: float, steps: int) -> tuple[float, float, float, float, bool]:
    """A frictionless peg at distance 1 against the shaft, the base turned gamma past first touch.

    q: diameter at the distance of the peg over that of the base, in (0, 1]; gamma: rad, >= 0.
    Returns (force, arc length to the contact, base moment, angle of the shaft at the contact from
    the base's direction, rad; whether it exists), force in E I0 / d^2 and moment in E I0 / d.
    """
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
        # Near the largest gamma: step the force up until gamma is passed, then bisect.
        most_force, most_arc, most = last_peg(q, steps)
        if gamma > most:
            return most_force, most_arc, 0.0, 0.0, False
        low, high = force, most_force
        while True:
            middle = 0.5 * (low + high)
            if middle in (low, high):
                break
            r, found_gamma = peg_under(q, middle, arc, steps)
            if found_gamma < gamma:
                low, arc = middle, r
            else:
                high = middle
        force = low
    x, _, theta = shoot(1.0 - q, arc, force, 0.0, steps)
    return force, arc, force * x, theta, True


@compiled
def tip_contact(
    r: float, height: float, turn: float, steps: int
) -> tuple[float, float, float, float, bool]:
    """The tip on a frictionless plane, lengths in those of the whisker.

    r: tip over base diameter; height: distance of the base from the plane, in (0, 1); turn: angle
    between the straight shaft and the plane's normal, rad, at most acos(height), where it touches.
    Returns (force, arc length to the contact, base moment, offset of the contact along the plane,
    whether it exists), force in E I0 / L^2, moment in E I0 / L.
    """
    taper = 1.0 - r
    first = atan2(math.sqrt(1.0 - height * height), height)
    kind, force, rest = TIP, 0.0, first - 0.5 * math.pi
    parts = int((first - turn) / 0.1) + 4
    total = first - turn
    done, step = 0.0, total / parts
    last_force, last_rest = force, rest
    while total - done > 1e-15:
        to = min(done + step, total)
        ahead = (to - done) / step if done > 0.0 else 0.0
        guess, guess_rest = force + (force - last_force) * ahead, rest + (rest - last_rest) * ahead
        if done == 0.0:
            guess, guess_rest = 3.0 * r * to / math.sqrt(1.0 - height * height), rest + 0.5 * to
        p, q, found = solve(kind, taper, guess, guess_rest, height, first - to, steps)
        if not found or (kind == TIP and q > 0.0):
            if kind == TIP and (rest > -0.3 or (found and q > 0.0)):
                other, arc, lies = solve(LYING, taper, force, 1.0, height, first - to, steps)
                if lies and arc <= 1.0:
                    kind, last_force, last_rest = LYING, other, arc
                    force, rest, done = other, arc, to
                    continue
            step *= 0.5
            if step < 1e-4 * total:
                return force, 1.0, 0.0, 0.0, False
            continue
        last_force, last_rest, force, rest, done = force, rest, p, q, to
    if kind == TIP:
        x, y, _ = shoot(taper, 1.0, force, rest, steps)
        offset = x * cos(rest) + y * sin(rest)
        return force, 1.0, force * offset, offset, True
    offset, _, _ = shoot(taper, rest, force, 0.0, steps)
    return force, rest, force * offset, offset, True


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
