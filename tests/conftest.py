"""The order of the tests."""

import pytest


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The slow ones first, so that no core waits in the end for one of them on another."""
    items.sort(key=lambda item: item.get_closest_marker("slow") is None)
