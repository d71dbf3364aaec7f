"""What a run leaves on disk: submap archives, the run directory, Gaussian PLY files; each file complete or absent."""
