"""Particles with their maps: one block for all, shared by particles of one origin until one of them changes its map."""

from __future__ import annotations

import numpy as np

from kalmap.kernels.set_layout import COLUMNS

_FIRST_ROOM = 64


class Particles:
    """N weighted poses, each with a map of up to `cap` components.

    poses (N, 3); log_weights (N,), normalised; slots (N,): where each one's map stands in `blocks` (S, room,
    COLUMNS), of which the first counts (S,) rows mean something. biases (N, nb): means of the constant errors.
    """

    __slots__ = ("_spare", "biases", "blocks", "cap", "counts", "log_weights", "poses", "slots")

    def __init__(self, poses: np.ndarray, biases: np.ndarray, cap: int) -> None:
        number = len(poses)
        self.poses, self.biases, self.cap = poses, biases, cap
        self.log_weights = np.full(number, -np.log(number))
        self.slots = np.arange(number)
        self.blocks = np.zeros((number, min(_FIRST_ROOM, cap), COLUMNS))
        self.counts = np.zeros(number, dtype=np.int64)
        self._spare: tuple[np.ndarray, np.ndarray] | None = None

    def __len__(self) -> int:
        return len(self.poses)

    def map_of(self, particle: int) -> np.ndarray:
        """(C, COLUMNS) of one particle: a view."""
        slot = self.slots[particle]
        return self.blocks[slot, : self.counts[slot]]

    def own(self, births: int) -> None:
        """Give every particle a map of its own, with room for so many births."""
        room = min(int(self.counts.max()) + births, self.cap)
        if room > self.blocks.shape[1]:
            grown = np.zeros((len(self.blocks), min(max(room, 2 * self.blocks.shape[1]), self.cap), COLUMNS))
            grown[:, : self.blocks.shape[1]] = self.blocks
            self.blocks = grown
        used = np.zeros(len(self.blocks), dtype=bool)
        used[self.slots] = True
        free = np.flatnonzero(~used).tolist()
        if not free:
            return
        used[:] = False
        for particle, slot in enumerate(self.slots):
            if not used[slot]:
                used[slot] = True
                continue
            mine = free.pop()
            count = self.counts[slot]
            self.blocks[mine, :count], self.counts[mine] = self.blocks[slot, :count], count
            self.slots[particle] = mine

    def room_for_children(self, branches: int, births: int) -> tuple[np.ndarray, np.ndarray]:
        """Blocks (N * branches, room, COLUMNS) and counts for the maps that the particles' own turn into."""
        rows = len(self) * branches
        room = min(int(self.counts[self.slots].max()) + births, self.cap)
        if self._spare is None or len(self._spare[0]) != rows or self._spare[0].shape[1] < room:
            room = min(max(2 * room, _FIRST_ROOM), self.cap)
            self._spare = np.zeros((rows, room, COLUMNS)), np.zeros(rows, dtype=np.int64)
        return self._spare

    def survive(
        self, children: np.ndarray, log_weights: np.ndarray, branches: int, uniform: float
    ) -> np.ndarray:
        """Go on as at most N of the children, with their maps; returns the parent of each (N,).

        children (C,): where they stand among the rooms, C >= N; log_weights (C,): theirs. The choice leaves every
        child's expected weight as it is and varies least (Fearnhead & Clifford, On-line inference for hidden Markov
        models via particle filters, 2003): the heavy ones stay, the others share what places are left, equal in weight.
        """
        number = len(self)
        weights = np.exp(log_weights - log_weights.max())
        weights /= weights.sum()
        chosen, kept = _chosen(weights, number, uniform)
        rooms = children[chosen]
        old, self._spare = (self.blocks, self.counts), self._spare
        assert self._spare is not None
        (self.blocks, self.counts), self._spare = self._spare, old
        self.slots, parents = rooms, rooms // branches
        self.poses, self.biases = self.poses[parents], self.biases[parents]
        self.log_weights = np.log(kept / kept.sum())
        return np.asarray(parents)

    def weigh(self, log_factors: np.ndarray) -> bool:
        """Multiply the weights and normalise; False, with the weights made equal, if none is left."""
        whole = self.log_weights + log_factors
        whole = np.where(np.isnan(whole), -np.inf, whole)
        most = whole.max(initial=-np.inf)
        if not np.isfinite(most):
            self.log_weights = np.full(len(self), -np.log(len(self)))
            return False
        whole -= most
        self.log_weights = whole - np.log(np.exp(whole).sum())
        return True

    @property
    def weights(self) -> np.ndarray:
        """(N,), summing to one."""
        weights = np.exp(self.log_weights)
        return np.asarray(weights / weights.sum())

    @property
    def effective(self) -> float:
        """Effective sample size 1 / sum of squared weights."""
        return float(1.0 / np.square(self.weights).sum())

    def resample(self, uniform: float) -> np.ndarray:
        """Systematic resampling with one draw from [0, 1); returns the parents (N,). Maps are shared, not copied."""
        number = len(self)
        points = (uniform + np.arange(number)) / number
        edges = np.cumsum(self.weights)
        edges[-1] = 1.0
        parents = np.searchsorted(edges, points, side="right")
        self.poses, self.biases = self.poses[parents], self.biases[parents]
        self.slots = self.slots[parents]
        self.log_weights = np.full(number, -np.log(number))
        return parents


def _chosen(weights: np.ndarray, number: int, uniform: float) -> tuple[np.ndarray, np.ndarray]:
    """Indices (N,) of the weights (C,), summing to one, that stay, and what they then weigh (N,)."""
    order = np.argsort(-weights, kind="stable")
    if len(weights) == number:
        return np.arange(number), np.maximum(weights, 1e-300)
    ranked = weights[order]
    tail = np.append(np.cumsum(ranked[::-1])[::-1], 0.0)
    heavy = 0  # so many stay with the weight that they have
    while heavy < number and ranked[heavy] * (number - heavy) >= tail[heavy]:
        heavy += 1
    left = number - heavy
    if left == 0 or tail[heavy] <= 0.0:
        return order[:number], np.maximum(ranked[:number], 1e-300)
    share = tail[heavy] / left
    edges = np.cumsum(ranked[heavy:]) / share
    edges[-1] = left
    light = heavy + np.searchsorted(edges, uniform + np.arange(left), side="right")
    stay = np.concatenate([np.arange(heavy), light])
    return order[stay], np.concatenate([ranked[:heavy], np.full(left, share)])
