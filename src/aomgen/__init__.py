"""AOMGen: one recorded demonstration in, many verified photoreal demonstrations out."""

__version__ = "0.1.0"
