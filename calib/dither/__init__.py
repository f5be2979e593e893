"""Effect of the gyro dither on the accelerometers."""
