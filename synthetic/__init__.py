"""Captures with ground truth, made in simulation; `python -m synthetic --help`."""
