"""Exceptions mean that a caller or a file is wrong; a poor measurement is a result, never an exception."""

from __future__ import annotations


class StockpilotError(Exception):
    """Base of what a person can mend: the text says what was expected, what came, and where."""


class ConfigError(StockpilotError):
    """A mission file or a --set is wrong: file, key, value, what is allowed."""


class FileFormatError(StockpilotError):
    """A file is not what it should be."""


class LinkError(StockpilotError):
    """A link could not be opened: address, reason, how to mend it."""
