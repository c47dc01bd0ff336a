"""Exact truth and simulated sensors."""
