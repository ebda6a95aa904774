"""The binary counter of closed maps: what is joined with what, refusals, the chain of ends."""

import msgspec
import numpy as np
import pytest

from kalmap.geometry.se2 import compose
from kalmap.slam.submaps.background import BackgroundForest
from kalmap.slam.submaps.forest import Forest, chain


class Piece(msgspec.Struct, frozen=True):
    """A stretch first..last of a drive."""

    first: int
    last: int

    @property
    def end(self) -> np.ndarray:
        return np.array([float(self.last - self.first), 0.0, 0.0])

    @property
    def end_covariance(self) -> np.ndarray:
        return (self.last - self.first) * np.eye(3)


class Joining:
    """Joins what follows one another; refuses seams that are shut."""

    def __init__(self, shut=()):
        self.shut, self.joins = set(shut), []

    def __call__(self, first, second):
        assert first.last == second.first
        if first.last in self.shut:
            return None
        self.joins.append((first.first, first.last, second.last))
        return Piece(first.first, second.last)


def _grown(count, joining):
    forest = Forest(joining)
    for number in range(count):
        forest.close(Piece(number, number + 1))
    return forest


@pytest.mark.parametrize("count", [1, 2, 3, 7, 8, 13, 100])
def test_trees_are_the_ones_of_the_count_in_binary(count):
    forest = _grown(count, Joining())
    bits = [place for place in range(8, -1, -1) if count >> place & 1]
    assert [tree.level for tree in forest.trees] == bits
    assert [each.last - each.first for each in forest.maps] == [2**place for place in bits]
    forest.finish()
    assert forest.maps == (Piece(0, count),)


def test_a_map_takes_part_in_few_joins():
    joining = Joining()
    _grown(1024, joining)
    assert len(joining.joins) == 1023
    assert sum(last - first for first, _, last in joining.joins) == 1024 * 10


def test_a_refused_join_stays_apart_is_tried_again_and_hurts_nobody_else():
    joining = Joining({3})
    forest = _grown(8, joining)
    assert forest.maps == (Piece(0, 3), Piece(3, 8))
    assert forest.refusals > 0
    joining.shut.clear()
    forest.close(Piece(8, 9))
    forest.finish()
    assert forest.maps == (Piece(0, 9),)


def test_an_error_in_a_join_leaves_the_forest_as_it_was():
    class Failing(Joining):
        def __call__(self, first, second):
            raise ArithmeticError

    forest = Forest(Failing())
    forest.close(Piece(0, 1))
    with pytest.raises(ArithmeticError):
        forest.close(Piece(1, 2))
    assert forest.maps == (Piece(0, 1), Piece(1, 2))


def test_the_chain_of_ends_against_sampling():
    """Independent: Monte Carlo over the two poses."""
    rng = np.random.default_rng(3)

    class Leg(msgspec.Struct):
        end: np.ndarray
        end_covariance: np.ndarray

    legs = [
        Leg(np.array([3.0, 1.0, 0.7]), np.diag([0.01, 0.02, 0.001])),
        Leg(np.array([2.0, -1.0, 0.2]), 0.005 * np.eye(3)),
    ]
    pose, covariance = chain(legs)
    np.testing.assert_allclose(pose, compose(legs[0].end, legs[1].end))
    draws = [rng.multivariate_normal(leg.end, leg.end_covariance, 200_000) for leg in legs]
    np.testing.assert_allclose(covariance, np.cov(compose(*draws).T), atol=4e-4)


def test_a_worker_grows_the_same_trees_and_nobody_waits_for_it():
    import threading

    gate = threading.Event()

    class Slow(Joining):
        def __call__(self, first, second):
            gate.wait()
            return super().__call__(first, second)

    forest = BackgroundForest(Slow({5}))
    for number in range(13):
        forest.close(Piece(number, number + 1))  # returns although every join hangs
    assert chain(forest.maps)[0][0] == 13.0  # the chain of ends is there all the time
    gate.set()
    settled = forest.settled()
    assert settled.maps == _grown(13, Joining({5})).maps == forest.maps
    assert settled.refusals == _grown(13, Joining({5})).refusals


def test_an_error_in_the_background_comes_up_at_the_next_call():
    class Failing(Joining):
        def __call__(self, first, second):
            raise ArithmeticError("no")

    forest = BackgroundForest(Failing())
    forest.close(Piece(0, 1))
    forest.close(Piece(1, 2))
    with pytest.raises(ArithmeticError, match="no"):
        forest.settled()
    with pytest.raises(ArithmeticError, match="no"):
        forest.close(Piece(2, 3))
