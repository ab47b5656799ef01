"""The errors a user can meet; each message says what is wrong, where, and what to do."""

from __future__ import annotations


class OccfusionError(Exception):
    """Base of all errors that are the user's to act on; shown without a traceback."""


class DataError(OccfusionError):
    """A data folder or file is missing, unreadable, inconsistent or unsafe."""


class ConfigError(OccfusionError):
    """A setting is unknown, of the wrong type, out of range, or names something not available."""


class CheckpointError(OccfusionError):
    """A run folder or checkpoint cannot be resumed from."""


class NumericsError(OccfusionError):
    """A loss, gradient or score is not finite; names the term and the step."""
