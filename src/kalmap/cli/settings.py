"""From defaults, a configuration file, `--set` and flags to one resolved configuration."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path
from typing import Any

import msgspec

from kalmap.records import ConfigError, LogError, RunConfig

Settings = dict[str, Any]


def read_config(path: Path) -> Settings:
    """A TOML or JSON file as a dictionary. Raises LogError naming the place if it cannot be read."""
    try:
        text = path.read_text(encoding="utf-8")
        loaded = json.loads(text) if path.suffix == ".json" else tomllib.loads(text)
    except FileNotFoundError:
        raise LogError("no such file", file=path) from None
    except (OSError, UnicodeDecodeError, json.JSONDecodeError, tomllib.TOMLDecodeError) as problem:
        raise LogError(f"is no configuration that can be read: {problem}", file=path) from problem
    if not isinstance(loaded, dict):
        raise LogError("expected a table of settings", file=path)
    return loaded


def parse_pairs(pairs: tuple[str, ...]) -> Settings:
    """`key.sub=value` texts as a nested dictionary; values are JSON, or text where they are no JSON."""
    settings: Settings = {}
    for pair in pairs:
        key, equals, text = pair.partition("=")
        if not equals or not key:
            raise ConfigError(f"--set {pair}: expected key=value, for instance motion.sigma_speed=0.3")
        try:
            value = json.loads(text)
        except json.JSONDecodeError:
            value = text
        *path, last = key.strip().split(".")
        place = settings
        for step in path:
            place = place.setdefault(step, {})
            if not isinstance(place, dict):
                raise ConfigError(f"--set {pair}: {step} has a value already")
        place[last] = value
    return settings


def merge(base: Settings, over: Settings) -> Settings:
    """`over` on top of `base`, table by table."""
    merged = dict(base)
    for key, value in over.items():
        old = merged.get(key)
        merged[key] = merge(old, value) if isinstance(old, dict) and isinstance(value, dict) else value
    return merged


def resolve(defaults: RunConfig, settings: Settings) -> RunConfig:
    """The defaults with settings on top. Raises ConfigError naming an unknown key or a wrong value."""
    try:
        return msgspec.convert(merge(msgspec.to_builtins(defaults), settings), RunConfig, strict=True)
    except msgspec.ValidationError as problem:
        raise ConfigError(f"configuration: {problem}") from problem
