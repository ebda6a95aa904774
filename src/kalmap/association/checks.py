"""Refusing settings that cannot be meant."""

from __future__ import annotations

from kalmap.records import ConfigError


def check(good: bool, name: str, expected: str, value: object) -> None:
    """Raise ConfigError, naming the setting, unless it is good. NaN compares false and is never good."""
    if not good:
        raise ConfigError(f"association.{name}: expected {expected}, got {value}")
