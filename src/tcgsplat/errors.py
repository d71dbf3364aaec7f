"""What can go wrong for a person, as exceptions: each message says what happened, where, and what to do.

Numerical failure inside a run is not here: a lost frame or a rejected loop is data (a field), never an exception.
"""


class TCGSplatError(Exception):
    """Base of every error that this package raises on purpose; the command line prints it as one line."""


class ConfigError(TCGSplatError):
    """A setting that does not exist, has the wrong type, or cannot be right."""


class DatasetError(TCGSplatError):
    """A sequence that cannot be read: no folder, no depth, sizes that differ, an impossible depth scale."""


class BackendUnavailableError(TCGSplatError):
    """A rasterizer backend was asked for by name and this machine cannot run it."""


class DeviceMemoryError(TCGSplatError):
    """A GPU had too little memory for a run to go on; what was finished by then is kept."""


class ArchiveError(TCGSplatError):
    """A run directory or one of its files is missing, incomplete or of another version."""


class EvaluationError(TCGSplatError):
    """There is nothing to compare: no ground truth, no overlap in time, too few poses."""
