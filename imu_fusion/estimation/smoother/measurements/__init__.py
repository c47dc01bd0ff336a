"""What the smoother compares a trajectory with: one module for each measurement.

To add one, say a barometer:

1. ``measurements/barometer.py``: ``predict`` (value and derivative, numba) and a ``MEASUREMENT``
   with name, components, and ``prepare``, which turns its log into
   :class:`~.measurement.Readings` with their covariances.
2. ``measurements/registry.py``: one line in MEASUREMENTS, one in ``predict``.
3. ``params.py``: its noise, with ``sensor(...)``; ``state.py``: a line of BLOCKS for each error
   that is to be a state.
4. Its log in ``samples/logs.py``, its message in ``messages/``, its topic in
   ``streams/smoother.py``, which hands the log to ``Smoother.run``.

Filter, iteration, innovations, misfit remarks and reports know measurements by the registry alone;
``test_measurements.py`` takes the derivatives of all of them, and fails until it is told how to
change what the new one reads.
"""
