"""The proposal that has seen the frame: a Kalman posterior where it must be one, and weights that keep it unbiased."""

from __future__ import annotations

import os
from functools import partial

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.optimize import minimize

import finite_sets as plain
from finite_sets import MOUNTED, Scene, rules_of
from kalmap.kernels import layout
from kalmap.kernels import set_layout as sets
from kalmap.kernels.proposal import moved, propose, root_of_inverse, world_root

FULL = np.array([[0.3, 0.0, 0.0], [0.05, 0.1, 0.0], [0.01, 0.01, 0.03]])
RANK_2 = np.array([[0.3, 0.0, 0.0], [0.0, 0.0, 0.0], [0.02, 0.0, 0.03]])  # no way across, as a car has none
RANK_1 = np.array([[0.3, 0.0, 0.0], [0.05, 0.0, 0.0], [0.02, 0.0, 0.0]])
ROOTS = {"full": FULL, "rank 2": RANK_2, "rank 1": RANK_1, "none": np.zeros((3, 3))}


def frame(pose) -> np.ndarray:
    cosine, sine = np.cos(pose[2]), np.sin(pose[2])
    return np.array([[cosine, -sine, pose[0]], [sine, cosine, pose[1]], [0.0, 0.0, 1.0]])


def carried(pose, root, e) -> np.ndarray:
    """pose compose exp(root e), by the matrix exponential."""
    x, y, turn = root @ e
    whole = frame(pose) @ expm(np.array([[0.0, -turn, x], [turn, 0.0, y], [0.0, 0.0, 0.0]]))
    return np.array([whole[0, 2], whole[1, 2], np.arctan2(whole[1, 0], whole[0, 0])])


def carried_many(pose, root, e) -> np.ndarray:
    """The same for rows of e (N, 3), with the closed form of the exponential."""
    x, y, turn = (e @ root.T).T
    turn = np.where(np.abs(turn) < 1e-9, 1e-9, turn)
    s, c = np.sin(turn) / turn, (1.0 - np.cos(turn)) / turn
    dx, dy = s * x - c * y, c * x + s * y
    cosine, sine = np.cos(pose[2]), np.sin(pose[2])
    return np.stack(
        [pose[0] + cosine * dx - sine * dy, pose[1] + sine * dx + cosine * dy, pose[2] + turn], axis=1
    )


def proposed(scene: Scene, root, normal, spread_by=1.0) -> tuple[np.ndarray, float, np.ndarray]:
    """Pose, ln of the importance weight, and the covariance that is left, of one draw."""
    out, left = np.full(3, np.nan), np.full((3, 3), np.nan)
    log_weight = propose(
        scene.setup,
        scene.rules,
        scene.profile,
        scene.beams,
        scene.pose,
        root,
        scene.noise,
        scene.rows,
        len(scene.rows),
        scene.z,
        normal,
        spread_by,
        out,
        left,
    )
    assert (np.triu(left, 1) == 0.0).all()
    return out, log_weight, left @ left.T


def scene_of(
    places, true, rng, rules=None, sigma=0.1, weight=0.95, noise=True, pose=(2.0, -1.0, 0.7)
) -> Scene:
    """Landmarks at places known to sigma, sighted from the true pose, with noise."""
    rows = np.array([plain.component(weight, place, sigma**2 * np.eye(2)) for place in places])
    z = np.array([plain.sight(MOUNTED, true, place) for place in places]).reshape(-1, 2)
    z += noise * rng.standard_normal(z.shape) * [0.1, 0.02]
    z[:, 1] = plain.wrap(z[:, 1])
    rules = rules_of(CLUTTER=1e-9, GATE=40.0) if rules is None else rules
    return Scene(rows.reshape(-1, sets.COLUMNS), z, rules, pose=np.array(pose))


def seen_after(pose, root, place, e) -> np.ndarray:
    """(2,) how a place looks from pose compose exp(root e)."""
    return plain.sight(MOUNTED, carried(pose, root, e), place)


def around(pose, count: int, rng) -> np.ndarray:
    """Places far apart, in a ring about the pose."""
    angles = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False) + rng.uniform(-0.2, 0.2, count)
    distances = rng.uniform(10.0, 25.0, count)
    return np.array(pose)[:2] + distances[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)


