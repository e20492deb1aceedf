"""Segmenters: which pixels belong together, asked by points and boxes or everywhere."""
