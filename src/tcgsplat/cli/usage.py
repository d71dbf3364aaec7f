"""A command that was asked for in a way that makes no sense."""

from tcgsplat.errors import TCGSplatError


class UsageError(TCGSplatError):
    """The arguments do not fit together, or a flag has an impossible value; the command line ends with code 2."""
