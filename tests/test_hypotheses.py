"""Multi-hypothesis FastSLAM against every association written out, scipy's assignment and closed forms."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment
from scipy.stats import multivariate_normal

from kalmap.kernels import set_layout as at
from kalmap.kernels.association_sums import log_sum_of_associations
from kalmap.kernels.bernoulli import bernoulli_update
from kalmap.kernels.frame import FRAME_IDS
from kalmap.kernels.hypotheses import (
    existence_if_given,
    existence_if_missed,
    hypotheses_update,
    step_hypotheses,
)
from kalmap.kernels.layout import JACOBIAN, RULE, SETUP_LENGTH, SIGMA_BEARING, SIGMA_RANGE
from kalmap.kernels.looks import sight
from kalmap.kernels.particles import BY_MOTION, BY_SIGHTINGS
from kalmap.kernels.proposal import moved, propose
from kalmap.kernels.ranking import DROP
from matchings import matchings

DETECTION, CLUTTER, CLUTTER_RATE, BIRTH = 0.8, 0.05, 2.0, 0.3
SIGMA_R, SIGMA_B, GATE = 0.2, 0.02, 16.0
NOISE = np.array([-1.0, 0.0, 0.0, 0.0])
NO_BEAMS = np.empty((0, 2))
POSE = np.array([0.5, -1.0, 0.3])

# --- problems -------------------------------------------------------------------------------------


def make_setup():
    setup = np.zeros(SETUP_LENGTH)
    setup[RULE], setup[SIGMA_RANGE], setup[SIGMA_BEARING] = JACOBIAN, SIGMA_R, SIGMA_B
    return setup


def make_rules(branches=1):
    rules = np.zeros(at.RULES)
    rules[at.CLUTTER], rules[at.CLUTTER_RATE], rules[at.GATE] = CLUTTER, CLUTTER_RATE, GATE
    rules[at.BIRTH], rules[at.PRUNE] = BIRTH, 0.01
    rules[at.MAX_RANGE], rules[at.HALF_VIEW], rules[at.RINGS] = 40.0, math.pi, 4
    rules[at.BRANCHES] = branches
    return rules


def make_block(places, existence, sigma=0.2, capacity=40):
    block = np.zeros((capacity, at.COLUMNS))
    for j, (x, y) in enumerate(places):
        block[j] = existence[j], x, y, sigma, 0.3 * sigma, 0.9 * sigma, 100 + j, 3.0
    return block


def crowd(rng, landmarks, sightings):
    """Landmarks within a metre or so of each other, and sightings of the same place: everything is ambiguous."""
    places = np.array([12.0, 4.0]) + rng.normal(0.0, 0.5, (landmarks, 2))
    block = make_block(places, rng.uniform(0.1, 0.98, landmarks))
    seen = np.array([12.0, 4.0]) + rng.normal(0.0, 0.5, (sightings, 2))
    return block, np.array([sight(make_setup(), *POSE, x, y) for x, y in seen]).reshape(-1, 2)


def update(block, count, z, branches, pose=POSE):
    """Call the kernel; (blocks cut to size, logs, explained, tally)."""
    maps = np.full((branches, len(block), at.COLUMNS), np.nan)
    counts, logs = np.zeros(branches, np.int64), np.full(branches, np.nan)
    explained, tally = np.full((branches, len(z)), np.nan), np.zeros((2, 4))
    made = hypotheses_update(
        make_setup(),
        make_rules(branches),
        np.full(4, DETECTION),
        NO_BEAMS,
        pose,
        np.zeros((3, 3)),
        NOISE,
        block,
        count,
        z,
        7,
        maps,
        counts,
        logs,
        explained,
        tally,
    )
    return [maps[k, : counts[k]] for k in range(made)], logs[:made], explained[:made], tally


# --- oracles --------------------------------------------------------------------------------------


def pair_density(row, z):
    """N(z; h, S) of a landmark by textbook matrices, 0 beyond the gate."""
    dx, dy = row[at.X] - POSE[0], row[at.Y] - POSE[1]
    squared = dx * dx + dy * dy
    distance = math.sqrt(squared)
    expected = np.array([distance, math.atan2(dy, dx) - POSE[2]])
    jacobian = np.array([[dx / distance, dy / distance], [-dy / squared, dx / squared]])
    lower = np.array([[row[at.L11], 0.0], [row[at.L21], row[at.L22]]])
    covariance = jacobian @ lower @ lower.T @ jacobian.T + np.diag([SIGMA_R**2, SIGMA_B**2])
    nu = z - expected
    if nu @ np.linalg.solve(covariance, nu) > GATE:
        return 0.0
    return multivariate_normal(expected, covariance).pdf(z)


def frame_likelihoods(block, count, z):
    """(ln likelihood, association) of every possible one from its definition, best first."""
    alone = CLUTTER / (1.0 - BIRTH)
    density = np.array([[pair_density(block[j], each) for j in range(count)] for each in z])
    out = []
    for given in matchings(len(z), count):
        value = math.exp(-CLUTTER_RATE)
        for i, j in enumerate(given):
            value *= alone if j < 0 else DETECTION * block[j, at.WEIGHT] * density[i, j]
        for j in set(range(count)) - set(given):
            value *= 1.0 - DETECTION * block[j, at.WEIGHT]
        if value > 0.0:
            out.append((math.log(value), given))
    return sorted(out, reverse=True)


# --- the update -----------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(30))
def test_hypotheses_are_the_most_likely_explanations_of_the_frame(seed):
    rng = np.random.default_rng(seed)
    count, sightings = rng.integers(1, 6), rng.integers(1, 5)
    block, z = crowd(rng, count, sightings)
    expected = frame_likelihoods(block, count, z)
    for branches in (1, 4, 400):
        maps, logs, explained, _ = update(block, count, z, branches)
        wanted = [each for each in expected[:branches] if each[0] > expected[0][0] - DROP]
        assert len(logs) == len(maps) == len(wanted)
        np.testing.assert_allclose(logs, [each[0] for each in wanted], atol=1e-9)
        np.testing.assert_array_equal(explained, np.array([each[1] for each in wanted]) >= 0)


@pytest.mark.parametrize("seed", range(20))
def test_all_hypotheses_add_up_to_the_normaliser(seed):
    """All associations, likely or not, sum to the set likelihood of the multi-Bernoulli map."""
    rng = np.random.default_rng(seed)
    count, sightings = 1 + seed % 5, 1 + seed % 4
    block, z = crowd(rng, count, sightings)
    whole = math.log(sum(math.exp(each[0]) for each in frame_likelihoods(block, count, z)))
    alone = CLUTTER / (1.0 - BIRTH)
    odds = np.empty((sightings, count))
    for i, j in np.ndindex(odds.shape):
        sighted = DETECTION * block[j, at.WEIGHT]
        odds[i, j] = sighted * pair_density(block[j], z[i]) / ((1.0 - sighted) * alone)
    missed = np.log(1.0 - DETECTION * block[:count, at.WEIGHT]).sum()
    summed = missed + sightings * math.log(alone) - CLUTTER_RATE + log_sum_of_associations(odds)
    assert summed == pytest.approx(whole, abs=1e-9)
    _, logs, _, _ = update(block, count, z, 400)
    kept = math.log(np.exp(logs).sum())
    assert whole + math.log1p(-501 * math.exp(-DROP)) < kept < whole + 1e-9  # 4 and 5: 501 associations


@pytest.mark.parametrize("sightings", [1, 3])
def test_all_hypotheses_add_up_to_what_the_bernoulli_filter_returns(sightings):
    """One landmark: belief propagation is exact, nothing is approximate on either side."""
    block, _ = crowd(np.random.default_rng(1), 1, 0)
    z = np.array(sight(make_setup(), *POSE, *block[0, [at.X, at.Y]])) + np.outer(
        np.linspace(-1.0, 1.0, sightings), [0.2, 0.01]
    )
    _, logs, _, _ = update(block, 1, z, 8)
    assert len(logs) == sightings + 1
    _, log_sum = bernoulli_update(
        make_setup(),
        make_rules(),
        np.full(4, DETECTION),
        NO_BEAMS,
        POSE,
        np.zeros((3, 3)),
        NOISE,
        block.copy(),
        1,
        z,
        7,
        np.empty(sightings),
        np.zeros((2, 4)),
    )
    assert math.log(np.exp(logs).sum()) == pytest.approx(log_sum, abs=1e-9)


@pytest.mark.parametrize("seed", range(10))
def test_one_branch_is_the_maximum_likelihood_assignment_of_scipy(seed):
    rng = np.random.default_rng(seed)
    block, z = crowd(rng, 9, 12)
    sighted, alone = DETECTION * block[:9, at.WEIGHT], CLUTTER / (1.0 - BIRTH)
    value = np.full((12, 21), -1e4)
    value[:, 9:] = 0.0
    for i, j in np.ndindex(12, 9):
        odds = sighted[j] * pair_density(block[j], z[i]) / ((1.0 - sighted[j]) * alone)
        if odds > 0.0:
            value[i, j] = math.log(odds)
    rows, columns = linear_sum_assignment(value, maximize=True)
    maps, logs, explained, _ = update(block, 9, z, 1)
    whole = value[rows, columns].sum() + np.log(1.0 - sighted).sum() + 12 * math.log(alone) - CLUTTER_RATE
    assert logs == pytest.approx([whole], abs=1e-9)
    np.testing.assert_array_equal(explained[0], columns < 9)
    matched = maps[0][(maps[0][:, at.ID] < 200) & (maps[0][:, at.SEEN] == 4.0)]
    assert set(matched[:, at.ID] - 100) == set(columns[columns < 9])


def test_existence_after_a_sighting_is_that_of_an_isolated_pair():
    """One landmark, one sighting: sum over exists or not, sighted or missed."""
    for existence, detection, density, alone in itertools.product(
        (0.05, 0.5, 0.9), (0.1, 0.95), (1e-4, 2.0), (0.01, 0.4)
    ):
        exists = existence * (detection * density + (1.0 - detection) * alone)
        not_ = (1.0 - existence) * alone
        after = existence_if_given(existence, detection, density, alone)
        assert after == pytest.approx(exists / (exists + not_), rel=1e-12)
        missed = existence_if_missed(existence, detection)
        assert missed < existence
        assert missed / (1.0 - missed) == pytest.approx(existence / (1.0 - existence) * (1.0 - detection))


def test_belief_in_a_landmark_never_becomes_certainty():
    block = make_block([(12.0, 4.0)], [1.0])
    z = np.array([sight(make_setup(), *POSE, 12.0, 4.0)])
    maps, _, _, _ = update(block, 1, z, 1)
    existence = maps[0][0, at.WEIGHT]
    assert 0.999 < existence < 1.0
    for _ in range(20):
        existence = existence_if_missed(existence, DETECTION)
    assert existence < 1e-6


def test_maps_of_match_miss_prune_and_birth():
    places = [(12.0, 4.0), (-8.0, 3.0), (-2.0, -14.0), (300.0, 0.0)]
    block = make_block(places, [0.6, 0.7, 0.012, 0.5])
    z = np.array([sight(make_setup(), *POSE, 12.1, 4.1), (25.0, -1.0)])
    before = block.copy()
    maps, _, explained, tally = update(block, 4, z, 1)
    np.testing.assert_array_equal(block, before)
    np.testing.assert_array_equal(explained, [[1.0, 0.0]])
    after = {row[at.ID]: row for row in maps[0]}
    assert set(after) == {100, 101, 103, 7 * FRAME_IDS + 1}  # 102 is pruned
    np.testing.assert_array_equal(after[103], before[3])
    assert after[101][at.WEIGHT] == pytest.approx(0.7 * 0.2 / (1.0 - 0.56))
    np.testing.assert_array_equal(after[101][1:], before[1, 1:])
    density, alone = pair_density(before[0], z[0]), CLUTTER / (1.0 - BIRTH)
    assert after[100][at.WEIGHT] == pytest.approx(existence_if_given(0.6, 0.8, density, alone))
    assert 0.6 < after[100][at.WEIGHT] < 1.0
    assert after[100][at.SEEN] == 4.0
    assert math.hypot(after[100][at.X] - 12.1, after[100][at.Y] - 4.1) < math.hypot(0.1, 0.1)
    assert after[100][at.L11] < before[0, at.L11]
    born = after[7 * FRAME_IDS + 1]
    angle = POSE[2] - 1.0
    np.testing.assert_allclose(
        born[[at.X, at.Y]], POSE[:2] + 25.0 * np.array([math.cos(angle), math.sin(angle)])
    )
    assert born[at.WEIGHT] == BIRTH
    assert born[at.SEEN] == 1.0
    np.testing.assert_allclose(tally, [[0.7, 0.6, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0]])


def test_tally_shares_hits_between_hypotheses():
    block = make_block([(12.0, 4.0)], [0.9])
    z = np.array([sight(make_setup(), *POSE, 12.9, 4.4)])
    _, logs, explained, tally = update(block, 1, z, 2)
    assert len(logs) == 2
    share = np.exp(logs - logs.max())
    assert tally[1].sum() == pytest.approx((share * explained[:, 0]).sum() / share.sum())
    assert 0.0 < tally[1].sum() < 1.0


def test_empty_frame_lowers_what_is_in_view():
    block = make_block([(12.0, 4.0), (300.0, 0.0)], [0.6, 0.5])
    maps, logs, explained, _ = update(block, 2, np.empty((0, 2)), 4)
    assert logs == pytest.approx([math.log(1.0 - 0.48) - CLUTTER_RATE])
    assert explained.shape == (1, 0)
    assert maps[0][0, at.WEIGHT] == pytest.approx(0.6 * 0.2 / 0.52)
    np.testing.assert_array_equal(maps[0][1], block[1])


def test_without_landmarks_every_sighting_founds_one():
    block, z = make_block([], []), np.array([[10.0, 0.1], [20.0, -2.0], [5.0, 1.0]])
    maps, logs, explained, _ = update(block, 0, z, 4)
    assert logs == pytest.approx([3.0 * math.log(CLUTTER / (1.0 - BIRTH)) - CLUTTER_RATE])
    np.testing.assert_array_equal(explained, np.zeros((1, 3)))
    np.testing.assert_array_equal(maps[0][:, at.ID], 7 * FRAME_IDS + np.arange(3))
    np.testing.assert_array_equal(maps[0][:, at.WEIGHT], BIRTH)


def test_births_beyond_the_capacity_are_left_out():
    block = make_block([(12.0, 4.0)], [0.6], capacity=2)
    maps, _, _, _ = update(block, 1, np.array([[10.0, -1.0], [20.0, -2.0], [5.0, 2.0]]), 3)
    assert [len(rows) for rows in maps] == [2]
    assert maps[0][1, at.ID] == 7 * FRAME_IDS


# --- particles ------------------------------------------------------------------------------------

ROOT = np.diag([0.1, 0.05, 0.01])
COUNTS, SLOTS = np.array([4, 2]), np.arange(6) % 2


def six_particles():
    """(poses, normals, blocks of two maps that the particles share, sightings)."""
    rng = np.random.default_rng(5)
    crowded, z = crowd(rng, 4, 4)
    blocks = np.stack([crowded, make_block([(12.0, 4.2), (-9.0, 3.0)], [0.9, 0.5])])
    return POSE + 0.01 * rng.normal(size=(6, 3)), rng.normal(size=(6, 3)), blocks, z


def step(runs, proposal, known_pose=True):
    """Carry six particles of three branches through a frame, in the given runs of them."""
    poses, normals, blocks, z = six_particles()
    out = {
        "poses": poses,
        "left": np.full((6, 3, 3), np.nan),
        "ways": np.full((6, 3, 3), np.nan),
        "blocks": np.zeros((18, 40, at.COLUMNS)),
        "counts": np.zeros(18, np.int64),
        "logs": np.zeros(18),
        "children": np.zeros(6, np.int64),
        "explained": np.zeros((18, 4)),
        "tallies": np.zeros((6, 2, 4)),
    }
    before, counts = blocks.copy(), COUNTS.copy()
    frame = (make_setup(), make_rules(3), np.full(4, DETECTION), NO_BEAMS, NOISE)
    particles = (blocks, counts, SLOTS, poses, ROOT, np.zeros(3), z, 7, proposal, known_pose, 1.0, normals)
    results = [
        out[name] for name in ("left", "ways", "blocks", "counts", "logs", "children", "explained", "tallies")
    ]
    for first, last in runs:
        step_hypotheses(*frame, *particles, first, last, *results)
    np.testing.assert_array_equal(blocks, before)
    np.testing.assert_array_equal(counts, COUNTS)
    return out


@pytest.mark.parametrize("proposal", [BY_MOTION, BY_SIGHTINGS])
@pytest.mark.parametrize("known_pose", [True, False])
def test_particles_do_not_depend_on_how_they_are_split(proposal, known_pose):
    whole = step([(0, 6)], proposal, known_pose)
    for runs in ([(0, 2), (2, 6)], [(3, 6), (0, 1), (1, 3)]):
        parts = step(runs, proposal, known_pose)
        for name, value in whole.items():
            np.testing.assert_array_equal(parts[name], value, err_msg=name)
    assert whole["children"].min() >= 1
    assert whole["children"].max() == 3
    assert np.all(np.isfinite(whole["left"]))


@pytest.mark.parametrize("proposal", [BY_MOTION, BY_SIGHTINGS])
def test_children_are_the_hypotheses_from_where_the_particle_went(proposal):
    """The same by hand: `moved` or `propose`, then `hypotheses_update` from there."""
    out = step([(0, 6)], proposal)
    poses, normals, blocks, z = six_particles()
    frame = (make_setup(), make_rules(3), np.full(4, DETECTION), NO_BEAMS)
    for p in range(6):
        block, count = blocks[SLOTS[p]], COUNTS[SLOTS[p]]
        pose, left, factor = np.empty(3), np.zeros((3, 3)), 0.0
        if proposal == BY_SIGHTINGS:
            factor = propose(*frame, poses[p], ROOT, NOISE, block, count, z, normals[p], 1.0, pose, left)
        else:
            moved(poses[p], ROOT, normals[p], pose)
        np.testing.assert_array_equal(out["poses"][p], pose)
        np.testing.assert_array_equal(out["left"][p], left)
        maps, logs, explained, tally = update(block, count, z, 3, pose=pose)
        assert out["children"][p] == len(maps)
        low, high = 3 * p, 3 * p + len(maps)
        np.testing.assert_allclose(out["logs"][low:high], logs + factor, rtol=1e-14)
        np.testing.assert_array_equal(out["explained"][low:high], explained)
        np.testing.assert_array_equal(out["tallies"][p], tally)
        for k, rows in enumerate(maps):
            np.testing.assert_array_equal(out["blocks"][low + k, : out["counts"][low + k]], rows)
