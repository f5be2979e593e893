"""Effect of the gyro dither on the accelerometers.

spectrum  closed form, line by line
text      the effect as text
"""