@pytest.mark.parametrize("name", ROOTS)
def test_moved_is_a_matrix_exponential(name):
    """Oracle: scipy.linalg.expm of the twist, composed as homogeneous matrices."""
    rng = np.random.default_rng(71)
    for scale in (1e-6, 1e-3, 1.0, 30.0):
        pose, e, out = rng.uniform(-4, 4, 3), rng.standard_normal(3), np.empty(3)
        moved(pose, scale * ROOTS[name], e, out)
        expected = carried(pose, scale * ROOTS[name], e)
        np.testing.assert_allclose(out[:2], expected[:2], atol=1e-11 * max(scale, 1.0))
        assert abs(plain.wrap(out[2] - expected[2])) < 1e-12


@pytest.mark.parametrize("name", ROOTS)
def test_world_root_is_a_root_of_the_turned_covariance(name):
    """Oracle: T R R' T' with the rotation T written out; lower triangular, no negative diagonal, nothing not finite."""
    rng = np.random.default_rng(72)
    for heading in (0.0, 0.5 * np.pi, np.pi, *rng.uniform(-7, 7, 50)):
        for scale in (1.0, 1e-8, 1e8):
            out = np.full((3, 3), np.nan)
            world_root(heading, scale * ROOTS[name], out)
            turn = frame((0.0, 0.0, heading))
            expected = turn @ ROOTS[name] @ ROOTS[name].T @ turn.T * scale**2
            np.testing.assert_allclose(out @ out.T, expected, atol=1e-14 * scale**2)
            assert (np.triu(out, 1) == 0.0).all()
            assert (np.diag(out) >= 0.0).all()


@pytest.mark.parametrize("spread", [0, 3, 6, 9, 12, 20])
def test_root_of_an_inverse_information(spread):
    """Oracle: eigenvalues and axes of which the matrix was made, as far as its condition number 10^spread allows; and
    beyond that, finite, no direction better known than anything or less than before."""
    rng = np.random.default_rng(73)
    for _ in range(100):
        axes = np.linalg.qr(rng.standard_normal((3, 3)))[0]
        values = 10.0 ** np.array([0.0, rng.uniform(0, spread), spread])
        a, factor = axes @ np.diag(values) @ axes.T, np.full((3, 3), np.nan)
        a = 0.5 * (a + a.T)
        log_determinant = root_of_inverse(a, factor)
        assert (np.tril(factor, -1) == 0.0).all()
        assert (np.diag(factor) > 0.0).all()
        if spread <= 12:
            tolerance = 1e-14 * 10.0**spread
            expected = axes @ np.diag(1.0 / values) @ axes.T
            np.testing.assert_allclose(factor @ factor.T, expected, atol=tolerance)
            assert log_determinant == pytest.approx(np.log(values).sum(), abs=tolerance)
        assert np.isfinite(factor).all()
        assert np.isfinite(log_determinant)
        assert (np.diag(factor) <= 1.0).all()


