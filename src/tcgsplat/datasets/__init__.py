"""RGB-D sequences: recognised, read, undistorted, and checked; one file per layout."""
