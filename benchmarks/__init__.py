"""Benchmarks: every figure in README and docs is written by one of these commands."""
