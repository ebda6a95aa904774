"""The compiled engine against its numpy twin, and the full scope against the reduced one,
on random dense priors."""

from __future__ import annotations

import itertools

import msgspec
import numpy as np
import pytest

from kalmap.gaussian import NotPositiveError
from kalmap.records import Odometry
from kalmap.slam.engines import CompiledEngine, GeneralEngine
from slam_problems import (
    LINEARISERS,
    MOUNTED,
    controls,
    copy_belief,
    motions,
    random_belief,
    random_covariance,
)

MOTIONS = ("velocity-steering", "ackermann", "unicycle", "increments")
RULES = ("jacobian", "unscented", "unscented-scaled", "central", "central-2", "cubature")
BOTH = pytest.mark.parametrize("invariant", [False, True], ids=["additive", "invariant"])


def tolerance(rule: str) -> float:
    """The twin's Jacobian is numeric: that is all it can promise."""
    return 1e-6 if rule == "jacobian" else 1e-9


def engines(rule, invariant, sequential=False, motion="velocity-steering", biases=0):
    model, lineariser = motions(biases)[motion], LINEARISERS[rule]
    return (
        model,
        CompiledEngine(model, MOUNTED, lineariser, invariant, sequential),
        GeneralEngine(model, MOUNTED, lineariser, invariant, sequential, False),
        None
        if rule == "jacobian"
        else GeneralEngine(model, MOUNTED, lineariser, invariant, sequential, True),
    )


def assert_same(got, expected, tol):
    """Means and joint covariances, relative to the size of the numbers."""
    assert got.n == expected.n
    n = got.n
    np.testing.assert_allclose(got.mean[:n], expected.mean[:n], rtol=tol, atol=tol)
    a, b = got.covariance(), expected.covariance()
    scale = np.sqrt(np.outer(np.diag(b), np.diag(b)))
    np.testing.assert_allclose(a / scale, b / scale, atol=tol)


def odometry(rng, model, samples, given):
    values, durations = controls(rng, model, samples)
    c = model.control_size
    noise = np.stack([random_covariance(rng, c, 0.05) for _ in range(samples)]) if given else None
    return Odometry(1.0, values, durations, noise)