@pytest.mark.parametrize("wrapped", [False, True], ids=["around", "behind"])
@pytest.mark.parametrize("name", ["full", "rank 2", "rank 1"])
def test_certain_pairs_give_the_kalman_posterior(name, wrapped):
    """Oracle: the information filter over e ~ N(0, I), numeric derivatives, landmark and noise in the innovation; a
    motion of a few centimetres, so that what is not linear is below a hundredth of a standard deviation. Landmarks all
    around, or right behind the sensor, where a sighting's bearing wraps."""
    rng = np.random.default_rng(74)
    for _ in range(10):
        root = 0.1 * ROOTS[name]
        pose = np.array([2.0, -1.0, rng.uniform(-3, 3)])
        true = carried(pose, root, rng.standard_normal(3))
        places = around(pose, 6, rng)
        if wrapped:
            distances = np.linspace(9.0, 24.0, 6)
            places = np.array([plain.locate(MOUNTED, true, [distance, np.pi]) for distance in distances])
        scene = scene_of(places, true, rng, pose=pose)
        information, pull = np.eye(3), np.zeros(3)
        for row, z in zip(scene.rows, scene.z):
            place = row[[sets.X, sets.Y]]
            by_e = plain.slopes(partial(seen_after, pose, root, place), np.zeros(3), angles=True)
            by_place = plain.slopes(partial(plain.sight, MOUNTED, pose), place, angles=True)
            own = by_place @ plain.covariance(row) @ by_place.T + np.diag([0.1**2, 0.02**2])
            off = z - plain.sight(MOUNTED, pose, place)
            off[1] = plain.wrap(off[1])
            information += by_e.T @ np.linalg.solve(own, by_e)
            pull += by_e.T @ np.linalg.solve(own, off)
        mean, spread = np.linalg.solve(information, pull), np.linalg.inv(information)
        mode, _, left = proposed(scene, root, np.zeros(3), 0.0)
        turn = frame((0.0, 0.0, mode[2])) @ root
        expected = turn @ spread @ turn.T
        deviation = np.sqrt(np.diag(expected))
        off = mode - carried(pose, root, mean)
        assert (np.abs(off) < 0.02 * deviation).all()
        assert (np.abs(left - expected) <= 0.03 * np.outer(deviation, deviation)).all()


def cost(scene: Scene, root, e) -> float:
    """-ln of p(e) prod (c + sum P_D w N(z; h, S)), S of landmark and noise, at one e."""
    pose = carried_many(scene.pose, root, e[None])[0]
    at = Scene(scene.rows, scene.z, scene.rules, scene.rule, scene.mount, pose)
    looks = at.looks()
    parts = at.densities(looks) @ [look.detection * row[0] for look, row in zip(looks, scene.rows)]
    return float(0.5 * e @ e - np.log(scene.rules[sets.CLUTTER] + parts).sum())


def test_the_mode_under_clutter_and_a_larger_motion():
    """Oracle: scipy's minimiser of the same posterior, started from the answer and from the truth: the proposal's
    centre is within a third of a standard deviation of the best place found, among clutter and landmarks in pairs."""
    rng = np.random.default_rng(75)
    for _ in range(4):
        pose = np.array([2.0, -1.0, rng.uniform(-3, 3)])
        e = rng.standard_normal(3)
        places = around(pose, 5, rng)
        places = np.vstack([places, places[:2] + 1.5])
        rules = rules_of(CLUTTER=1e-3, GATE=40.0)
        scene = scene_of(places, carried(pose, FULL, e), rng, rules, pose=pose)
        scene.z = np.vstack([scene.z[:6], [[30.0, 0.3], [8.0, -2.2]]])
        mode, _, left = proposed(scene, FULL, np.zeros(3), 0.0)
        starts = [e, np.zeros(3)]
        found = [minimize(partial(cost, scene, FULL), start, method="Nelder-Mead") for start in starts]
        best = min(found, key=lambda result: result.fun).x
        off = mode - carried(pose, FULL, best)
        off[2] = plain.wrap(off[2])
        assert off @ np.linalg.solve(left, off) < 3.0 * 0.33**2


def set_likelihoods(scene: Scene, poses) -> np.ndarray:
    """(N,) likelihood of the sightings of a Poisson map from each pose, the innovations' covariance that from the
    scene's own pose: a function of the pose like any other, which both proposals must agree about."""
    cosine, sine = np.cos(poses[:, 2, None]), np.sin(poses[:, 2, None])
    dx = scene.rows[:, sets.X] - poses[:, 0, None]
    dy = scene.rows[:, sets.Y] - poses[:, 1, None]
    ahead, left = cosine * dx + sine * dy - MOUNTED[0], cosine * dy - sine * dx - MOUNTED[1]
    distance, bearing = np.hypot(ahead, left), np.arctan2(left, ahead) - MOUNTED[2]
    looks = scene.looks()
    total = np.ones(len(poses))
    for z in scene.z:
        intensity = np.full(len(poses), scene.rules[sets.CLUTTER])
        for j, look in enumerate(looks):
            off = np.stack([z[0] - distance[:, j], plain.wrap(z[1] - bearing[:, j])], axis=1)
            inverse = np.linalg.inv(look.innovation)
            density = np.exp(-0.5 * np.einsum("ni,ij,nj->n", off, inverse, off))
            density *= np.sqrt(np.linalg.det(inverse)) / (2.0 * np.pi)
            intensity += look.detection * scene.rows[j, 0] * density
        total *= intensity
    return total


