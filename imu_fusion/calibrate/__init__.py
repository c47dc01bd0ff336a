"""Calibrations from recordings, as parameter files that nodes and ``process`` read."""
