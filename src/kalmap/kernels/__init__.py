"""Compiled loops on plain arrays. Nothing here knows more than numbers; each has a slow twin in the tests."""
