"""Which Gaussians belong to robot, static and moving part."""
