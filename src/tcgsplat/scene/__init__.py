"""The values that SLAM is about: frames, Gaussians, submaps, the atlas of sealed submaps, the trajectory."""
