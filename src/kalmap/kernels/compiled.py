"""How a kernel is compiled."""

from typing import Any

from numba import njit

# No entries for callers in C, which no kernel has, and which take a sixth of the time to compile it. The option is in
# none of numba's stubs.
_FOR_PYTHON: dict[str, Any] = {"no_cfunc_wrapper": True}

compiled = njit(cache=True, nogil=True, error_model="numpy", **_FOR_PYTHON)
