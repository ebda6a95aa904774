"""A frame through a run of particles: split as one likes, and made of the kernels it says it is made of."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise

import numpy as np
import pytest

from finite_sets import rules_of
from kalmap.kernels import set_layout as sets
from kalmap.kernels.bernoulli import bernoulli_update
from kalmap.kernels.particles import BERNOULLI, BY_MOTION, BY_SIGHTINGS, PHD, step_particles
from kalmap.kernels.phd import phd_update
from kalmap.kernels.proposal import moved, world_root
from test_proposal import FULL, RANK_2, around, carried, proposed, scene_of

NUMBER = 12
KINDS = {"phd": (PHD, phd_update), "bernoulli": (BERNOULLI, bernoulli_update)}
PROPOSALS = {"motion": BY_MOTION, "sightings": BY_SIGHTINGS}


class Cloud:
    """Particles around a pose, each with a map a little different, slots in no order."""

    def __init__(self, root, seed: int = 81) -> None:
        rng = np.random.default_rng(seed)
        self.root = root
        pose = np.array([2.0, -1.0, 0.7])
        rules = rules_of(
            CLUTTER=1e-3, GATE=30.0, BIRTH=0.1, PRUNE=1e-6, MERGE=4.0, WEIGHTING=sets.MULTI_FEATURE
        )
        self.scene = scene_of(around(pose, 8, rng), carried(pose, root, rng.standard_normal(3)), rng, rules)
        self.scene.z = np.vstack([self.scene.z[:6], [[30.0, 0.4], [12.0, -1.0]]])
        self.slots = rng.permutation(NUMBER + 3)[:NUMBER]
        self.blocks = np.full((NUMBER + 3, 60, sets.COLUMNS), np.nan)
        self.counts = np.zeros(NUMBER + 3, dtype=np.int64)
        for slot in self.slots:
            count = int(rng.integers(3, 9))
            self.blocks[slot, :count] = self.scene.rows[:count]
            self.blocks[slot, :count, [sets.X, sets.Y]] += 0.05 * rng.standard_normal((2, count))
            self.counts[slot] = count
        self.poses = pose + 0.02 * rng.standard_normal((NUMBER, 3))
        self.normals = rng.standard_normal((NUMBER, 3))
        self.ways = np.zeros((NUMBER, 3, 3))
        self.left = np.zeros((NUMBER, 3, 3))
        self.log_factors = np.full(NUMBER, np.nan)
        self.explained = np.full((NUMBER, len(self.scene.z)), np.nan)
        self.tallies = np.zeros((NUMBER, 2, 1))

    def step(
        self, first: int, last: int, kind: int, proposal: int, known: bool, spread_by: float = 1.0
    ) -> None:
        step_particles(
            self.scene.setup,
            self.scene.rules,
            self.scene.profile,
            self.scene.beams,
            self.scene.noise,
            self.blocks,
            self.counts,
            self.slots,
            self.poses,
            self.root,
            np.zeros(3),
            self.scene.z,
            3,
            kind,
            proposal,
            known,
            spread_by,
            self.normals,
            first,
            last,
            self.left,
            self.ways,
            self.log_factors,
            self.explained,
            self.tallies,
        )

    def map_of(self, particle: int) -> np.ndarray:
        slot = self.slots[particle]
        return self.blocks[slot, : self.counts[slot]]

    def answers(self) -> list[np.ndarray]:
        return [
            self.blocks,
            self.counts,
            self.poses,
            self.left,
            self.log_factors,
            self.explained,
            self.tallies,
        ]


@pytest.mark.parametrize("known", [True, False], ids=["known", "uncertain"])
@pytest.mark.parametrize("proposal", PROPOSALS)
@pytest.mark.parametrize("kind", KINDS)
def test_any_split_gives_the_same_bits(kind, proposal, known):
    """Oracle: all particles in one go; one by one; in uneven parts backwards; in three threads at once."""
    arguments = (KINDS[kind][0], PROPOSALS[proposal], known)
    whole = Cloud(FULL)
    whole.step(0, NUMBER, *arguments)
    assert np.isfinite(whole.log_factors).all()
    for edges in (list(range(NUMBER + 1)), [0, 1, 7, NUMBER]):
        split = Cloud(FULL)
        for first, last in list(pairwise(edges))[::-1]:
            split.step(first, last, *arguments)
        for got, expected in zip(split.answers(), whole.answers()):
            np.testing.assert_array_equal(got, expected)
    threads = Cloud(FULL)
    with ThreadPoolExecutor(3) as pool:
        jobs = [pool.submit(threads.step, 4 * k, 4 * k + 4, *arguments) for k in range(3)]
    for job in jobs:
        job.result()
    for got, expected in zip(threads.answers(), whole.answers()):
        np.testing.assert_array_equal(got, expected)


def test_only_the_particles_named_are_touched():
    """Oracle: poses and maps of the others, bit for bit."""
    before, cloud = Cloud(FULL), Cloud(FULL)
    cloud.step(3, 7, PHD, BY_SIGHTINGS, True)
    others = [k for k in range(NUMBER) if not 3 <= k < 7]
    np.testing.assert_array_equal(cloud.poses[others], before.poses[others])
    assert np.isnan(cloud.log_factors[others]).all()
    for k in others:
        np.testing.assert_array_equal(cloud.map_of(k), before.map_of(k))
    free = np.setdiff1d(np.arange(NUMBER + 3), cloud.slots)
    assert np.isnan(cloud.blocks[free]).all()


@pytest.mark.parametrize("root", [FULL, RANK_2], ids=["full", "rank 2"])
@pytest.mark.parametrize("known", [True, False], ids=["known", "uncertain"])
@pytest.mark.parametrize("proposal", PROPOSALS)
@pytest.mark.parametrize("kind", KINDS)
def test_a_step_is_a_draw_and_an_update(kind, proposal, known, root):
    """Oracle: the kernels that other tests check, one after the other for each particle: the weight is the product of
    the draw's and the update's; the update sees no uncertainty of a known pose, that of the motion of another."""
    before, cloud = Cloud(root), Cloud(root)
    cloud.step(0, NUMBER, KINDS[kind][0], PROPOSALS[proposal], known)
    for k in range(NUMBER):
        scene = before.scene
        scene.rows, scene.pose = before.map_of(k), before.poses[k].copy()
        if proposal == "motion":
            pose, log_weight, left = np.empty(3), 0.0, np.zeros((3, 3))
            moved(scene.pose, root, before.normals[k], pose)
        else:
            pose, log_weight, left = proposed(scene, root, before.normals[k])
        scene.pose, scene.root, scene.room = pose, np.zeros((3, 3)), 60
        if not known:
            world_root(pose[2], root, scene.root)
        outcome = scene.update(KINDS[kind][1], number=3)
        np.testing.assert_array_equal(cloud.poses[k], pose)
        np.testing.assert_array_equal(cloud.map_of(k), outcome.rows)
        np.testing.assert_array_equal(cloud.explained[k], outcome.explained)
        np.testing.assert_array_equal(cloud.tallies[k], outcome.tally)
        np.testing.assert_allclose(cloud.left[k] @ cloud.left[k].T, left, atol=1e-15)
        assert cloud.log_factors[k] == log_weight + outcome.log_weight


@pytest.mark.parametrize("proposal", PROPOSALS)
def test_a_draw_that_is_no_draw(proposal):
    """Oracle: spread_by 0 makes the normals count for nothing: another set of them gives the same poses and maps; and
    by motion the pose is where odometry puts it."""
    first, second = Cloud(FULL), Cloud(FULL)
    second.normals = -2.0 * second.normals
    for cloud in (first, second):
        cloud.step(0, NUMBER, PHD, PROPOSALS[proposal], True, spread_by=0.0)
    for got, expected in zip(second.answers(), first.answers()):
        np.testing.assert_array_equal(got, expected)
    if proposal == "motion":
        np.testing.assert_allclose(first.poses, Cloud(FULL).poses, atol=1e-15)


@pytest.mark.parametrize("kind", KINDS)
def test_a_particle_nearer_to_the_truth_weighs_more(kind):
    """Oracle: the same map, seen from the true pose and from one moved aside: by motion, weights fall with distance."""
    rng = np.random.default_rng(82)
    pose = np.array([2.0, -1.0, 0.7])
    factors = []
    for aside in (0.0, 0.15, 0.3, 0.6):
        cloud = Cloud(np.zeros((3, 3)))
        cloud.scene = scene_of(
            around(pose, 6, np.random.default_rng(83)), pose, rng, cloud.scene.rules, noise=False
        )
        for slot in cloud.slots:
            cloud.blocks[slot, :6], cloud.counts[slot] = cloud.scene.rows, 6
        cloud.poses = np.tile(pose + [aside, 0.0, 0.0], (NUMBER, 1))
        cloud.explained = np.zeros((NUMBER, 6))
        cloud.step(0, NUMBER, KINDS[kind][0], BY_MOTION, True)
        assert len(set(cloud.log_factors)) == 1
        factors.append(cloud.log_factors[0])
    assert (np.diff(factors) < 0.0).all()
