"""The scene as 3D Gaussians: dense start, training, and what the scan saw."""
