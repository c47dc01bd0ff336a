"""What the fusion filter observes: one module per measurement.

Each has a NAME and a function that fills rows (error_state.ROW) at the end of a block from state
``s`` and parameters ``p``: the residual (measured less predicted from the nominal state), the
columns (indices and coefficients of the error state) and the variance of the noise, whitening
included. :func:`fusion.correct` asks them in order and updates with what they say.

To add one, a barometer or an external heading for example:

1. its module here, beside ``bounded_motion`` for a state that is measured directly or
   ``magnetometer`` for one with columns; three rows at most at a time;
2. one line in ``fusion.correct``, and its updates in ``error_state.MAX_UPDATES``;
3. its parameters in ``params.FusionParams``: kernels read them from there by name;
4. where its samples wait from one block to the next, a record in ``state.STATE``; where they come
   from outside, what the queue and the estimator do for the magnetometer (``mag_queue``,
   ``OrientationEstimator.add_mag``).

Test it with ``test/estimation/orientation/test_measurements.py``: its columns against differences.
"""
