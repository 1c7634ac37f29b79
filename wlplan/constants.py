"""Constants of nature and of the paper's setting, each with its source."""

# Standard gravity [m/s^2].
GRAVITY = 9.81

# Kilograms in a tonne, joules in a kilojoule.
KG_PER_TONNE = 1000.0
J_PER_KJ = 1000.0

# Grid spacing of the models and of the paper's terrain [m]. Paper, section 5.1.
CELL_SIZE = 0.1

# Box of the action parameters, in the order of `Action`. Paper, section 6.2.
ACTION_LOW = (0.0, 0.0, 0.0, 0.0)
ACTION_HIGH = (0.7, 5.0, 0.7, 5.0)
