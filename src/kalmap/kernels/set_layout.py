"""Where each number stands in what the kernels of the finite-set filters share."""

# a component of a map: one row of a block
WEIGHT = 0  # of the intensity; of a Bernoulli component its probability of existence
X, Y = 1, 2
L11, L21, L22 = 3, 4, 5  # lower root of its covariance
ID = 6  # which sighting founded it: the same in every particle
SEEN = 7  # sightings used so far, each with its probability
COLUMNS = 8

SUREST = 1.0 - 1e-6  # most that an existence is believed: misses in a row can still undo it

# the rules of a filter, one vector
CLUTTER = 0  # density of false sightings, 1 / (m rad)
CLUTTER_RATE = 1  # their expected number in a frame
GATE = 2  # squared distance beyond which a pair does not count
BIRTH = 3  # weight that an unexplained sighting founds a component with
PRUNE = 4  # weight below which a component is dropped
MERGE = 5  # squared distance within which two components are one
CAP = 6  # most components of a map
FEATURE = 7  # weight from which a component counts as a feature
WEIGHTING = 8  # see the constants below
MAX_RANGE = 9
HALF_VIEW = 10  # rad; pi or more: all around
MIN_RANGE = 11
RINGS = 12  # rings of the detection profile
DEPTH = 13  # m, how far behind a beam's end a thing is hidden
BRANCHES = 14  # hypotheses kept of each particle
RULES = 16

EMPTY, SINGLE_FEATURE, SINGLE_CLUSTER, MULTI_FEATURE, CUBATURE_FEATURE = 0, 1, 2, 3, 4

# how a component should look: one row of a block
RANGE, BEARING = 0, 1
W11, W21, W22 = 2, 3, 4  # lower root of the innovation covariance
K11, K12, K21, K22 = 5, 6, 7, 8  # gain
U11, U21, U22 = 9, 10, 11  # lower root of the covariance after a sighting
DETECTION = 12  # probability that it is sighted
NORM = 13  # ln(2 pi |W|)
LOOK = 14
