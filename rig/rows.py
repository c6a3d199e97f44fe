"""What the rows of the head's arrays hold; their columns are the whiskers."""

from __future__ import annotations

from vibrissa.compilation import inlined
from vibrissa.control.kinematics import WHISKERS

# Rows of the shaft table float64[SHAFT_ROWS, whiskers].
(
    LENGTH,  # m
    TAPER,  # 1/m, diameter(s) = base (1 - TAPER s)
    RIGIDITY,  # N m^2, E I at the base
    WEIGHT,  # N m, moment of the whisker's weight about its base when horizontal
    INERTIA,  # kg m^2, moment of inertia about its base
    FIRST_QQ,  # first mode over one tick: q' = QQ q + QV v, v' = VQ q + VV v
    FIRST_QV,
    FIRST_VQ,
    FIRST_VV,
    SECOND_QQ,
    SECOND_QV,
    SECOND_VQ,
    SECOND_VV,
    RELEASE,  # share of the first mode in the moment of a tip let go; the second has the rest
    SWAY,  # share of the first mode in the moment of inertia; the second has the rest
    TIP_SLIP,  # the chord to a held tip is LENGTH / (1 + TIP_SLIP gamma^2) at small gamma
) = range(16)
SHAFT_ROWS = 16

# Rows of the head table float64[HEAD_ROWS, 18]; the first SHAFT_ROWS are the shafts'.
(
    PIVOT_RADIUS,  # m
    PIVOT_HEIGHT,  # m above the nose plane
    AZIMUTH_COS,
    AZIMUTH_SIN,
    PHI_START,  # rad
    THETA_LOW,  # rad, mechanical stops
    THETA_HIGH,
    SERVO_EE,  # servo over one tick: e' = EE e + EW w, w' = WE e + WW w, e = theta - target
    SERVO_EW,
    SERVO_WE,
    SERVO_WW,
    COMPLIANCE,  # rad/(N m), 1 / Kp
    SPEED_LIMIT,  # rad/s
    RETRACT_STEP,  # rad per tick, when the watchdog retracts
    ENCODER_NOISE,  # rad
    SENSOR_NOISE,  # N m
    DRIFT_STEP,  # N m, standard deviation per DRIFT_TICKS
    CROSS_TALK,  # fraction of x in y and of y in x
    FULL_SCALE,  # N m
    RESOLUTION,  # N m per count
    COUNTS,  # counts per N m
    FRICTION,  # Coulomb coefficient across the shaft
    FORM,  # of the beam: LINEAR, TABLE, EXACT
    TIP_TABLE,  # which of the beam tables is the tip's
    DT,  # s, the tick
    RATE,  # 1/s
) = range(SHAFT_ROWS, SHAFT_ROWS + 26)
HEAD_ROWS = SHAFT_ROWS + 26

# Rows of the state float64[STATE_ROWS, 18].
(
    THETA,  # rad
    OMEGA,  # rad/s
    COMMAND,  # rad, what the servo follows
    PSI,  # rad, of the line from pivot to contact in the whisking plane; phi when free
    GAMMA,  # rad, psi - phi: > 0 pushed back while protracting, < 0 hooked while retracting
    PEG,  # wall touched in the whisking plane: box, or number of boxes for the floor; -1 none
    FACE,  # 1 where the tip is on the top or the face of that wall, 0 the shaft on its edge
    ABOVE,  # 1 where the whisker came down on that wall, 0 where it hangs behind it
    SIDE,  # 1 pushed to the left (counterclockwise seen from above) by a wall met sideways, -1, 0
    SIDE_BOX,  # the box that pushes sideways, -1 none
    SIDE_LEAN,  # horizontal lean sideways, offset over distance from the pivot, >= 0
    BEND,  # rad^2, angle^2 of the contact, smoothed over two ticks
    MOMENT_X,  # N m, quasi-static
    MOMENT_Y,
    DRAG,  # rad, shaft turned sideways by friction
    HELD_X,  # m, world: where the contact was when friction last acted
    HELD_Y,
    RING_X,  # N m and N m/s: first and second mode of x, then of y
    RING_X_RATE,
    RING_X2,
    RING_X2_RATE,
    RING_Y,
    RING_Y_RATE,
    RING_Y2,
    RING_Y2_RATE,
    DRIFT_X,  # N m
    DRIFT_Y,
) = range(27)
STATE_ROWS = 27

# Rows of the memo float64[MEMO_ROWS, 18]. A fresh memo of zeros knows nothing.
(
    POSE,  # the pose of the last tick, in the first four columns
    MARGIN,  # m, how far from the next box every point was that the whisker can reach ...
    ROOM,  # ... and how far from the next box or the floor every point of the whisker was ...
    FROM_X,  # ... when the head was here
    FROM_Y,
    FROM_Z,
    FROM_YAW,
    FROM_PHI,  # ... and the whisker there
    SETTLED,  # 1 where the last evaluation left the state as it was ...
    SETTLED_PHI,  # ... at this angle
    PASSED,  # 1 where this tick needs no look
    ACCELERATION,  # rad/s^2, of this tick
    PHI,  # rad; each of these three has a row to spare behind it, for loops over whole vectors
    _,
    SIN_PHI,
    _,
    COS_PHI,
    _,
    NOISE,  # first of four rows for the noise of this tick ...
    _,
    _,
    _,
    UNIFORMS,  # ... and of four for what it is made of
    _,
    _,
    _,
    BEFORE,  # first of the rows that keep the contact's state of before an evaluation
) = range(27)
CONTACT_ROWS = HELD_Y + 1 - PSI
MEMO_ROWS = BEFORE + CONTACT_ROWS


@inlined
def at(row: int, whisker: int) -> int:
    """Where an entry of these arrays is when they are read as one row.

    With the number of columns known, loops over whiskers turn into vector instructions.
    """
    return row * WHISKERS + whisker
