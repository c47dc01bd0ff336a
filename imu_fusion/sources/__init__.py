"""Formats of devices and their exports: bytes to samples, and how the bytes come here.

A live stream and its export are the same format, so they have the same code: a
:class:`~imu_fusion.sources.source.Source` is fed bytes and gives samples; it reads no file, opens
no port and asks no clock. ``transports`` bring the bytes. :mod:`~imu_fusion.sources.registry`
knows the formats. ``recordings`` makes recordings of files with them, the node ``driver`` topics
of devices.
"""