def agree(first: np.ndarray, second: np.ndarray) -> None:
    """Two samples' means are within four standard errors of each other, and neither is of no use."""
    error = np.hypot(first.std() / np.sqrt(len(first)), second.std() / np.sqrt(len(second)))
    assert abs(first.mean() - second.mean()) < 4.0 * error
    assert error < 0.2 * second.mean()


@pytest.mark.parametrize("name", ["full", "rank 2", "rank 1"])
@pytest.mark.parametrize("clutter", [1e-6, 1e-2])
@pytest.mark.parametrize("landmarks", [1, 3])
def test_importance_weights_are_unbiased(name, clutter, landmarks):
    """Oracle: the mean over draws of weight times the likelihood of the frame equals its mean over the motion model,
    within four standard errors; the pose of the draw is that of some e at the stated density."""
    rng = np.random.default_rng(76)
    root, pose = ROOTS[name], np.array([2.0, -1.0, 2.9])
    scene = scene_of(
        around(pose, landmarks, rng),
        carried(pose, root, 0.8 * rng.standard_normal(3)),
        rng,
        rules_of(CLUTTER=clutter, GATE=40.0),
        pose=pose,
    )
    by_motion = set_likelihoods(scene, carried_many(pose, root, rng.standard_normal((400_000, 3))))
    poses, weights = [], []
    for normal in rng.standard_normal((20_000, 3)):
        out, log_weight, _ = proposed(scene, root, normal)
        poses.append(out)
        weights.append(np.exp(log_weight))
    by_sightings = np.array(weights) * set_likelihoods(scene, np.array(poses))
    agree(by_motion, by_sightings)
    # and it is worth having: fewer of the draws carry the weight when they are blind
    effective = [
        values.sum() ** 2 / np.square(values).sum() / len(values) for values in (by_motion, by_sightings)
    ]
    assert effective[1] > effective[0]


@pytest.mark.parametrize("name", ROOTS)
@pytest.mark.parametrize("nothing", ["no sightings", "no landmarks", "only clutter"])
def test_without_pairs_it_is_the_motion_model(name, nothing):
    """Oracle: the draw itself through the matrix exponential, weight one, covariance that of the motion."""
    rng = np.random.default_rng(77)
    root, pose = ROOTS[name], np.array([2.0, -1.0, 0.7])
    scene = scene_of(around(pose, 4, rng), pose, rng)
    if nothing == "no sightings":
        scene.z = scene.z[:0]
    elif nothing == "no landmarks":
        scene.rows = scene.rows[:0]
    else:
        scene.z = np.array([[49.0, 0.1], [48.0, -2.0]])
    for normal in rng.standard_normal((20, 3)):
        out, log_weight, left = proposed(scene, root, normal)
        expected = carried(pose, root, normal)
        np.testing.assert_allclose(out[:2], expected[:2], atol=1e-12)
        assert abs(plain.wrap(out[2] - expected[2])) < 1e-12
        assert log_weight == pytest.approx(0.0, abs=1e-12)
        turn = frame((0.0, 0.0, out[2])) @ root
        np.testing.assert_allclose(left, turn @ turn.T, atol=1e-14)


@pytest.mark.parametrize("motion", [1e-6, 1.0, 100.0, 1e4])
@pytest.mark.parametrize("sigma", [1e-6, 1e-4, 1e-2])
def test_a_sharp_sensor_after_a_vague_motion(motion, sigma):
    """Oracle: pose and weight finite, the covariance that is left a covariance, smaller than that of the motion, with
    forty landmarks of exact place, at any ratio of the two uncertainties."""
    rng = np.random.default_rng(78)
    for name in ("full", "rank 2", "rank 1"):
        pose = np.array([2.0, -1.0, 0.7])
        root = motion * ROOTS[name] * [[1.0], [1.0], [0.01]]
        scene = scene_of(around(pose, 40, rng), pose, rng, sigma=1e-9, noise=False)
        scene.noise = np.array([sigma, 0.0, 0.1 * sigma, 0.0])
        for normal in rng.standard_normal((20, 3)):
            out, log_weight, left = proposed(scene, root, normal)
            assert np.isfinite(out).all()
            assert np.isfinite(log_weight)
            assert np.isfinite(left).all()
            turn = frame((0.0, 0.0, out[2])) @ root
            assert np.trace(left) <= np.trace(turn @ turn.T) * (1.0 + 1e-9)


