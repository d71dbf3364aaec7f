"""RGB-D sequences: recognised, read, undistorted, and checked; one file per layout."""

from tcgsplat.datasets.opening import open_sequence
from tcgsplat.datasets.sequence import Sequence

__all__ = ["Sequence", "open_sequence"]
