"""The acceleration field of a rigid body from accelerometers on it, with or without a gyroscope."""
