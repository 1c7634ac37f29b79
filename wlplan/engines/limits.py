"""What every engine that plays a loading cycle has to agree on: its events, limits and lags.

Free of JAX, since the process of the discrete elements has none.
"""

STOP_REASONS = ("tilt_end", "penetration", "breakout", "timeout")
"""Events that end bucket filling, in the order of their numbers. Paper, section 5.2."""

# Limits of the bucket filling: penetration [m] and time [s]. Paper, section 5.2.
MAX_PENETRATION = 3.2
MAX_FILL_TIME = 15.0
# The brake holds for at least this long after the stop [s]. Paper, section 5.2.
BRAKE_TIME = 0.5
# A breakout counts from here [m]: at the toe the edge starts level with the surface. And the height
# of the edge over the initial surface that makes one [m]. Estimate.
BREAKOUT_FROM = 0.3
BREAKOUT_CLEARANCE = 0.05
# Boom and bucket move at this part of their full speeds on the way back [1]. Paper, section 5.2.
RETREAT_SPEED = 0.6

# The boom force is a moving average over this time [s]. Paper, section 5.2.
AVERAGING_TIME = 0.1
# Time of a lag of first order with the same mean delay [s].
SMOOTHING_TIME = 0.5 * AVERAGING_TIME
# Part of its stall load over which an actuator slows down before it [1]. Estimate.
ACTUATOR_SATURATION = 0.1
