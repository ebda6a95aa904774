"""Where the randomness of a simulated log comes from."""

from __future__ import annotations

import numpy as np

# Only ever append: a stream's place is what it is spawned by.
_NAMES = (
    "controls",
    "sightings",
    "starts",
    "turns",
    "mover-sightings",
    "detections",
    "mover-detections",
    "doubles",
    "clutter",
    "order",
    "beams",
    "furniture",
    "dropouts",
    "mixed-pixels",
)


def streams(seed: int) -> dict[str, np.random.Generator]:
    """One independent generator for every source of randomness, spawned from `SeedSequence(seed)`.

    So worlds that differ in one of them only, say in clutter, share all other random numbers.
    """
    children = np.random.SeedSequence(seed).spawn(len(_NAMES))
    return {name: np.random.default_rng(child) for name, child in zip(_NAMES, children)}