def frame(rng, belief, count, mistakes=0.3):
    """`count` noisy sightings of different landmarks of the belief, and where these begin."""
    which = rng.permutation((belief.n - belief.robot) // 2)[:count]
    indices = belief.robot + 2 * which.astype(np.int64)
    positions = np.stack([belief.mean[i : i + 2] for i in indices])
    z = MOUNTED.predict(belief.mean[:3], positions) + rng.normal(0, [mistakes, 0.03], (count, 2))
    z[:, 0] = np.abs(z[:, 0])
    return z, indices


@BOTH
@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("motion", MOTIONS)
@pytest.mark.parametrize("biases", [0, 1, 2, 3, 4])
def test_predict_equals_the_twin(rule, invariant, motion, biases):
    """Oracle: GeneralEngine in numpy, over two blocks, with the log's own noise and with the model's. Steered
    vehicles have a fourth constant error, the course offset."""
    rng = np.random.default_rng(10 * biases)
    model, compiled, general, _ = engines(rule, invariant, False, motion, biases)
    one = random_belief(rng, len(model.biases))
    two = copy_belief(one)
    for given in (False, True):
        event = odometry(rng, model, 3, given)
        compiled.predict(one, event)
        general.predict(two, event)
    assert_same(one, two, tolerance(rule))


@BOTH
@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("sequential", [False, True], ids=["joint", "sequential"])
@pytest.mark.parametrize("biases", [0, 1, 2, 3, 4])
def test_update_equals_the_twin(rule, invariant, sequential, biases):
    """Oracle: GeneralEngine in numpy; pending motion and a NIS included."""
    rng = np.random.default_rng(biases)
    model, compiled, general, _ = engines(rule, invariant, sequential, biases=biases)
    one = random_belief(rng, biases)
    compiled.predict(one, odometry(rng, model, 2, False))
    two = copy_belief(one)
    z, indices = frame(rng, one, 3)
    nis = compiled.update(one, z, indices, MOUNTED.covariance(z))
    np.testing.assert_allclose(
        general.update(two, z, indices, MOUNTED.covariance(z)), nis, rtol=tolerance(rule)
    )
    assert_same(one, two, tolerance(rule))


@BOTH
@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("biases", [0, 1, 2, 3, 4])
def test_append_equals_the_twin(rule, invariant, biases):
    """Oracle: GeneralEngine in numpy."""
    rng = np.random.default_rng(biases)
    _, compiled, general, _ = engines(rule, invariant, biases=biases)
    one = random_belief(rng, biases)
    two = copy_belief(one)
    z = np.array([[5.0, 0.3], [20.0, -3.0], [0.0, 1.0]])
    for engine, belief in ((compiled, one), (general, two)):
        engine.append(belief, z, MOUNTED.covariance(z))
    assert_same(one, two, tolerance(rule))


@BOTH
@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("biases", [0, 2, 3])
def test_expectations_equal_the_twin(rule, invariant, biases):
    """Oracle: GeneralEngine in numpy, every landmark, motion waiting; the compiled engine leaves the belief alone."""
    rng = np.random.default_rng(biases)
    model, compiled, general, _ = engines(rule, invariant, biases=biases)
    belief = random_belief(rng, biases)
    compiled.predict(belief, odometry(rng, model, 2, False))
    before = belief.mean.copy(), belief.packed.copy(), belief.phi.copy(), belief.pending
    candidates = belief.robot + 2 * np.arange(5)
    tol = 1e-6 if rule == "jacobian" else 1e-9
    got, expected = compiled.expect(belief, candidates), general.expect(copy_belief(belief), candidates)
    for one, two in zip(got, expected, strict=True):
        np.testing.assert_allclose(one, two, rtol=tol, atol=tol)
    for one, two in zip((belief.mean, belief.packed, belief.phi), before[:3], strict=True):
        np.testing.assert_array_equal(one, two)
    assert belief.pending == before[3]


@pytest.mark.parametrize("rule", RULES[1:])
@pytest.mark.parametrize("kind", ["compiled", "general"])
def test_expecting_refuses_what_is_no_covariance(rule, kind):
    """Oracle: NotPositiveError where points must be drawn from a block that is none (a Jacobian draws none)."""
    _, compiled, general, _ = engines(rule, False)
    belief = random_belief(np.random.default_rng(6))
    belief.packed[0] = -1.0
    with pytest.raises(NotPositiveError):
        (compiled if kind == "compiled" else general).expect(belief, np.array([3, 5]))


@BOTH
@pytest.mark.parametrize("rule", ["unscented", "central", "cubature"])
@pytest.mark.parametrize("biases", [0, 2])
def test_full_scope_equals_reduced_where_theory_says_so(rule, invariant, biases):
    """Oracle: Theorem 1 of Chen & Cheng 2012; and cubature's visible difference,
    its points being sqrt(n) away."""
    rng = np.random.default_rng(biases)
    model, reduced, _, full = engines(rule, invariant, biases=biases)
    one = random_belief(rng, biases)
    two = copy_belief(one)
    event, (z, indices) = odometry(rng, model, 2, False), frame(rng, one, 3)
    for engine, belief in ((reduced, one), (full, two)):
        engine.predict(belief, event)
        engine.update(belief, z, indices, MOUNTED.covariance(z))
        engine.append(belief, z[:1], MOUNTED.covariance(z[:1]))
    if rule == "cubature":
        assert np.abs(one.mean[: one.n] - two.mean[: two.n]).max() > 1e-5
        assert np.abs(one.covariance() - two.covariance()).max() > 1e-6
    else:
        assert_same(two, one, 1e-9)


@BOTH
@pytest.mark.parametrize("sequential", [False, True], ids=["joint", "sequential"])
def test_outliers_are_inflated_alike(invariant, sequential):
    """Oracle: the numpy twin, with sightings far outside the gate among good ones;
    and without a gate a difference."""
    rng, sensor = np.random.default_rng(5), msgspec.structs.replace(MOUNTED, outlier_gate=0.99)
    model, rule = motions(0)["unicycle"], LINEARISERS["central"]
    beliefs = [random_belief(rng)]
    beliefs += [copy_belief(beliefs[0]), copy_belief(beliefs[0])]
    z, indices = frame(rng, beliefs[0], 3)
    z[1] += (4.0, 0.5)
    several = (
        CompiledEngine(model, sensor, rule, invariant, sequential),
        GeneralEngine(model, sensor, rule, invariant, sequential, False),
        CompiledEngine(model, MOUNTED, rule, invariant, sequential),
    )
    for engine, belief in zip(several, beliefs, strict=True):
        engine.update(belief, z, indices, MOUNTED.covariance(z))
    assert_same(beliefs[0], beliefs[1], 1e-9)
    assert np.abs(beliefs[0].mean[:3] - beliefs[2].mean[:3]).max() > 1e-3


@pytest.mark.parametrize("size", [0.5, 5.0, 50.0])
def test_an_outlier_ends_on_the_gate(size):
    """Oracle: the definition. S is scaled so that the distance is the gate, hence the gain and with it the
    correction by gate / d^2; inside nothing changes. The NIS that is told is the one before."""
    rng, sensor = np.random.default_rng(5), msgspec.structs.replace(MOUNTED, outlier_gate=0.99)
    belief = random_belief(rng)
    z, indices = frame(rng, belief, 1, 0.0)
    z[0, 0] += size
    _, plain, _, _ = engines("jacobian", False)
    gated = CompiledEngine(motions(0)["velocity-steering"], sensor, LINEARISERS["jacobian"], False, False)
    prior, other = belief.mean[: belief.n].copy(), copy_belief(belief)
    nis = plain.update(other, z, indices, MOUNTED.covariance(z))
    got = gated.update(belief, z, indices, MOUNTED.covariance(z))
    np.testing.assert_allclose(got, nis, rtol=1e-9)
    share = min(1.0, -2.0 * np.log(0.01) / nis)
    moved, whole = belief.mean[: belief.n] - prior, other.mean[: belief.n] - prior
    np.testing.assert_allclose(moved, share * whole, rtol=1e-9, atol=1e-12)


@BOTH
@pytest.mark.parametrize("sequential", [False, True], ids=["joint", "sequential"])
def test_the_same_landmark_twice_in_a_frame(invariant, sequential):
    """Oracle: the numpy twin, and for the Jacobian in one joint update the dense Kalman formulas."""
    rng = np.random.default_rng(4)
    _, compiled, general, _ = engines("central", invariant, sequential)
    one = random_belief(rng)
    two = copy_belief(one)
    z, indices = frame(rng, one, 2)
    z, indices = np.concatenate([z, z[:1] + 0.05]), np.append(indices, indices[0])
    compiled.update(one, z, indices, MOUNTED.covariance(z))
    general.update(two, z, indices, MOUNTED.covariance(z))
    assert_same(one, two, 1e-9)


def test_joint_update_is_the_dense_kalman_update():
    """Oracle: K = P H' S^-1 with a Jacobian by finite differences of the sensor, in plain numpy."""
    rng = np.random.default_rng(8)
    _, compiled, _, _ = engines("jacobian", False)
    belief = random_belief(rng, landmarks=4)
    mean, p, n = belief.mean[: belief.n].copy(), belief.covariance(), belief.n
    z, indices = frame(rng, belief, 3, 0.1)

    def predict(x):
        return np.concatenate([MOUNTED.predict(x[:3], x[i : i + 2]) for i in indices])

    h = np.array([(predict(mean + d) - predict(mean - d)) / 2e-6 for d in 1e-6 * np.eye(n)]).T
    r = np.zeros((6, 6))
    for k, noise in enumerate(MOUNTED.covariance(z)):
        r[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = noise
    nu = z.ravel() - predict(mean)
    nu[1::2] = (nu[1::2] + np.pi) % (2 * np.pi) - np.pi
    s = h @ p @ h.T + r
    nis = compiled.update(belief, z, indices, MOUNTED.covariance(z))
    np.testing.assert_allclose(nis, nu @ np.linalg.solve(s, nu), rtol=1e-6)
    np.testing.assert_allclose(belief.mean[:n], mean + p @ h.T @ np.linalg.solve(s, nu), atol=1e-6)
    np.testing.assert_allclose(belief.covariance(), p - p @ h.T @ np.linalg.solve(s, h @ p), atol=1e-7)


FAILING = list(itertools.product(["compiled", "general", "full"], [False, True], [False, True]))


@pytest.mark.parametrize(("kind", "invariant", "sequential"), FAILING)
def test_a_failed_step_leaves_the_belief_as_it_was(kind, invariant, sequential):
    """Oracle: the promise of `Engine`: the belief before, bit for bit, whatever part of the step failed."""
    rng = np.random.default_rng(6)
    model, *all_engines = engines("central", invariant, sequential)
    engine = dict(zip(("compiled", "general", "full"), all_engines, strict=True))[kind]
    belief = random_belief(rng)
    mean, full = belief.mean[: belief.n].copy(), belief.covariance()
    z, indices = frame(rng, belief, 3)
    good = MOUNTED.covariance(z)
    bad = good.copy()
    bad[2] = -1e4 * np.eye(2)
    values, durations = controls(rng, model, 2)
    event = Odometry(1.0, values, durations, np.stack([np.eye(2), np.diag([1.0, -1.0])]))
    for attempt in (
        lambda: engine.update(belief, z, indices, bad),
        lambda: engine.append(belief, z, bad),
        lambda: engine.predict(belief, event),
        lambda: engine.merge(belief, int(indices[0]), int(indices[0])),
    ):
        with pytest.raises(NotPositiveError):
            attempt()
        np.testing.assert_array_equal(belief.mean[: belief.n], mean)
        np.testing.assert_array_equal(belief.covariance(), full)


@BOTH
@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("kind", ["compiled", "general"])
def test_noise_that_is_no_covariance_is_refused(rule, invariant, kind):
    """Oracle: the house rule: a covariance that is not positive definite is an error with every
    lineariser."""
    rng = np.random.default_rng(6)
    model, compiled, general, _ = engines(rule, invariant)
    engine = compiled if kind == "compiled" else general
    values, durations = controls(rng, model, 1)
    z = np.array([[5.0, 0.3]])
    for noise in (np.diag([-100.0, 1.0]), np.full((2, 2), np.nan)):
        belief = random_belief(rng)
        with pytest.raises(NotPositiveError):
            engine.append(belief, z, noise[None])
        with pytest.raises(NotPositiveError):
            engine.predict(belief, Odometry(1.0, values, durations, noise[None]))
