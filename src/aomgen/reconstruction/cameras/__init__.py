"""Where every image was taken: structure from motion, its gates, lenses, fixed cameras, scan videos."""