def test_a_mode_is_where_the_draws_are():
    """Oracle: the mean and covariance of the draws of e against the mode and what is said to be left, within five
    standard errors; setup's own lineariser plays no part."""
    rng = np.random.default_rng(79)
    pose = np.array([2.0, -1.0, 0.0])
    scene = scene_of(around(pose, 5, rng), carried(pose, 0.1 * FULL, [0.5, -0.4, 0.3]), rng, pose=pose)
    mode, _, left = proposed(scene, 0.1 * FULL, np.zeros(3), 0.0)
    draws = np.array([proposed(scene, 0.1 * FULL, n)[0] for n in rng.standard_normal((4000, 3))])
    deviation = np.sqrt(np.diag(left))
    assert (np.abs(draws.mean(axis=0) - mode) < 5.0 * deviation / np.sqrt(4000)).all()
    np.testing.assert_allclose(
        np.cov(draws.T) / np.outer(deviation, deviation), left / np.outer(deviation, deviation), atol=0.1
    )
    assert scene.setup[layout.RULE] == layout.JACOBIAN


def run_of_proposals(count: int, seed: int) -> np.ndarray:
    """(count, 4): pose and log weight proposed with random maps, motions and sensors, sightings of the map and of
    anything."""
    rng, drawn = np.random.default_rng(seed), []
    for _ in range(count):
        root = ROOTS[str(rng.choice(list(ROOTS)))] * 10.0 ** rng.uniform(-3, 1)
        rules = rules_of(CLUTTER=10.0 ** rng.uniform(-7, 0), GATE=rng.choice([12.0, 40.0]))
        scene = plain.random_scene(rng, int(rng.integers(0, 15)), int(rng.integers(0, 12)), rules)
        scene.rows[:, [sets.L11, sets.L21, sets.L22]] *= 10.0 ** rng.uniform(-3, 1)
        scene.rule = str(rng.choice(["jacobian", "cubature"]))
        scene.profile = rng.choice([0.3, 0.9, 1.0], 1)
        scene.noise = rng.choice([-1.0, 1.0]) * np.array(
            [10.0 ** rng.uniform(-4, 1), 0.0, 10.0 ** rng.uniform(-5, -1), 0.0]
        )
        scene.pose = scene.pose + rng.standard_normal(3) * [0.3, 0.3, 0.03]
        out, log_weight, left = proposed(scene, root, rng.standard_normal(3))
        assert np.isfinite(out).all()
        assert -np.pi <= out[2] < np.pi
        assert np.isfinite(log_weight)
        assert np.isfinite(left).all()
        drawn.append([*out, log_weight])
    return np.array(drawn)


def test_random_proposals_are_numbers():
    """Oracle: pose, weight and covariance finite."""
    drawn = run_of_proposals(500, 80)
    assert drawn.shape == (500, 4)
    assert np.isfinite(drawn).all()
    assert (drawn[:, 3] != 0.0).sum() > 250  # more than half are not the motion model's


@pytest.mark.slow
def test_many_random_proposals_are_numbers():
    """Oracle: as above, 2,500 of each of KALMAP_SLOW_SEEDS seeds (default 20)."""
    seeds = int(os.environ.get("KALMAP_SLOW_SEEDS", "20"))
    drawn = np.concatenate([run_of_proposals(2_500, 84 + seed) for seed in range(seeds)])
    assert drawn.shape == (2_500 * seeds, 4)
    assert np.isfinite(drawn).all()
    assert (drawn[:, 3] != 0.0).sum() > 1_250 * seeds
