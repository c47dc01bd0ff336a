"""Live sources: bytes to samples."""
