"""Places of the settings that the contour kernels read, and the kinds of ends that they tell apart."""

MOUNT_X, MOUNT_Y, MOUNT_HEADING = 0, 1, 2
SIGMA_RANGE, RATIO_RANGE, SIGMA_BEAM = 3, 4, 5
MIN_RANGE, MAX_RANGE = 6, 7
GRAZING, STEEPEST = (
    8,
    9,
)  # rad, least angle between beam and wall: as a rule, and on a line that is seen to go on
SPLIT_COST = 10  # chi-square that one more piece must save
ROUGHNESS = 11  # m, standard deviation of real walls about a smooth curve
MIN_POINTS, MIN_LENGTH = 12, 13
MAX_ORDER = 14
SIGMA_BEND = 15  # 1/m, curvature of a wall on which no bend shows
PARAMETER_COST = 16  # chi-square that one more number in a curve must save
SIZE = 17

END, CORNER, HIDDEN, VIEW, SILENT, ONWARD = 0, 1, 2, 3, 4, 5
"""How a piece ends. END: the contour stops, the next beam goes past it. CORNER: another piece begins there. HIDDEN:
something nearer stands before what follows. VIEW: the last beam. SILENT: the next beam brought no range back. ONWARD:
the contour goes on, in points of which no piece was made."""
