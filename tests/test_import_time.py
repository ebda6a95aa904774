"""What an import may pull in: `kalmap --help` starts at once."""

from __future__ import annotations

import subprocess
import sys

import pytest

HEAVY = ("numba", "scipy", "matplotlib")


@pytest.mark.parametrize("module", ["kalmap", "kalmap.records"])
def test_import_loads_nothing_heavy(module):
    """Oracle: sys.modules of a fresh interpreter."""
    code = f"import {module}, sys; print([m for m in {HEAVY!r} if m in sys.modules])"
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert answer.stdout.strip() == "[]"


def test_every_public_name_can_be_had():
    """Oracle: `kalmap.__all__`; an unknown name is an AttributeError that says so."""
    import kalmap

    assert all(getattr(kalmap, name) is not None for name in kalmap.__all__)
    assert set(kalmap.__all__) == set(dir(kalmap))
    with pytest.raises(AttributeError, match="no_such_name"):
        kalmap.no_such_name  # noqa: B018
