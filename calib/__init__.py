"""Finds the calibration of the unit that `imudrv` drives."""
