"""Sensors with the errors that calibrated consumer sensors have."""

from imu_fusion.simulation.rotation import Sensors

MATRIX = ((1.004, 0.003, 0.0), (-0.002, 0.997, 0.001), (0.0, 0.003, 1.002))
ORDINARY = Sensors(gyr_density=2e-4, acc_density=2e-3, mag_sd=3e-7, gyr_bias=(0.01, -0.02, 0.005),
                   gyr_matrix=MATRIX, acc_bias=(0.02, -0.03, 0.01), mag_delay=0.011)
