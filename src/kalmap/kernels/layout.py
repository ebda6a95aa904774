"""Where each number stands in the `setup` vector that the filter's kernels read, and their status codes.

One float64 vector instead of thirty arguments: a call from Python pays for every argument it unboxes.
"""

RULE = 0  # 0 Jacobian, 1 unscented, 2 central difference, 3 cubature
RULE_A = 1  # unscented alpha; central difference h
RULE_B = 2  # unscented beta
RULE_C = 3  # unscented kappa, NaN: 3 - n
INVARIANT = 4  # 0 additive, 1 right-invariant error coordinates
MOTION = 5  # see the MOTION_ constants
WHEELBASE = 6
ENCODER_OFFSET = 7
SIGMA_SPEED = 8
RATIO_SPEED = 9
SIGMA_TURN = 10  # steering rad, or turn rate rad/s
RATIO_TURN = 11
SAMPLE_TIME = 12
RATIO_DISTANCE = 13
SIGMA_ROTATION = 14
RATIO_ROTATION = 15
BIAS_COUNT = 16
BIAS_CODE = 17  # up to five codes follow; no model has more than four
MOUNT_X = 22
MOUNT_Y = 23
MOUNT_HEADING = 24
SIGMA_RANGE = 25
RATIO_RANGE = 26
SIGMA_BEARING = 27
SEQUENTIAL = 28
OUTLIER_GATE = 29  # distance squared beyond which a sighting's noise is inflated; 0: never
EXACT_STANDSTILL = 30  # a sample that reads no motion at all adds no noise
SETUP_LENGTH = 32

JACOBIAN, UNSCENTED, CENTRAL_DIFFERENCE, CUBATURE = 0, 1, 2, 3

MOTION_VELOCITY_STEERING, MOTION_ACKERMANN, MOTION_UNICYCLE, MOTION_INCREMENTS = 0, 1, 2, 3

BIAS_STEERING_OFFSET, BIAS_STEERING_SCALE, BIAS_SPEED_SCALE = 0, 1, 2
BIAS_TURN_RATE_OFFSET, BIAS_TURN_RATE_SCALE, BIAS_COURSE_OFFSET = 3, 4, 5

OK = 0
NOT_POSITIVE = 1  # a prior block has no square root
INNOVATION_NOT_POSITIVE = 2  # an innovation covariance has none
NOT_FINITE = 3
BAD_SAMPLE = 4  # an odometry sample is not finite or has a negative duration
