"""Estimates against a truth: errors, shares within sigma, NEES. Nothing here estimates."""
