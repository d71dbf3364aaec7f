"""Where the camera is: a frame against the standing map, by one of two solvers of the same residual."""
