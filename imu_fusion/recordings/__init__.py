"""Recordings: read, write, repair, inspect, import."""
